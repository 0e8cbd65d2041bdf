"""What is not to bother anyone: things that move under the pointer, words that stay, a theme that nobody asked for."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.browser.conftest import QUICK, until


def place(it: Locator) -> tuple[float, float]:
    box = it.bounding_box()
    assert box is not None
    return round(box["x"]), round(box["y"])


def becomes(page: Page, expected: bool) -> None:
    """Wait for the theme."""
    sign = "<" if expected else ">="
    until(
        page,
        f"() => getComputedStyle(document.body).backgroundColor.match(/\\d+/g).slice(0, 3).reduce((a, b) => +a + +b) {sign} 300",
    )


def remembered(page: Page, theme: str) -> None:
    """Wait until the theme that was chosen is in the address and in what the browser keeps."""
    until(page, "theme => location.search.includes(`theme=${theme}`)", arg=theme)
    until(page, "theme => localStorage.getItem('wfsobs-theme') === theme", arg=theme)


@pytest.fixture(scope="module")
def wide(open_shared: Any, server: Any) -> Page:
    """A page for the tests below, in this order."""
    return open_shared(url=server.url + QUICK)


TOLD_TWICE = """async () => {
  const doc = Bokeh.index.roots[0].model.document
  const {data} = [...doc.all_models].find((m) => m.type.endsWith("ReactComponent") && m.data?.label === "Preset")
  const tell = (text) => doc.apply_json_patch(
    {events: [{kind: "ModelChanged", model: {id: data.id}, attr: "helper_text", new: text}]})
  tell("the older")
  tell("the newer")
  data.setv({helper_text: "the older"})
  const late = data.helper_text
  await new Promise((done) => setTimeout(done, 500))
  const settled = data.helper_text
  data.setv({helper_text: "a third"})
  return [late, settled, data.helper_text]
}"""
"""A text that the server changes twice, and what Panel's React components do on a busy page: they give back the first after the
second has come. What a component itself sets is another matter."""


def test_what_is_told_twice_stays_at_the_second(wide: Page) -> None:
    assert wide.evaluate(TOLD_TWICE) == ["the newer", "the newer", "a third"]


def test_a_comma_gets_a_hint(wide: Page) -> None:
    box = wide.get_by_role("textbox", name="m/s")
    box.fill("15,5")
    box.press("Enter")
    hint = wide.get_by_role("alert").filter(has_text="use a point: 15.5")
    expect(hint.first).to_be_visible()
    box.fill("15")
    box.press("Enter")
    expect(hint).to_have_count(0)


def test_nothing_moves_under_the_pointer(wide: Page) -> None:
    page = wide
    load, source = page.get_by_role("button", name="File", exact=True), page.get_by_role("combobox", name="Find a setting")
    run, box = page.get_by_role("button", name="Run", exact=True).first, page.get_by_role("textbox", name="m/s")
    until(page, "() => document.fonts.status === 'loaded'")
    before = [place(it) for it in (load, run, box, source)]
    page.evaluate("() => { navigator.clipboard.writeText = () => Promise.resolve() }")
    page.get_by_role("button", name="Share", exact=True).click()
    page.get_by_role("button", name="Copy link", exact=True).click()
    expect(page.get_by_text("Copied the link.")).to_be_visible()
    assert place(load) == before[0]
    box.fill("22")
    box.press("Enter")
    page.locator('input[data-cell="0.frequency"]').fill("7")
    page.locator('input[data-cell="0.frequency"]').press("Enter")
    expect(page.get_by_text(re.compile(r"\d changed: .*Peaks"))).to_be_visible()
    assert [place(it) for it in (load, run, box, source)] == before
    expect(page.get_by_text("Copied the link.")).to_have_count(0)


def test_the_theme_of_the_system_unless_another_is_chosen(open_page: Any, server: Any) -> None:
    page = open_page(url=server.url + QUICK, color_scheme="dark")
    becomes(page, True)
    page.emulate_media(color_scheme="light")
    becomes(page, False)
    page.get_by_role("button", name=re.compile("theme", re.I)).click()
    becomes(page, True)
    remembered(page, "dark")
    page.reload()
    page.locator("[role=status]", has_text="Done in").first.wait_for(state="attached")
    becomes(page, True)
    page.emulate_media(color_scheme="dark")
    page.get_by_role("button", name=re.compile("theme", re.I)).click()
    becomes(page, False)
    remembered(page, "light")
    page.emulate_media(color_scheme="light")
    page.emulate_media(color_scheme="dark")
    page.reload()
    expect(page.get_by_role("textbox", name="m/s")).to_be_visible()
    becomes(page, False)
