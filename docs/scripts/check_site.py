"""Checks the built site: `python docs/scripts/check_site.py build/site`.

Every link within it leads to a file and a place in it, and no page loads anything from another machine.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADS = {("script", "src"), ("img", "src"), ("link", "href"), ("iframe", "src"), ("source", "src"), ("image", "href")}
NOT_LOADED = {"canonical", "next", "prev", "edit", "alternate"}
"""What <link> can be without loading anything."""


class Page(HTMLParser):
    """places : ids to link to; links : targets of <a>; loads : what the page loads."""

    def __init__(self, html: str):
        super().__init__()
        self.places, self.links, self.loads = {""}, [], []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what matters of a tag."""
        values = dict(attrs)
        self.places |= {values[name] or "" for name in ("id", "name") if name in values}
        for name, value in attrs:
            if (tag, name) in LOADS and not (tag == "link" and set((values.get("rel") or "").split()) & NOT_LOADED):
                self.loads.append(value or "")
            elif (tag, name) == ("a", "href"):
                self.links.append(value or "")


def faults(site: Path) -> list[str]:
    """One line per fault."""
    pages = {file.resolve(): Page(file.read_text(encoding="utf-8")) for file in site.rglob("*.html")}
    out = [
        f"{file.name}: loads {url}"
        for file in site.rglob("*.css")
        for url in re.findall(r"(?:url\(['\"]?|@import ['\"])(https?:[^)'\"]*)", file.read_text(encoding="utf-8"))
    ]
    for file, page in pages.items():
        if file.name == "404.html":
            continue  # its links are those of a server's root
        name = file.relative_to(site.resolve())
        out += [f"{name}: loads {url}" for url in page.loads if urlsplit(url).netloc]
        for url in [*page.links, *page.loads]:
            parts = urlsplit(url)
            if parts.scheme or parts.netloc:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            target = target / "index.html" if target.is_dir() else target
            if not target.exists() or (target in pages and unquote(parts.fragment) not in pages[target].places):
                out.append(f"{name}: {url} leads nowhere")
    return sorted(set(out))


if __name__ == "__main__":
    found = faults(Path(sys.argv[1]))
    print("\n".join(found) or "links: all lead somewhere; nothing is loaded from elsewhere")
    sys.exit(bool(found))
