"""Numbers read off the figures: at the pointer, by the arrow keys, and of what has been zoomed to."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import Page, expect


@pytest.fixture(scope="module")
def page(open_shared: Any) -> Page:
    """A page for the tests below, in this order."""
    return open_shared()


PAINTED = """name => [...Bokeh.index.query((it) => it.model.type === "Figure" && it.model.name === name)]
    .some((it) => it.has_finished())"""
"""Whether a figure stands, so that it hears of the pointer."""


def test_values_at_the_pointer_and_by_the_arrow_keys(page: Page) -> None:
    box = page.locator(".values")
    figure = page.get_by_role("figure", name="Turbulence time trace")
    page.wait_for_function(PAINTED, arg="Turbulence time trace")
    at = figure.bounding_box()
    page.mouse.move(at["x"] + at["width"] / 2, at["y"] + at["height"] / 2)
    expect(box).to_have_text(re.compile(r"time\s*[\d.]+ s.*LGS KF\s*[−\d.]+ nm", re.S))
    expect(box).not_to_contain_text("Adaptive KF")  # hidden
    page.mouse.move(at["x"] + at["width"] / 2, at["y"] - 60)
    expect(box).to_be_hidden()
    page.mouse.move(at["x"] + at["width"] / 2, at["y"] + at["height"] / 2)
    expect(box).to_be_visible()
    page.mouse.wheel(0, 3000)  # away from the figure
    expect(box).to_be_hidden()
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


def test_a_brush_over_time_and_over_a_band(page: Page) -> None:
    line = page.locator("p.stretch").filter(has_text="Online GPR")
    figure = page.get_by_role("figure", name="Vibration spectrum")
    figure.scroll_into_view_if_needed()
    page.wait_for_function(PAINTED, arg="Vibration spectrum")
    at = figure.bounding_box()
    y = at["y"] + at["height"] / 2
    page.mouse.move(at["x"] + 0.5 * at["width"], y)
    page.mouse.down()
    page.mouse.move(at["x"] + 0.7 * at["width"], y, steps=5)
    page.mouse.up()
    expect(line.filter(has_text="Hz")).to_have_text(
        re.compile(r"RMS error, \d+(\.\d+)? – \d+(\.\d+)? Hz: .*Multi-peak [\d.]+ nm")
    )
    points = """() => [...Bokeh.index.roots[0].model.document._all_models.values()]
        .filter(m => m.type === "GlyphRenderer" && m.name === "gpr-online" && m.data_source.data.y)[0].data_source.data.y[0]"""
    before = page.evaluate(points)
    page.get_by_role("checkbox", name="Spectra of the window").check()
    page.wait_for_function(f"before => ({points})() !== before", arg=before)
    figure.scroll_into_view_if_needed()
    at = figure.bounding_box()
    page.mouse.dblclick(at["x"] + 0.6 * at["width"], at["y"] + at["height"] / 2)
    expect(line.filter(has_text="Hz")).to_have_count(0)  # all frequencies again
