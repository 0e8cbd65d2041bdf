"""A server with all pages, that of a campaign among them: their themes, and a square of the map clicked."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import until
from wfsobs.app.pages.pages import TITLES
from wfsobs.app.style import labels, look
from wfsobs.campaign.plan import parse_plan
from wfsobs.campaign.run import run_rows
from wfsobs.campaign.store import open_folder, write_batch
from wfsobs.evaluation.scores import BOUNDS

pytestmark = pytest.mark.slow

SHORT = {"run.duration": 1.0, "run.warm_up": 0.2, "gpr_online.training_size": 40, "gpr_offline.training_size": 40}
PLAN = {
    "seeds": 2,
    "observers": ["kf-lgs", "persistence"],
    "settings": SHORT,
    "grid": {"turbulence.wind_speed": [5, 20], "sensors.exposure_ratio": [5, 10]},
}


def toml(table: dict[str, Any]) -> str:
    """Write a plan: in JSON's values, which TOML shares."""
    plain = [f"{key} = {json.dumps(value)}" for key, value in table.items() if not isinstance(value, dict)]
    tables = [f"[{key}]\n{toml(value)}" for key, value in table.items() if isinstance(value, dict)]
    return "\n".join([*plain, *tables])


def make_campaign(folder: Path) -> None:
    """Run a small campaign to its end."""
    plan = parse_plan(toml(PLAN), folder.parent)
    open_folder(plan, folder)
    rows = [row for cell in plan.cells for seed in plan.seeds for row in run_rows(cell, seed, plan.observers, ())]
    write_batch(folder, rows, {"host": "", "process": 1, "written": 1.0})


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
  const shown = [...Bokeh.index.query((it) => it.model.type === "Figure" && it.el.checkVisibility())].map((it) => it.model)
  const lines = shown.flatMap((it) => it.renderers).filter((it) => looks[it.name] && it.glyph.type === "Line")
  const found = lines.filter((it) => it.glyph.line_color.value !== looks[it.name][dark ? 1 : 0]).map((it) => it.name)
  const axes = shown.filter((it) => text(it) && bright(text(it).value ?? text(it)) !== dark).map((it) => it.name)
  const ground = bright(getComputedStyle(document.body).backgroundColor) === dark ? ["page"] : []
  return [...found, ...axes, ...ground]
}"""
"""Lines in the colours of the other theme, figures whose axes are written in them, and the page where its ground is of it."""

FIGURES = """() => [...Bokeh.index.query((it) => it.model.type === "Figure" && it.el.checkVisibility())]
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
            until(page, TURNED, arg=[before, title in WITHOUT])
        until(page, f"(it) => ({WRONG})(it).length === 0", arg=[LOOKS, dark])


@pytest.mark.parametrize(
    ("system", "asked", "first", "titles"),
    [
        ("light", "dark", "Campaign", [*TITLES]),
        ("dark", "light", "Closed loop", SOME),
        ("dark", "", "Explore", SOME),
    ],
    ids=["dark by address", "light by address", "dark by system"],
)
def test_every_page_has_the_theme(open_page: Any, server: Any, system: str, asked: str, first: str, titles: list[str]) -> None:
    """That which is opened by its address, too."""
    dark = (asked or system) == "dark"
    query = "&".join(f"{path}={value}" for path, value in SHORT.items())
    link = f"{server.url}?{query}" + f"&theme={asked}" * bool(asked) + f"&view.page={TITLES[first]}" * (first != "Explore")
    page = open_page(url=link, color_scheme=system)
    until(page, TURNED, arg=[[], False])
    all_in(page, dark, [first, *(it for it in titles if it != first)])
    page.get_by_role("button", name=re.compile("theme", re.I)).click()
    all_in(page, not dark, titles[::-1])
    expect(page).to_have_url(re.compile(f"theme={'light' if dark else 'dark'}"))
    if first == "Campaign":
        a_square_opens_its_scenario(page)


def a_square_opens_its_scenario(page: Page) -> None:
    page.get_by_role("button", name="Campaign", exact=True).click()
    expect(page.get_by_text("8 of 8 runs")).to_be_visible()
    expect(page.get_by_role("region", name="Observers of the campaign").get_by_text("Persistence")).to_be_visible()
    page.get_by_role("button", name="Wind speed V₀ [m/s] 20, Exposure ratio n 10: ").click()
    expect(page.get_by_role("button", name="Explore", exact=True)).to_have_attribute("aria-pressed", "true")
    expect(page.get_by_role("textbox", name="Wind speed V₀ [m/s]")).to_have_value("20")
    expect(page.get_by_role("textbox", name="Exposure ratio n")).to_have_value("10")
