"""The pages beside the first, the pinned run and the cumulative spectra, in a browser."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import QUICK, carded
from wfsobs.observers.base import TARGETS

MODELS = "[...Bokeh.index.roots[0].model.document._all_models.values()]"
LINES = f"""() => {MODELS}.filter(m => m.type === "GlyphRenderer" && m.glyph.type === "Line")
    .map(m => [m.id, m.data_source.get_length()])"""
PINNED = f"""() => {MODELS}.filter(m => m.type === "GlyphRenderer" && m.name === "compared")
    .map(m => m.data_source.data.xs.length)"""
LABELS = f"""() => {MODELS}.filter(m => m.type === "LinearAxis" || m.type === "LogAxis").map(m => m.axis_label).join()"""
ERRORS = """() => {
  const found = (root) => [...root.querySelectorAll("*")].flatMap((it) => [
    ...it.matches('table.rms tr[data-target="turbulence"]:not([data-observer^=bound])') ? [it] : [],
    ...it.shadowRoot ? found(it.shadowRoot) : []])
  return [...new Set(found(document).map((row) => row.closest("tbody")))].map((body) => [...body.rows].slice(1)
    .map((row) => Number(row.cells[1].textContent.trim().split(/\\s/).at(-1))))
}"""
"""Of the observers of the turbulence, in the order of the table."""
IN_EACH = [1 + len(carded(target)) for target in TARGETS]
ALL_LINES = 2 * sum(IN_EACH)
LINES_OF_FIGURES = 2 * 2 + 2 * 2 + 2 * 4 + 3 * 4


def turn(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def cells(page: Page, observer: str, target: str) -> list[str]:
    return page.locator(f'tr[data-observer="{observer}"][data-target="{target}"] td').all_inner_texts()


def no_wider_than(page: Page, width: int) -> None:
    page.wait_for_function("width => document.documentElement.scrollWidth <= width", arg=width)


@pytest.fixture(scope="module")
def wide(open_shared: Any) -> Page:
    """A page for the tests below, in this order."""
    return open_shared()


def test_the_table_is_grouped_by_prior_knowledge(wide: Page) -> None:
    page = wide
    expect(page.get_by_role("columnheader", name=re.compile("Predicted sigma"))).to_be_visible()
    table = page.get_by_role("region", name="RMS errors")
    assert table.evaluate("it => it.scrollWidth <= it.clientWidth"), "all columns at 1400 pixels, the drawer open"
    expect(table.get_by_role("rowheader", name="Prior knowledge: none")).to_have_count(3)
    page.wait_for_function(f"() => ({ERRORS})().every((errors) => errors.every((error, i) => i === 0 || errors[i - 1] <= error))")


def test_the_figures_of_the_paper(wide: Page, tmp_path: Path) -> None:
    page = wide
    before = [name for name, _ in page.evaluate(LINES)]
    assert 0 < len(before) < ALL_LINES, "lines of cards that are not shown, and figures of other pages, are not made yet"
    turn(page, "Paper figures")
    for number in ("4a", "4b", "5", "6"):
        expect(page.get_by_role("heading", name=f"Figure {number} of the paper")).to_be_visible()
    drawn = f"""([before, n]) => {{
        const made = ({LINES})().filter(([name, length]) => !before.includes(name))
        return made.length === n && made.every(([name, length]) => length > 100)
    }}"""
    page.wait_for_function(drawn, arg=[before, LINES_OF_FIGURES])
    expect(page.get_by_role("heading", name="RMS errors")).to_be_hidden()
    page.screenshot(path=tmp_path / "figures.png")
    turn(page, "Explore")
    expect(page.get_by_role("heading", name="RMS errors")).to_be_visible()
    expect(page.get_by_role("heading", name="Figure 5 of the paper")).to_be_hidden()


def test_cumulative_rms(wide: Page) -> None:
    page = wide
    assert "cumulative" not in page.evaluate(LABELS)
    turn(page, "Cumulative rms")
    page.wait_for_function(f"({LABELS})().includes('cumulative rms of error, tip [nm]')")
    turn(page, "Signal")
    page.wait_for_function(f"({LABELS})().includes('cumulative rms, tip [nm]')")


def test_the_model(wide: Page) -> None:
    page = wide
    turn(page, "Model")
    expect(page.get_by_role("heading", name="State space: equations 6 and 7")).to_be_visible()
    expect(page.get_by_text("Poles of one cycle, 5 ms").first).to_be_visible()
    coefficient = page.get_by_role("cell", name="1.987308")
    expect(coefficient).to_be_visible()
    box = page.get_by_role("textbox", name="m/s")
    box.fill("30")
    box.press("Enter")
    expect(coefficient).to_have_count(0)


def test_by_keyboard_on_a_phone(open_page: Any, server: Any) -> None:
    page = open_page(390, 844, url=server.url + QUICK)
    expect(page.get_by_role("button", name="Open drawer")).to_be_visible()
    button = page.get_by_role("button", name="Model", exact=True)
    button.focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="State space: equations 6 and 7")).to_be_visible()
    no_wider_than(page, 390)
    page.get_by_role("button", name="Paper figures", exact=True).focus()
    page.keyboard.press("Space")
    expect(page.get_by_role("heading", name="Figure 4a of the paper")).to_be_visible()
    no_wider_than(page, 390)


def test_pin_and_compare(open_page: Any) -> None:
    page = open_page()
    before = cells(page, "kf-lgs", "turbulence")[0].split()[-1]
    page.get_by_role("button", name="Pin this run to compare others with it").click()
    legend = page.get_by_role("status").filter(has_text="Compared with, faint in the figures")
    expect(legend).to_contain_text("since then: the same settings")
    for i in range(2):
        page.get_by_role("button", name=re.compile("^All .* observers$")).first.click()
        page.get_by_role("button", name="Show all lines").nth(i).click()
    # a trace of errors has no line of the truth, their spectra have
    expected = ",".join(map(str, sorted([*IN_EACH, *(n - 1 for n in IN_EACH)])))
    page.wait_for_function(f"({PINNED})().sort((a, b) => a - b).join() === '{expected}'")
    box = page.get_by_role("textbox", name="m/s")
    box.fill("30")
    box.press("Enter")
    expect(legend).to_contain_text("Wind speed V₀ 15 → 30 m/s")
    expect(page.get_by_role("columnheader", name="A [nm]", exact=True)).to_be_visible()
    row = page.locator('tr[data-observer="kf-lgs"][data-target="turbulence"] td')
    expect(row.nth(1)).to_have_text(re.compile(r"^(?!\+0\.0 %)[+−]\d.* %\s+\d.*$"))  # nor a dash, of one at work
    value, compared = (text.split() for text in row.all_inner_texts()[:2])
    change, _, pinned = compared
    assert pinned == before
    assert abs(float(change.replace("−", "-")) - 100 * (float(value[-1]) / float(pinned) - 1)) < 1
    card = page.get_by_role("button", name=re.compile("^LGS")).first.locator(".compared")
    expect(card).to_have_text(f"{before} {change} %")
    page.get_by_role("button", name="Unpin: compare with no other run").click()
    expect(page.get_by_role("columnheader", name="A [nm]", exact=True)).to_have_count(0)
    page.wait_for_function(f"({PINNED})().every(n => n === 0)")
