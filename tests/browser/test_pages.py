"""The table, the verdict above it, numbers read off the figures, the pinned run, and the pages beside the first."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.browser.conftest import carded, finished, until
from wfsobs.app.display import AT_LIMIT
from wfsobs.observers.base import TARGETS

MODELS = "[...Bokeh.index.roots[0].model.document.all_models]"
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
    until(page, f"() => ({ERRORS})().every((errors) => errors.every((error, i) => i === 0 || errors[i - 1] <= error))")


def sentences(page: Page, target: str) -> Locator:
    return page.locator("p.verdict").nth(TARGETS.index(target))


def smallest(page: Page, target: str) -> tuple[str, float]:
    """Label and error of the row that the table marks."""
    row = page.locator(f'tr[data-target="{target}"]', has=page.locator(".smallest"))
    return row.locator("th").inner_text().removesuffix(AT_LIMIT).strip(), float(row.locator("td").first.inner_text().split()[-1])


def test_the_verdict_names_the_smallest_error_of_the_table_in_the_mode_and_unit_shown(wide: Page) -> None:
    page = wide
    expect(page.locator(".seeds")).to_have_text("one record")  # the verdict on the record alone
    for mode, unit in (("Tip", "nm"), ("Tilt", "nm"), ("Tilt", "mas")):
        page.get_by_role("button", name=mode, exact=True).click()
        page.get_by_role("button", name=unit, exact=True).click()
        for target in ("turbulence", "vibration"):
            start = sentences(page, target)
            expect(page.get_by_role("heading", name=f"{target.capitalize()}, {mode.lower()}", exact=True)).to_be_visible()
            expect(start).to_contain_text(re.compile(rf" {unit}[,.]"))
            expect(page.get_by_role("columnheader", name=f"RMS error [{unit}]", exact=True)).to_be_visible()
            expect(page.locator("th.target", has_text=f"{target.capitalize()}, {mode.lower()}")).to_be_visible()
            label, error = smallest(page, target)
            expect(start).to_contain_text(f": {label} ")
            said = re.search(rf": {re.escape(label)} ([\d.]+) ± [\d.]+ {unit}[,.]", start.inner_text())
            # Three digits either way.
            assert said and abs(float(said[1]) / error - 1.0) < 0.006
    expect(page.locator("table.rms").get_by_text("best", exact=True)).to_have_count(0)  # one record cannot tell
    expect(sentences(page, "vibration")).to_contain_text(
        re.compile("than assuming no vibration: (their models have|its model has) one of")
    )
    # Known a moment later, from the error budgets.
    expect(sentences(page, "vibration")).to_contain_text(re.compile(r"% of (their|its) error comes from unmodelled peaks"))
    for name in ("Tip", "nm"):
        page.get_by_role("button", name=name, exact=True).click()
    expect(page.get_by_role("columnheader", name="RMS error [nm]", exact=True)).to_be_visible()


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
    until(page, drawn, arg=[before, LINES_OF_FIGURES])
    expect(page.get_by_role("heading", name="RMS errors")).to_be_hidden()
    page.screenshot(path=tmp_path / "figures.png")
    turn(page, "Explore")
    expect(page.get_by_role("heading", name="RMS errors")).to_be_visible()
    expect(page.get_by_role("heading", name="Figure 5 of the paper")).to_be_hidden()


PAINTED = """name => [...Bokeh.index.query((it) => it.model.type === "Figure" && it.model.name === name)]
    .some((it) => it.has_finished())"""
"""Whether a figure stands, so that it hears of the pointer."""


RENAMED = """() => {
    const all = Bokeh.documents.flatMap((it) => [...it.all_models]).filter((it) => it.data?.labels)
    for (const {data} of all) data.labels = {...data.labels, "kf-lgs": "<i>LGS & KF"}
}"""


def test_values_at_the_pointer_and_by_the_arrow_keys(wide: Page) -> None:
    page = wide
    box = page.locator(".values")
    figure = page.get_by_role("figure", name="Turbulence time trace")
    until(page, PAINTED, arg="Turbulence time trace")
    at = figure.bounding_box()
    page.mouse.move(at["x"] + at["width"] / 2, at["y"] + at["height"] / 2)
    expect(box).to_have_text(re.compile(r"time\s*[\d.]+ s.*LGS KF\s*[−\d.]+ nm", re.S))
    expect(box).not_to_contain_text("Adaptive KF")  # hidden
    page.mouse.move(at["x"] + at["width"] / 2, at["y"] - 60)
    expect(box).to_be_hidden()
    page.evaluate(RENAMED)
    page.mouse.move(at["x"] + at["width"] / 2, at["y"] + at["height"] / 2)
    expect(box).to_be_visible()
    expect(box).to_contain_text("<i>LGS & KF")
    page.mouse.wheel(0, 3000)  # away from the figure
    expect(box).to_be_hidden()
    expect(figure).not_to_be_in_viewport()  # the page scrolls a while after the wheel has been heard
    page.mouse.move(1, 1)
    figure.scroll_into_view_if_needed()
    figure.locator(".bk-events").focus()
    page.keyboard.press("ArrowRight")
    expect(page.get_by_role("status").filter(has_text=re.compile(r"(frequency|time)\s*[\d.]+ (Hz|s)"))).to_be_visible()
    before = box.inner_text()
    page.keyboard.press("Shift+ArrowRight")
    expect(box).not_to_have_text(before)
    page.keyboard.press("Escape")
    expect(box).to_be_hidden()


def test_a_brush_over_time_and_over_a_band(wide: Page) -> None:
    page = wide
    line = page.locator("p.stretch").filter(has_text="Online GPR")
    figure = page.get_by_role("figure", name="Vibration spectrum")
    figure.scroll_into_view_if_needed()
    until(page, PAINTED, arg="Vibration spectrum")
    at = figure.bounding_box()
    y = at["y"] + at["height"] / 2
    page.mouse.move(at["x"] + 0.5 * at["width"], y)
    expect(page.locator(".values")).to_contain_text("frequency")
    page.mouse.down()
    page.mouse.move(at["x"] + 0.7 * at["width"], y, steps=5)
    page.mouse.up()
    expect(line.filter(has_text="Hz")).to_have_text(re.compile(r"RMS error, \d+(\.\d+)? – \d+(\.\d+)? Hz: .*[a-z] [\d.]+ nm"))
    points = """() => [...Bokeh.index.roots[0].model.document.all_models]
        .filter(m => m.type === "GlyphRenderer" && m.name === "gpr-online" && m.data_source.data.y)[0].data_source.data.y[0]"""
    before = page.evaluate(points)
    page.get_by_role("checkbox", name="Spectra of the window").check()
    until(page, f"before => ({points})() !== before", arg=before)
    figure.scroll_into_view_if_needed()
    at = figure.bounding_box()
    page.mouse.dblclick(at["x"] + 0.6 * at["width"], at["y"] + at["height"] / 2)
    expect(line.filter(has_text="Hz")).to_have_count(0)  # all frequencies again
    page.get_by_role("checkbox", name="Spectra of the window").uncheck()


def test_cumulative_rms(wide: Page) -> None:
    page = wide
    assert "cumulative" not in page.evaluate(LABELS)
    turn(page, "Cumulative rms")
    until(page, f"({LABELS})().includes('cumulative rms of error, tip [nm]')")
    turn(page, "Signal")
    until(page, f"({LABELS})().includes('cumulative rms, tip [nm]')")
    turn(page, "PSD")
    turn(page, "Error")
    until(page, f"({LABELS})().includes('PSD of error, tip')")


def test_pin_and_compare(wide: Page) -> None:
    page = wide
    before = cells(page, "kf-lgs", "turbulence")[0].split()[-1]
    page.get_by_role("button", name="Pin this run to compare others with it").click()
    legend = page.get_by_role("status").filter(has_text="Compared with, faint in the figures")
    expect(legend).to_contain_text("since then: the same settings")
    for i in range(2):
        page.get_by_role("button", name=re.compile("^All .* observers$")).first.click()
        page.get_by_role("button", name="Show all lines").nth(i).click()
    # a trace of errors has no line of the truth, their spectra have
    expected = ",".join(map(str, sorted([*IN_EACH, *(n - 1 for n in IN_EACH)])))
    until(page, f"({PINNED})().sort((a, b) => a - b).join() === '{expected}'")
    box = page.get_by_role("textbox", name="m/s")
    box.fill("30")
    box.press("Enter")
    expect(legend).to_contain_text("Wind speed V₀ 15 → 30 m/s")
    expect(page.get_by_role("columnheader", name="A [nm]", exact=True)).to_be_visible()
    row = page.locator('tr[data-observer="kf-lgs"][data-target="turbulence"] td')
    expect(row.nth(1)).to_have_text(re.compile(r"^(?!\+0\.0 %)[+−]\d.* %\s+\d.*$"))  # nor a dash, of one at work
    finished(page)  # rows change places until then, and a row is found before it is read
    value, compared = (text.split() for text in row.all_inner_texts()[:2])
    change, _, pinned = compared
    assert pinned == before
    assert abs(float(change.replace("−", "-")) - 100 * (float(value[-1]) / float(pinned) - 1)) < 1
    card = page.get_by_role("button", name=re.compile("^LGS")).first.locator(".compared")
    expect(card).to_have_text(f"{before} {change} %")
    page.get_by_role("button", name="Unpin: compare with no other run").click()
    expect(page.get_by_role("columnheader", name="A [nm]", exact=True)).to_have_count(0)
    until(page, f"({PINNED})().every(n => n === 0)")
    page.get_by_role("button", name="Undo", exact=True).click()
    expect(box).to_have_value("15")


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
