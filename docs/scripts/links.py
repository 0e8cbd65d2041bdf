"""Leads links to a notebook, which GitHub shows, to its page in the site."""


def on_page_markdown(markdown: str, **_: object) -> str:
    """Return a page whose links to notebooks are to pages; called by properdocs."""
    return markdown.replace(".ipynb)", ".md)")
