"""The theme of every page: by the address, by the system, and switched on the page."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser.test_campaign import SHORT, make_campaign
from wfsobs.app.pages.pages import TITLES
from wfsobs.app.style import labels, look
from wfsobs.evaluation.scores import BOUNDS

LOOKS = {name: [look(name).light, look(name).dark] for name in {*labels(), *BOUNDS}}

WRONG = """([looks, dark]) => {
  const text = (figure) => figure.renderers && figure.below?.[0]?.axis_label_text_color
  const bright = (colour) => {
    const context = document.createElement("canvas").getContext("2d", {willReadFrequently: true})
    context.fillStyle = colour
    context.fillRect(0, 0, 1, 1)
    const [r, g, b] = context.getImageData(0, 0, 1, 1).data
    return r + g + b > 384
  }
  const shown = [...Bokeh.index.query((it) => it.model.type === "Figure" && it.el.offsetParent !== null)].map((it) => it.model)
  const lines = shown.flatMap((it) => it.renderers).filter((it) => looks[it.name] && it.glyph.type === "Line")
  const found = lines.filter((it) => it.glyph.line_color.value !== looks[it.name][dark ? 1 : 0]).map((it) => it.name)
  const axes = shown.filter((it) => text(it) && bright(text(it).value ?? text(it)) !== dark).map((it) => it.name)
  const ground = bright(getComputedStyle(document.body).backgroundColor) === dark ? ["page"] : []
  return [...found, ...axes, ...ground]
}"""
"""Lines in the colours of the other theme, figures whose axes are written in them, and the page where its ground is of it."""

FIGURES = """() => [...Bokeh.index.query((it) => it.model.type === "Figure" && it.el.offsetParent !== null)]
    .map((it) => it.model.id)"""
TURNED = f"""([before, without]) => {{
  const now = ({FIGURES})()
  return without ? now.length === 0 : now.length > 0 && !now.some((it) => before.includes(it))
}}"""
WITHOUT = ("Tune", "Sweep", "Live", "Model")
"""Pages that have no figure before something is run, or none."""
SOME = ["Explore", "Closed loop", "Model"]
"""Where the theme comes from is asked once for all pages: those that show it are seen from one side."""


@pytest.fixture(scope="module")
def server(make_server: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A server with all pages: that of a campaign is there where there is one."""
    folder = tmp_path_factory.mktemp("theme")
    make_campaign(folder / "campaign")
    server = make_server(
        ["-m", "wfsobs", "serve", "--port", "{port}", "--campaign", str(folder / "campaign")], folder / "log", "/"
    )
    yield server
    server.close()


def all_in(page: Page, dark: bool, titles: list[str]) -> None:
    """Open every page, and wait until all on it has the colours of a theme."""
    for title in titles:
        button, before = page.get_by_role("button", name=title, exact=True), page.evaluate(FIGURES)
        if button.get_attribute("aria-pressed") != "true":
            button.click()
            page.wait_for_function(TURNED, arg=[before, title in WITHOUT])
        page.wait_for_function(f"(it) => ({WRONG})(it).length === 0", arg=[LOOKS, dark])


@pytest.mark.parametrize(
    ("system", "asked", "titles"),
    [("light", "dark", [*TITLES]), ("dark", "light", SOME), ("dark", "", SOME)],
    ids=["dark by address", "light by address", "dark by system"],
)
def test_every_page_has_the_theme(open_page: Any, server: Any, system: str, asked: str, titles: list[str]) -> None:
    dark = (asked or system) == "dark"
    query = "&".join(f"{path}={value}" for path, value in SHORT.items())
    page = open_page(url=f"{server.url}?{query}" + f"&theme={asked}" * bool(asked), color_scheme=system)
    all_in(page, dark, titles)
    page.get_by_role("button", name=re.compile("theme", re.I)).click()
    all_in(page, not dark, titles[::-1])
    expect(page).to_have_url(re.compile(f"theme={'light' if dark else 'dark'}"))


@pytest.mark.parametrize("title", ["Campaign", "Closed loop"])
def test_a_page_that_is_opened_by_its_address_has_the_theme(open_page: Any, server: Any, title: str) -> None:
    query = "&".join(f"{path}={value}" for path, value in SHORT.items())
    page = open_page(url=f"{server.url}?{query}&view.page={TITLES[title]}&theme=dark", color_scheme="light")
    page.wait_for_function(TURNED, arg=[[], False])
    page.wait_for_function(f"(it) => ({WRONG})(it).length === 0", arg=[LOOKS, True])
