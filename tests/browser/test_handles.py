"""Handles on the spectra: drag one, and theory's numbers move; let go, and the settings are those; all of it by keyboard too."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.browser.conftest import CHANGED, QUICK, answered, eventually, finished, until
from wfsobs.app.style import asset

STANDS = "47.44 Hz, 7.90 nm rms, damping 0.004"


HOLD = """settle => {
  const set = window.setTimeout
  window.setTimeout = (act, time, ...rest) => time === settle ? (window.settle = act, 0) : set(act, time, ...rest)
}"""
"""Has a move by keys be over when the test says so, however long it takes to press them."""


HOLD_BACK = """() => {
  const send = WebSocket.prototype.send, kept = []
  WebSocket.prototype.send = function (...args) { kept.push(() => send.apply(this, args)) }
  window.goOn = () => { WebSocket.prototype.send = send; kept.forEach((it) => it()) }
}"""
"""Has what the browser says wait until the test lets it go."""


@pytest.fixture(scope="module")
def shared(open_shared: Any, server: Any) -> Page:
    """A page whose handles are shown; its record is short, as every change runs it anew."""
    page = open_shared(url=server.url + QUICK)
    (settle,) = re.findall(r"SETTLE = (\d+)", asset("handles.js"))
    page.evaluate(HOLD, int(settle))
    expect(page.locator(".seeds")).to_have_text("one record")  # what further seeds say of the errors would move the figures
    expect(page.get_by_role("slider", name="Peak 15", exact=True)).to_have_count(0)
    page.get_by_role("checkbox", name="Edit figure").check()
    return page


@pytest.fixture
def page(shared: Page) -> Iterator[Page]:
    """The page as it was opened; what a test has changed is undone."""
    expect(predicted(shared, "multirate-multi")).to_have_text("10.8")
    yield shared
    shared.keyboard.press("Escape")
    shared.get_by_role("button", name="Explore", exact=True).click()
    undo = shared.get_by_role("button", name="Undo")
    answered(shared)
    while undo.is_enabled():
        undo.dispatch_event("click")  # the button may be shown as enabled a moment longer than it is; then this does nothing
        answered(shared)
    finished(shared)


def handle(page: Page, name: str) -> Locator:
    return page.get_by_role("slider", name=name, exact=True)


def predicted(page: Page, name: str) -> Locator:
    """What theory says of an observer, of the vibration."""
    return page.locator(f".numbers span[data-name={name}] b").last


def middle(of: Locator) -> tuple[float, float]:
    of.scroll_into_view_if_needed()
    box = of.bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_by_mouse(page: Page) -> None:
    peak = handle(page, "Peak 15")
    expect(peak).to_have_attribute("aria-valuetext", STANDS)
    curve = """() => [...Bokeh.index.roots[0].model.document.all_models]
        .filter(m => m.type === "GlyphRenderer" && m.name === "predicted" && m.data_source.data.ys?.length > 3)
        .map(m => m.data_source.data.ys.map(y => y[60]).join()).join()"""
    until(page, curve)
    before = page.evaluate(curve)
    value = page.locator(".card[data-name=multirate-multi] .value").last
    run = value.inner_text()
    x, y = middle(peak)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 40, y - 30, steps=6)
    expect(predicted(page, "multirate-multi")).not_to_have_text("10.8")
    expect(peak).not_to_have_attribute("aria-valuetext", STANDS)
    until(page, f"before => ({curve})() !== before", arg=before)
    assert not page.evaluate(CHANGED)  # nothing has been set yet
    page.mouse.up()
    until(page, CHANGED)
    expect(peak).to_have_attribute("aria-valuetext", re.compile("^80 Hz"))  # the cut-off, however far the pointer went
    expect(value).not_to_have_text(run)  # the run, of 14 and the moved line
    page.get_by_role("button", name="Undo").click()
    expect(peak).to_have_attribute("aria-valuetext", STANDS)
    expect(predicted(page, "multirate-multi")).to_have_text("10.8")


def test_by_keyboard(page: Page) -> None:
    peak = handle(page, "Peak 15")
    peak.focus()
    for key in ("Shift+ArrowRight", "Shift+ArrowUp", "PageUp"):
        page.keyboard.press(key)
    # four steps of 0.5 % in frequency, four of 6 % in rms, one of 12 % in damping
    moved = f"{47.44 * 1.005**4:.4g} Hz, {7.90 * 1.06**4:.2f} nm rms, damping {0.004 * 1.12:.3g}"
    expect(peak).to_have_attribute("aria-valuetext", moved)
    expect(predicted(page, "multirate-multi")).not_to_have_text("10.8")
    page.evaluate("() => window.settle()")  # some time after the last key
    until(page, CHANGED)
    expect(peak).to_be_focused()
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Escape")
    expect(peak).to_have_attribute("aria-valuetext", moved)
    page.get_by_role("button", name="Undo").click()
    expect(peak).to_have_attribute("aria-valuetext", STANDS)
    expect(predicted(page, "multirate-multi")).to_have_text("10.8")
    page.evaluate(HOLD_BACK)  # an answer that takes its time
    peak.press("Shift+ArrowUp")
    expect(page.locator(".pending .numbers")).to_be_visible()
    expect(predicted(page, "multirate-multi")).to_have_text("10.8")  # the last frame stays
    page.evaluate("() => window.goOn()")
    expect(page.locator(".pending")).to_have_count(0)
    expect(predicted(page, "multirate-multi")).not_to_have_text("10.8")
    peak.press("Escape")
    expect(predicted(page, "multirate-multi")).to_have_text("10.8")


def test_other_handles(page: Page) -> None:
    for name, target in (("Peak of the Kalman filters", "kf-lgs"), ("Band 1", "multirate-multi")):
        before = handle(page, name).get_attribute("aria-valuetext")
        handle(page, name).focus()
        page.keyboard.press("Shift+ArrowRight")
        expect(handle(page, name)).not_to_have_attribute("aria-valuetext", before or "")
        page.keyboard.press("Escape")
        expect(handle(page, name)).to_have_attribute("aria-valuetext", before or "")
        expect(predicted(page, target)).to_be_visible()
    corner = handle(page, "Corner of the turbulence")
    corner.focus()
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("Enter")
    expect(page.get_by_role("textbox", name=re.compile("Wind speed")).or_(page.get_by_role("spinbutton")).first).to_be_visible()
    until(page, CHANGED)


@pytest.mark.parametrize("name", ["Integrator gain", "Integrator gain, Nyquist"])
def test_gain_of_the_integrator(page: Page, name: str) -> None:
    page.get_by_role("button", name="Closed loop").click()
    gain = handle(page, name)
    expect(gain).to_be_visible()
    expect(page.get_by_text("Only the integrator has a preview").first).to_be_visible()
    margin = page.locator(".numbers span[data-name=gain-margin] b").first
    before, stood = margin.inner_text(), gain.get_attribute("aria-valuenow")
    assert stood is not None
    x, y = middle(gain)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 30, y, steps=5)
    expect(margin).not_to_have_text(before)
    assert not page.evaluate(CHANGED)
    page.mouse.up()
    until(page, CHANGED)
    page.get_by_role("button", name="Undo").click()
    expect(margin).to_have_text(before)
    expect(gain).to_have_attribute("aria-valuenow", stood)  # the figure follows its numbers
    gain.focus()
    page.keyboard.press("Shift+ArrowLeft")
    expect(margin).not_to_have_text(before)  # and no result that comes in takes it back
    assert float(gain.get_attribute("aria-valuenow") or "nan") < float(stood), "to the left"
    page.keyboard.press("Escape")
    expect(margin).to_have_text(before)


@pytest.mark.parametrize("name", ["Peak 15", "Integrator gain"])
def test_the_keyboard_stays_on_a_handle_when_results_come(page: Page, name: str) -> None:
    if name != "Peak 15":
        page.get_by_role("button", name="Closed loop").click()
    it = handle(page, name)
    expect(it).to_be_visible()
    it.focus()
    for _ in range(2):
        before, address = it.get_attribute("aria-valuenow") or "", page.evaluate("location.search")
        page.keyboard.press("Shift+ArrowLeft")
        expect(it).not_to_have_attribute("aria-valuenow", before)
        page.keyboard.press("Enter")
        until(page, "address => location.search !== address", arg=address)
        finished(page)
        answered(page)  # and all that it has sent meanwhile is there
        expect(it).to_be_focused()


def test_handles_outside_of_a_zoom_come_back_by_a_double_click(page: Page) -> None:
    figure, corner = page.get_by_role("figure", name="Turbulence spectrum"), handle(page, "Corner of the turbulence")
    expect(corner).to_be_visible()
    answered(page)  # and nothing is still to come that would move the figure

    def zoom() -> bool:
        x, y = middle(figure)
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 60, y, steps=5)
        page.mouse.up()
        return corner.is_hidden()

    eventually(page, zoom)
    page.mouse.dblclick(*middle(figure))
    expect(corner).to_be_visible()


def test_one_more_and_one_less(page: Page) -> None:
    add = page.get_by_role("button", name="Add a peak")
    add.focus()
    page.keyboard.press("Enter")
    expect(handle(page, "Peak 16")).to_be_focused()
    page.keyboard.press("Delete")
    expect(handle(page, "Peak 16")).to_have_count(0)
    add.click()
    expect(handle(page, "Peak 16")).to_be_focused()
    x, y = middle(handle(page, "Peak 16"))
    before = handle(page, "Peak 16").get_attribute("aria-valuetext") or ""
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 30, y, steps=3)
    page.mouse.up()
    expect(handle(page, "Peak 16")).not_to_have_attribute("aria-valuetext", before)
    expect(handle(page, "Peak 17")).to_have_count(0)
