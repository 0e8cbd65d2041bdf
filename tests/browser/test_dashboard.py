"""What a user sees and does."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import QUICK, Server, answered, carded, eventually, until
from wfsobs.app.style import look
from wfsobs.observers.base import TARGETS
from wfsobs.scenario.presets import PRESETS

POINTS = """() => [...Bokeh.index.roots[0].model.document.all_models]
    .filter(m => m.type === "GlyphRenderer" && m.glyph.type === "Line" && m.visible).map(m => m.data_source.get_length())"""


def finished(page: Page) -> None:
    page.locator("[role=status]", has_text="Done in").first.wait_for(state="attached")


def other_than(value: str) -> re.Pattern[str]:
    """A cell whose number is not this one, nor the dash of an observer that is still at work."""
    return re.compile(rf"^(?!(.*\s)?{re.escape(value)}$).*\d$", re.S)


def row(page: Page, observer: str, target: str) -> list[str]:
    return page.locator(f'tr[data-observer="{observer}"][data-target="{target}"] td').all_inner_texts()


def rms(page: Page, observer: str = "kf-lgs", target: str = "turbulence") -> str:
    return row(page, observer, target)[0].split()[-1]


def still(page: Page) -> None:
    """Wait until nothing moves or changes its colour any more."""
    until(page, "() => document.getAnimations().every(a => a.playState !== 'running')")


def wind(page: Page) -> Any:
    return page.get_by_role("slider", name=re.compile("Wind speed"))


def shot(page: Page, directory: Path, name: str) -> None:
    path = directory / f"{name}.png"
    page.screenshot(path=path)
    assert path.stat().st_size > 20_000, "a page with something on it"


DRAWER = """() => {
  window.drawerSeen = 0
  const find = (root) => {
    for (const it of root.querySelectorAll("*")) {
      const found = it.matches(".sidebar") ? it : it.shadowRoot && find(it.shadowRoot)
      if (found) return found
    }
  }
  const look = () => {
    const it = find(document)
    if (it && it.checkVisibility({visibilityProperty: true}) && it.getBoundingClientRect().right > 0) window.drawerSeen += 1
    if (!window.drawerTold) requestAnimationFrame(look)
  }
  look()
}"""
"""Counts the frames in which the drawer is seen, from the first on, until that is told."""


@pytest.fixture(scope="module")
def wide(open_shared: Any) -> Page:
    """A page that is looked at by the tests below, in this order."""
    return open_shared(script=f"({DRAWER})()")


@pytest.fixture(scope="module")
def phone(open_shared: Any) -> Page:
    """As `wide`."""
    return open_shared(390, 844, script=f"({DRAWER})()")


@pytest.mark.parametrize(("name", "seen"), [("phone", False), ("wide", True)])
def test_the_drawer_of_a_phone_is_closed_from_the_first_frame_on(request: pytest.FixtureRequest, name: str, seen: bool) -> None:
    page = request.getfixturevalue(name)
    if seen:
        until(page, "() => window.drawerSeen > 0")
    assert bool(page.evaluate("() => { window.drawerTold = true; return window.drawerSeen }")) == seen


NAMES = """() => {
  const found = (root) => [...root.querySelectorAll("*")].flatMap((it) => [
    ...it.matches(".card .name") ? [it] : [], ...it.shadowRoot ? found(it.shadowRoot) : []])
  return found(document).filter((it) => it.offsetParent).map((it) => [it.textContent, it.scrollWidth - it.clientWidth])
}"""


@pytest.mark.parametrize("name", ["wide", "phone"])
def test_the_name_on_every_card_is_readable(request: pytest.FixtureRequest, name: str) -> None:
    readable = f"() => {{ const all = ({NAMES})(); return all.length > 6 && all.every(([, beyond]) => beyond <= 0) }}"
    request.getfixturevalue(name).wait_for_function(readable)


def test_phone(phone: Page, tmp_path: Path) -> None:
    page = phone
    expect(page.get_by_role("button", name="Open drawer")).to_be_visible()
    still(page)
    until(page, "() => document.documentElement.scrollWidth <= 390")
    shot(page, tmp_path, "phone")
    page.get_by_role("button", name="Open drawer").click()
    expect(wind(page)).to_be_visible()


def test_a_phone_shows_which_page_a_link_has_opened(open_page: Any, server: Server) -> None:
    page = open_page(390, 844, f"{server.url}{QUICK}&view.page=model")
    expect(page.get_by_role("button", name="Model", exact=True)).to_be_in_viewport()


def test_first_paint(wide: Page, tmp_path: Path) -> None:
    page = wide
    for observer, target in (
        ("kf-lgs", "turbulence"),
        ("multirate", "turbulence"),
        ("gpr-offline", "vibration"),
        ("gpr-online", "vibration"),
    ):
        value, relative, lag, seconds, factor, predicted = row(page, observer, target)
        value, relative = value.split()[-1], relative.split()[-1]
        assert float(factor) >= 0 and float(predicted) > 0 and float(value) > 0
        # Two decimals, of two numbers with three digits.
        of = page.locator(".strip").nth(TARGETS.index(target)).locator(".card[data-name=truth] .value")
        assert float(relative) == pytest.approx(float(value) / float(of.inner_text()), abs=0.005 + 0.01 * float(relative))
        assert lag and float(seconds) > 0
    expect(page.locator(".card")).to_have_count(sum(1 + len(carded(target)) for target in TARGETS))
    lines = page.locator(".card[aria-pressed=true]").count()
    assert 2 * len(TARGETS) < lines < 20, "the truth and the few observers that matter"
    drawn = f"n => {{ const all = ({POINTS})(); return all.length === n && Math.min(...all) > 300 }}"
    until(page, drawn, arg=2 * lines)  # every line that the cards show has points, in both figures
    shot(page, tmp_path, "light")


ONLINE = """() => [...Bokeh.index.roots[0].model.document.all_models]
    .filter(m => m.type === "ColumnDataSource" && m.data["gpr-online"])
    .map(m => [...m.data["gpr-online"]].filter(Number.isFinite).length / m.data["gpr-online"].length)[0]"""


VISIBLE = """() => [...new Set([...Bokeh.index.roots[0].model.document.all_models]
    .filter(m => m.type === "GlyphRenderer" && m.visible && m.glyph.type === "Line").map(m => m.name))].sort()"""
"""Names of the lines that a figure shows."""


def vibration_card(page: Page, label: str) -> Any:
    return page.locator(".strip", has_text="Online GPR").get_by_role("button", name=label)


def test_a_double_click_shows_a_line_alone(wide: Page) -> None:
    page = wide
    pressed = page.locator(".card[aria-pressed=true]").evaluate_all(
        "all => [...new Set(all.map((it) => it.dataset.name))].sort()"
    )
    assert "gpr-online" in pressed and not {"multirate", "butterworth-ol"} & set(pressed), "the few that matter at first"
    few = [name for name in pressed if name != "truth"]  # which has no error
    until(page, f"few => few.every((name) => ({VISIBLE})().includes(name))", arg=few)
    few = page.evaluate(VISIBLE)
    assert set(few) <= set(pressed) and "gpr-offline" not in few
    for card in page.locator(".card[data-name=kf-lgs]").all():
        card.dblclick()
    until(page, f"() => ({VISIBLE})().join() === 'kf-lgs'")
    expect(vibration_card(page, "Online GPR")).to_have_attribute("aria-pressed", "false")
    page.keyboard.press("s")  # the card has the focus
    until(page, f"() => ({VISIBLE})().includes('gpr-online')")
    assert "gpr-offline" not in page.evaluate(VISIBLE)  # those before, not all
    card = vibration_card(page, "LGS KF")
    for pressed in ("false", "true"):  # alone, and those before again
        card.dblclick()
        expect(vibration_card(page, "Online GPR")).to_have_attribute("aria-pressed", pressed)
    for i in range(2):
        page.get_by_role("button", name=re.compile("^All .* observers$")).nth(i).click()
        page.get_by_role("button", name="Main observers").click()
    until(page, f"few => ({VISIBLE})().join() === few.join()", arg=few)


def test_a_bad_value_shows_inline_and_leaves_the_result(wide: Page) -> None:
    page = wide
    before = rms(page)
    box = page.get_by_role("textbox", name="m/s")
    box.fill("200")
    box.press("Enter")
    message = "takes a number from 0.1 to 100 m/s"
    expect(page.get_by_role("alert").filter(has_text=message).first).to_be_visible()
    expect(box).to_have_value("200")
    expect(box).to_have_attribute("aria-invalid", "true")
    assert rms(page) == before
    box.fill("15")
    box.press("Enter")
    expect(page.get_by_role("alert").filter(has_text=message)).to_have_count(0)

    cell = page.locator('input[data-cell="0.frequency"]')
    value = cell.input_value()
    cell.fill("fast")
    cell.press("Enter")
    expect(page.get_by_role("alert").filter(has_text="Peak 1: f = 'fast'").first).to_be_visible()
    expect(cell).to_have_attribute("aria-invalid", "true")
    assert rms(page) == before
    cell.fill(value)
    cell.press("Enter")
    expect(page.get_by_role("alert").filter(has_text="Peak 1: f = 'fast'")).to_have_count(0)


def test_signal_and_error(wide: Page) -> None:
    page = wide
    label = """() => [...Bokeh.index.roots[0].model.document.all_models]
        .filter(m => m.type === "LinearAxis").map(m => m.axis_label).join()"""
    until(page, f"({label})().includes('error of tip [nm]')")
    page.get_by_role("button", name="Signal", exact=True).click()
    until(page, f"!({label})().includes('error')")
    page.get_by_role("button", name="Error", exact=True).click()
    until(page, f"({label})().includes('error of tip [nm]')")
    page.get_by_role("button", name="mas", exact=True).click()
    page.get_by_role("button", name="Tilt", exact=True).click()
    until(page, f"({label})().includes('error of tilt [mas]')")
    expect(page.get_by_role("columnheader", name="RMS error [mas]")).to_be_visible()


def test_a_zoom_fetches_more_samples(wide: Page) -> None:
    page = wide
    step = """() => [...Bokeh.index.roots[0].model.document.all_models]
        .filter(m => m.type === "ColumnDataSource" && m.data["kf-ngs"]).map(m => m.data.x[1] - m.data.x[0])[0]"""
    page.get_by_role("button", name="Time window: all").click()
    until(page, f"({step})() > 1.9e-3")  # fewer than there are
    page.get_by_role("button", name="Time window: 0.2 s").click()
    until(page, f"Math.abs(({step})() - 1e-3) < 1e-9")


def test_cards_hide_lines(wide: Page) -> None:
    page = wide
    card = page.locator(".card[data-name=gpr-online]")  # always among those that are shown at first
    expect(card).to_have_attribute("aria-pressed", "true")
    card.click()
    expect(card).to_have_attribute("aria-pressed", "false")
    visible = """() => [...Bokeh.index.roots[0].model.document.all_models]
        .filter(m => m.type === "GlyphRenderer" && m.name === "gpr-online").map(m => m.visible)"""
    until(page, f"({visible})().every(v => !v)")
    card.click()
    expect(card).to_have_attribute("aria-pressed", "true")


def test_figures_take_the_height_of_the_window(wide: Page) -> None:
    page = wide
    figure = page.get_by_role("figure", name="Turbulence time trace")
    height = "box => box.getBoundingClientRect().height"
    # What is left of the window below what stands above it, of which a line of text is the caption's.
    until(page, f"([it]) => Math.abs(({height})(it) - 620) < 30", arg=[figure.element_handle()])
    page.set_viewport_size({"width": 1400, "height": 700})
    until(page, f"([it]) => Math.abs(({height})(it) - 350) < 30", arg=[figure.element_handle()])
    page.set_viewport_size({"width": 1400, "height": 1000})


def test_dark(wide: Page, tmp_path: Path) -> None:
    page = wide
    button = page.get_by_role("button", name=re.compile("theme", re.I))
    ground = page.evaluate("() => getComputedStyle(document.body).backgroundColor")
    button.click()
    colour = """() => [...Bokeh.index.roots[0].model.document.all_models]
        .filter(m => m.type === "GlyphRenderer" && m.name === "gpr-online").map(m => m.glyph.line_color.value)"""
    until(page, f"({colour})().every(c => c === '{look('gpr-online').colour(True)}')")
    until(page, "before => getComputedStyle(document.body).backgroundColor !== before", arg=ground)
    still(page)
    shot(page, tmp_path, "dark")
    button.click()  # the browser keeps what is chosen, and other pages are light
    until(page, "before => getComputedStyle(document.body).backgroundColor === before", arg=ground)


def test_the_wind_speed_slider_runs_again(wide: Page) -> None:
    page = wide
    before = rms(page)
    wind(page).focus()
    for _ in range(8):
        page.keyboard.press("ArrowRight")
    expect(page.get_by_role("textbox", name="m/s")).to_have_value("19")
    cell = page.locator('tr[data-observer="kf-lgs"][data-target="turbulence"] td').first
    expect(cell).to_have_text(other_than(before))
    answered(page)
    page.get_by_role("button", name="Reset", exact=True).click()
    expect(cell).to_have_text(re.compile(rf"(^|\s){re.escape(before)}$"))
    answered(page)


def test_peaks_are_added_removed_and_edited(wide: Page) -> None:
    page = wide
    cells = page.locator('[data-cell$=".frequency"]')
    n = len(PRESETS["paper"]().vibration.peaks)
    expect(cells).to_have_count(n)
    before = rms(page, "kf-lgs", "vibration")
    page.get_by_role("button", name="+ Add peak").click()
    expect(cells).to_have_count(n + 1)
    cell = page.locator(f'input[data-cell="{n}.rms.0"]')
    expect(cell).to_have_value("0.01")
    cell.fill("0.05")
    cell.press("Enter")
    error = page.locator('tr[data-observer="kf-lgs"][data-target="vibration"] td').first

    def is_larger() -> bool:
        value = rms(page, "kf-lgs", "vibration")
        return value != "–" and float(value) > float(before)

    eventually(page, is_larger)  # a filter of one peak does not know this one
    finished(page)
    assert is_larger()  # rows change places until then, and a row is found before it is read
    page.get_by_role("button", name=f"Remove peak {n + 1}").click()
    expect(cells).to_have_count(n)
    expect(error).to_have_text(re.compile(rf"^{re.escape(before)}\b|\s{re.escape(before)}$"))
    finished(page)


def test_two_sessions_do_not_see_each_other(wide: Page, phone: Page) -> None:
    box = wide.get_by_role("textbox", name="m/s")
    box.fill("30")
    box.press("Enter")
    expect(wide.get_by_text("changed: Wind speed V₀")).to_be_visible()
    finished(wide)
    opener = phone.get_by_role("button", name="Open drawer")
    if opener.is_visible():  # the drawer of a phone closes by itself
        opener.click()
    expect(phone.get_by_role("textbox", name="m/s")).to_have_value("15")
    wide.get_by_role("button", name="Undo", exact=True).click()
    expect(box).to_have_value("15")


def test_choosing_a_preset(wide: Page) -> None:
    page = wide
    page.get_by_role("combobox", name="Preset").click()
    page.get_by_role("option", name="UT4", exact=True).click()
    page.get_by_role("button", name="Vibration", exact=True).click()
    expect(page.get_by_role("combobox", name="Source").first).to_have_text("measured")
    expect(page.get_by_role("combobox", name="Preset")).to_have_text("UT4")
    expect(page.locator('tr[data-observer="kf-lgs"][data-target="vibration"] td').first).not_to_have_text("–")
    finished(page)
    page.get_by_role("button", name="Undo", exact=True).click()
    expect(page.get_by_role("combobox", name="Preset")).to_have_text("Paper")


def test_a_long_run_grows_and_stops_at_once(wide: Page) -> None:
    page = wide
    page.get_by_role("button", name="Run", exact=True).last.click()  # the topic
    duration = page.get_by_role("textbox", name="Duration [s]", exact=True)
    duration.fill("30")
    duration.press("Enter")
    expect(page.get_by_text(re.compile("changed: .*Duration"))).to_be_visible()
    page.get_by_role("button", name="Run", exact=True).first.click()
    until(page, "() => [...Bokeh.index.roots[0].model.document.all_models].some(m => m.reset_end === 30)")
    page.get_by_role("button", name="Time window: all").click()
    until(page, f"() => {{ const part = ({ONLINE})(); return part > 0.02 && part < 0.9 }}")
    part = page.evaluate(ONLINE)
    until(page, f"part => ({ONLINE})() > part", arg=part)
    page.get_by_role("button", name="Cancel", exact=True).click()
    page.locator("[role=status]", has_text="Cancelled").first.wait_for(state="attached")
    assert page.evaluate(ONLINE) < 0.95, "what had come stays, the rest does not come"
    expect(page.get_by_role("button", name="Cancel", exact=True)).to_be_disabled()
    page.get_by_role("button", name="Reset", exact=True).click()
    finished(page)
