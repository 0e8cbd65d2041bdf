"""For everyone, at every size, under strain: accessibility, keyboard, narrow windows, long runs, a page that fails."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import CHANGED, QUICK, answered, carded, until

pytestmark = pytest.mark.slow

ALLOWED: Mapping[str, tuple[str, int, str]] = MappingProxyType(
    {
        "aria-prohibited-attr": (
            r'^<span aria-label="[^"]*" sx=|aria-label="Resize sidebar"',
            24,
            "panel-material-ui: a tooltip's span and the drawer's edge have labels but no role",
        ),
        "aria-progressbar-name": ("MuiLinearProgress-root", 1, "panel-material-ui: the busy line has no name and stays"),
        "empty-heading": ("<h5[^>]*>&nbsp;</h5>", 2, "panel-material-ui: a heading keeps room below the bar"),
        "heading-order": ("<h5[^>]*>&nbsp;</h5>", 2, "the same heading"),
        "region": ("data-pmui-layer", 1, "panel-material-ui: the layer of its menus lies outside of the landmarks"),
        "aria-dialog-name": ("MuiPaper-root", 1, "panel-material-ui: the drawer of a phone is a dialog without a name"),
    }
)
"""Rule -> pattern of what breaks it, how often at most, whose fault."""

VIOLATIONS = """async () => (await axe.run(document, {resultTypes: ["violations"]})).violations
    .flatMap(v => v.nodes.map(n => [v.id, n.html, (n.any[0] ?? n.all[0] ?? n.none[0])?.message ?? ""]))"""

PICTURES = """() => new Promise((done) => {
  const next = (left) => left ? requestAnimationFrame(() => next(left - 1)) : done()
  next(20)
})"""
"""Waits for twenty pictures: a change of colour takes a quarter of a second."""

FOCUSED = """() => {
  let e = document.activeElement
  while (e?.shadowRoot?.activeElement) e = e.shadowRoot.activeElement
  const root = e.getRootNode()
  const by = (e.getAttribute("aria-labelledby") ?? "").split(" ").map((id) => id && root.getElementById(id)?.textContent)
  const own = [e.getAttribute("aria-label"), e.textContent, ...[...(e.labels ?? [])].map((l) => l.textContent), e.title]
  const style = getComputedStyle(e)
  const ring = style.outlineStyle !== "none" || e.matches(".Mui-focusVisible")
    || e.closest(".Mui-focused, .Mui-focusVisible") !== null
  return {name: [...by, ...own].find((text) => text?.trim()) ?? "", tag: e.tagName, ring}
}"""

FITS = "width => document.documentElement.scrollWidth <= width && window.innerWidth === width"

BELOW = """([upper, lower]) => {
  const found = {}
  const walk = (root) => { for (const it of root.querySelectorAll("*")) {
    const name = it.tagName === "H2" ? it.textContent : it.getAttribute("role") === "figure" && it.getAttribute("aria-label")
    const box = it.getBoundingClientRect()
    if (name && box.height) found[name] = box
    if (it.shadowRoot) walk(it.shadowRoot)
  } }
  walk(document)
  return found[upper] && found[lower] && found[upper].bottom <= found[lower].top
}"""

MODELS = "[...Bokeh.index.roots[0].model.document.all_models]"

BROKEN = """
from wfsobs.app.serve import session_page

def build(post):
    raise RuntimeError("no such mirror")

session_page(build).servable()
"""


def theme(page: Page) -> None:
    """Switch the theme and wait for the new colours."""
    before = page.evaluate("() => getComputedStyle(document.body).backgroundColor")
    page.get_by_role("button", name=re.compile("theme", re.I)).click()
    until(page, "before => getComputedStyle(document.body).backgroundColor !== before", arg=before)
    until(page, "() => document.getAnimations().every(a => a.playState !== 'running')")


def violations(page: Page) -> tuple[list[str], Counter[str]]:
    """What axe finds wrong, and how often what is allowed."""
    allowed: Counter[str] = Counter()
    faults = []
    for rule, html, message in page.evaluate(VIOLATIONS):
        if rule in ALLOWED and re.search(ALLOWED[rule][0], html):
            allowed[rule] += 1
        else:
            faults.append(f"{rule}: {message}: {html[:300]}")
    return faults, allowed


def fits(page: Page, width: int) -> None:
    """Wait until nothing is wider than the window."""
    until(page, FITS, arg=width)


def focused(page: Page, key: str = "Tab") -> dict[str, Any]:
    page.keyboard.press(key)
    return page.evaluate(FOCUSED)


def history_is_accessible(page: Page, width: int) -> None:
    """Open the sheet of the history, compare with a run in it, and close it."""
    sheet, before = page.get_by_role("dialog", name="History"), page.evaluate(f"() => {MODELS}.length")
    expect(sheet).to_have_count(0)
    page.get_by_role("button", name="History").click()
    until(page, f"before => {MODELS}.length > before", arg=before)  # the sheet is made when it is opened
    sheet.get_by_role("listitem").get_by_role("checkbox").check()
    expect(page.get_by_text("Compared as A")).to_be_visible()
    accessible(page)
    fits(page, width)
    if width > 1000:
        page.keyboard.press("Escape")
        theme(page)
        page.get_by_role("button", name="History").click()
        expect(sheet).to_be_visible()
        accessible(page)
    page.keyboard.press("Escape")
    expect(sheet).to_be_hidden()


@pytest.mark.parametrize("width", [1400, 390], ids=["wide", "phone"])
def test_accessibility_and_no_box_over_another(open_page: Any, server: Any, width: int) -> None:
    first = 820 if width > 1000 else width  # a wide window has been one of a tablet
    page = open_page(first, 900, url=server.url + QUICK)
    fits(page, first)
    page.set_viewport_size({"width": width, "height": 900})
    page.evaluate(files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8"))
    accessible(page)
    fits(page, width)
    history_is_accessible(page, width)
    for name, start, done in (
        ("Identify", "Identify the record", "Identified in tip"),
        ("Tune", "Start tuning", "Before and after"),
    ):
        page.get_by_role("button", name=name, exact=True).click()
        if name == "Tune":
            page.get_by_role("textbox", name="Evaluations").fill("2")
            page.keyboard.press("Enter")
        page.get_by_role("button", name=start).click()
        expect(page.get_by_role("region", name=done)).to_be_visible()
        accessible(page)
        fits(page, width)
    page.set_viewport_size({"width": width, "height": 600})  # boxes that are higher than the window
    page.get_by_role("button", name="Closed loop", exact=True).click()
    for upper, lower in (("Residual, zoomed", "Controllers"), ("Rejection and noise transfer", "Controllers")):
        until(page, BELOW, arg=[upper, lower])
    page.get_by_role("button", name="Explore", exact=True).click()
    for upper, lower in (("Turbulence spectrum", "Vibration, tip"), ("Vibration spectrum", "RMS errors")):
        until(page, BELOW, arg=[upper, lower])


def accessible(page: Page) -> None:
    """Nothing wrong but what is allowed."""
    end = time.monotonic() + 60
    faults, allowed = violations(page)
    while faults and time.monotonic() < end:  # colours may still be on their way to the other theme, a step with each picture
        page.evaluate(PICTURES)
        faults, allowed = violations(page)
    assert not faults, "\n".join(faults)
    assert {rule: n for rule, n in allowed.items() if n > ALLOWED[rule][1]} == {}


@pytest.fixture(scope="module")
def opened(open_shared: Any, server: Any) -> Page:
    """A page that the tests below share."""
    return open_shared(url=server.url + QUICK)


@pytest.fixture
def page(opened: Page) -> Iterator[Page]:
    """That page with the settings of the preset, from whose beginning the Tab key goes on."""
    answered(opened)
    trace = opened.get_by_role("figure", name="Turbulence time trace", exact=True)
    expect(trace).to_be_visible()  # the test before may have left another page
    opened.evaluate("() => { document.body.tabIndex = -1; document.body.focus(); scrollTo(0, 0) }")
    yield opened
    undo = opened.get_by_role("button", name="Undo", exact=True)
    while opened.evaluate(CHANGED):  # and no further: before the link there was the preset
        undo.evaluate("it => it.click()")  # which does nothing where there is nothing to undo any more
        answered(opened)


def test_every_stop_of_the_tab_key_has_a_name_and_shows(page: Page) -> None:
    stops = [focused(page) for _ in range(90)]
    names = [stop["name"] for stop in stops]
    assert [stop for stop in stops if stop["tag"] != "BODY" and not stop["name"]] == []
    assert [stop for stop in stops if stop["tag"] != "BODY" and not stop["ring"]] == []
    order = [next(i for i, name in enumerate(names) if part in name) for part in ("drawer", "Run", "Wind speed", "Peak 1: f")]
    assert order == sorted(order), "the drawer from top to bottom"
    assert any("Truth" in name for name in names[:60]), "and past it to the figures"


def test_the_keyboard_does_it_all(page: Page) -> None:
    assert focused(page)["name"] == "Skip to figures" and "drawer" in focused(page)["name"]
    page.keyboard.press("Enter")
    opener = page.get_by_role("button", name="Open drawer")
    expect(opener).to_be_visible()
    opener.focus()
    page.keyboard.press("Space")
    expect(page.get_by_role("button", name="Close drawer")).to_be_visible()

    page.get_by_role("slider", name=re.compile("Wind speed")).focus()
    page.keyboard.press("ArrowRight")
    expect(page.get_by_role("textbox", name="m/s")).not_to_have_value("15")

    cell = page.locator('input[data-cell="0.frequency"]')
    cell.focus()
    page.keyboard.press("ControlOrMeta+a")
    page.keyboard.type("7.5")
    assert focused(page)["name"] == "Peak 1: ξ", "Tab takes the value over and goes on"
    expect(page.get_by_text(re.compile("changed: (?=.*Wind speed)(?=.*Peaks)"))).to_be_visible()
    expect(cell).to_have_value("7.5")

    card = page.get_by_role("button", name=re.compile("^LGS KF")).first  # always shown at first
    for key, pressed in (("Enter", "false"), ("Space", "true")):
        card.focus()
        page.keyboard.press(key)
        expect(card).to_have_attribute("aria-pressed", pressed)
        assert "LGS KF" in page.evaluate(FOCUSED)["name"], "the focus stays"


ACTIVE = """() => {
  let e = document.activeElement
  while (e?.shadowRoot?.activeElement) e = e.shadowRoot.activeElement
  const name = e.getAttribute("aria-label") ?? e.textContent
  return {name, role: e.getAttribute("role"), selected: e.getAttribute("aria-selected")}
}"""


def press(page: Page, key: str) -> dict[str, Any]:
    page.keyboard.press(key)
    return page.evaluate(ACTIVE)


def step_to(page: Page, name: str, key: str = "Tab", most: int = 60) -> int:
    """Go on with a key until the focus is on something of that name; how many stops that took."""
    for count in range(1, most + 1):
        if name in press(page, key)["name"]:
            return count
    raise AssertionError(f"no {name!r} in {most} stops")


def chosen(page: Page) -> Any:
    """The item that has the focus, once the list is open."""
    found = f"() => {{ const it = ({ACTIVE})(); return it.selected === 'true' && it }}"
    return until(page, found).json_value()


def goes_to(page: Page, key: str, name: str) -> None:
    """Press a key, and wait until the focus is on what is called so."""
    page.keyboard.press(key)
    until(page, f"name => ({ACTIVE})().name === name", arg=name)


def test_a_list_opens_and_chooses_by_keyboard(page: Page) -> None:
    preset = page.get_by_role("combobox", name="Preset")
    expect(preset).to_have_text("Paper")
    step_to(page, "Paper")
    for key in ("ArrowUp", "ArrowDown", "Space", "Enter"):
        press(page, key)
        assert chosen(page) == {"name": "Paper", "role": "option", "selected": "true"}
        options = page.get_by_role("listbox").get_by_role("option")
        expect(options.first).to_have_attribute("aria-selected", "true")
        expect(page.get_by_role("listbox").get_by_role("option", selected=True)).to_have_count(1)
        goes_to(page, "ArrowDown", "Strong turbulence")
        page.keyboard.press("Enter" if key == "Enter" else "Escape")
        expect(page.get_by_role("listbox")).to_have_count(0)
        expect(preset).to_have_attribute("aria-expanded", "false")
        expect(preset).to_have_text("Strong turbulence" if key == "Enter" else "Paper")
        expect(preset).to_be_focused()
    page.get_by_role("button", name="Undo", exact=True).click()
    expect(preset).to_have_text("Paper")


def test_the_lists_of_other_pages_open_by_keyboard(page: Page) -> None:
    step_to(page, "Explore")
    step_to(page, "Tune", "ArrowRight", 3)
    press(page, "Enter")
    observer = page.get_by_role("combobox", name="Observer")
    expect(observer).to_be_visible()
    step_to(page, "File")
    step_to(page, "Vibration", most=30)
    press(page, "Enter")
    source = page.get_by_role("combobox", name="Source").first  # where the vibration comes from
    source.focus()
    expect(source).to_be_focused()
    press(page, "Enter")
    assert chosen(page)["name"] == "peaks"
    press(page, "Escape")
    expect(page.locator(".MuiMenu-list")).to_have_count(0)  # while it fades the Tab key goes to it
    observer.focus()
    expect(observer).to_be_focused()
    press(page, "Enter")
    assert chosen(page)["name"] == "Online GPR"
    press(page, "Escape")
    expect(page.locator(".MuiMenu-list")).to_have_count(0)
    page.get_by_role("button", name="Explore", exact=True).click()


def test_the_figures_are_not_far(page: Page) -> None:
    goes_to(page, "Tab", "Skip to figures")
    expect(page.get_by_role("button", name="Skip to figures")).to_be_in_viewport()
    press(page, "Enter")
    assert step_to(page, "Truth", most=10), "a card of the first strip"
    stops = len(carded("turbulence")) + 4  # a card each, three buttons below them, and the figure
    assert step_to(page, "Turbulence time trace", most=stops), "a figure has a name"
    for name in ("Page", "Mode", "Unit", "Show", "Spectrum"):
        expect(page.get_by_role("group", name=name, exact=True)).to_be_visible()
    for name in ("Turbulence time trace", "Turbulence spectrum", "Vibration time trace", "Vibration spectrum"):
        expect(page.get_by_role("figure", name=name, exact=True)).to_be_visible()


def test_a_table_is_one_stop_and_keeps_the_focus(page: Page) -> None:
    step_to(page, "Peak 1: f")
    goes_to(page, "ArrowDown", "Peak 2: f [Hz]")
    assert step_to(page, "Remove peak 2", most=5)
    value = page.locator('[data-cell="2.frequency"]').input_value()
    press(page, "Enter")
    expect(page.locator('input[data-cell="1.frequency"]')).to_have_value(value)
    until(page, f"() => ({ACTIVE})().name === 'Remove peak 2'")  # the next one
    assert step_to(page, "Add peak", most=1)
    press(page, "Enter")
    until(page, f"() => ({ACTIVE})().name === 'Peak 15: f [Hz]'")


def test_a_tip_comes_with_the_focus(page: Page) -> None:
    step_to(page, "Wind speed")
    tip = page.get_by_role("tooltip").filter(has_text=re.compile("wind", re.I))
    expect(tip.first).to_be_visible()
    press(page, "Tab")
    expect(tip.first).to_be_hidden()


def test_a_page_that_cannot_be_built_says_so(open_page: Any, make_server: Any, tmp_path: Path) -> None:
    script = tmp_path / "broken.py"
    script.write_text(BROKEN)
    server = make_server(["-m", "panel", "serve", str(script), "--port", "{port}", "--liveness"], tmp_path / "log", "/broken")
    try:
        page = open_page(url=server.url, wait=False)
        expect(page.get_by_role("heading", name="wfsobs could not start")).to_be_visible()
        expect(page.get_by_text("RuntimeError: no such mirror")).to_be_visible()
        assert len(server.errors(0)) == 1, "the log has the traceback"
    finally:
        server.close()
