"""The first minute: what a visitor finds, by search, by the bar at the top and by asking what a word means."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.browser.conftest import PATIENCE, QUICK, eventually, finished, until
from wfsobs.observers import OBSERVERS

TOPICS_AT = """() => [...(window.Bokeh?.index?.query((it) => it.model.class_name === "Headings") ?? [])]
    .map((it) => it.el.getBoundingClientRect().top).find((top) => top > 0)"""
"""Where the topics of the drawer begin."""


@pytest.fixture(scope="module")
def opened(open_shared: Any) -> tuple[Page, float]:
    """A page, and where the topics of its drawer stood when they came."""
    page = open_shared(1280, 720, wait=False)
    top = until(page, TOPICS_AT, every=20).json_value()
    finished(page)
    return page, top


@pytest.fixture(scope="module")
def wide(opened: tuple[Page, float]) -> Page:
    """A page for the tests below, in this order."""
    return opened[0]


@pytest.fixture(scope="module")
def phone(open_shared: Any) -> Page:
    """As `wide`."""
    return open_shared(390, 844)


FIRST_FIGURE = """() => {
  const tops = []
  const look = (root) => { for (const it of root.querySelectorAll("*")) {
    const box = it.getBoundingClientRect()
    if (it.localName === "canvas" && box.height > 100) tops.push(box.top)
    if (it.shadowRoot) look(it.shadowRoot)
  } }
  look(document)
  return Math.min(...tops)
}"""


@pytest.mark.parametrize(("name", "lowest"), [("wide", 430), ("phone", 700)])
def test_the_first_figure_begins_in_the_first_window(request: pytest.FixtureRequest, name: str, lowest: int) -> None:
    assert request.getfixturevalue(name).evaluate(FIRST_FIGURE) < lowest


def test_what_the_drawer_is_to_hold_has_its_room_from_the_first(opened: tuple[Page, float]) -> None:
    """Its settings are made one after the other; what is below them must not move away from a click."""
    page, top = opened
    assert page.evaluate(TOPICS_AT) == pytest.approx(top, abs=2.0)  # heights in whole pixels


def test_a_logarithmic_slider_says_its_value(wide: Page) -> None:
    page = wide
    slider = page.get_by_role("slider", name=re.compile("Length scale"))
    expect(slider).to_have_attribute("aria-valuetext", "300")
    slider.focus()
    page.keyboard.press("ArrowLeft")  # a hundredth of a decade
    expect(slider).to_have_attribute("aria-valuetext", "293")
    expect(page.get_by_role("textbox", name=re.compile("Length scale"))).to_have_value("293")
    page.get_by_role("button", name="Undo", exact=True).click()
    expect(slider).to_have_attribute("aria-valuetext", "300")
    page.set_viewport_size({"width": 1400, "height": 1000})


def test_a_setting_is_found_and_gets_the_focus(wide: Page) -> None:
    page = wide
    box = page.get_by_role("combobox", name="Find a setting")
    box.focus()
    offered = page.locator("#found option")
    expect(offered.filter(has_text="kalman.process_noise")).to_have_attribute("value", "Process noise Q · Kalman filters")
    page.keyboard.type("process noise")
    expect(page.get_by_role("combobox", name="Process noise Q")).to_have_count(0)
    page.keyboard.press("Enter")
    expect(page.get_by_role("combobox", name="Process noise Q")).to_be_focused()
    box.focus()
    page.keyboard.type("outer scale")
    page.keyboard.press("Enter")
    until(
        page,
        "() => [...Bokeh.index.query((it) => it.model.tags?.some((tag) => tag.includes('outer_scale')))]"
        ".some((it) => it.el.matches(':focus'))",
    )
    box.focus()
    page.keyboard.type("no such thing")
    page.keyboard.press("Enter")
    eventually(page, lambda: box.evaluate("it => it.validationMessage") == "No setting of that name")
    box.fill("Seed · Run")  # as when it is chosen from the list
    expect(page.get_by_role("slider", name="Seed", exact=True)).to_be_focused()


def test_a_word_says_what_it_means(wide: Page) -> None:
    page = wide
    for word, meaning in (
        ("theoretical limit", "Smallest RMS error"),
        ("Lag [ms]", "cross-correlation"),
        ("Relative error", "1 is as good as an estimate of zero"),
    ):
        button = page.get_by_role("button", name=word, exact=True).first
        definition = page.get_by_role("note").filter(has_text=meaning).first
        expect(definition).to_be_hidden()
        button.focus()
        page.keyboard.press("Enter")
        expect(definition).to_be_visible()
        page.keyboard.press("Escape")
        expect(definition).to_be_hidden()


def test_help_and_tour_by_keyboard(wide: Page) -> None:
    page = wide
    page.keyboard.press("?")
    sheet = page.get_by_role("dialog", name="Help")
    expect(sheet.get_by_text("Undo and redo a change of the settings")).to_be_visible()
    expect(sheet.get_by_role("heading", name="Tour")).to_be_in_viewport()
    expect(sheet.get_by_role("button", name="Close")).to_be_focused()
    page.keyboard.press("Enter")
    expect(sheet).to_be_hidden()
    expect(page.get_by_role("button", name="Help")).to_be_focused()
    page.keyboard.press("/")
    expect(page.get_by_role("combobox", name="Find a setting")).to_be_focused()
    page.keyboard.press("?")  # a letter of what is looked for
    expect(sheet).to_be_hidden()


def test_the_tour_is_offered_once_and_observers_are_described(browser: Browser, server: Any) -> None:
    """To a browser that was not here before; pointing at a card and its focus say what the observer is."""
    context = browser.new_context(viewport={"width": 1280, "height": 720})
    page = context.new_page()
    page.set_default_timeout(PATIENCE)
    page.goto(server.url + QUICK)
    offer = page.get_by_role("dialog", name="Tour offer")
    offer.get_by_role("button", name="Take the tour").click()
    expect(offer).to_be_hidden()
    expect(page.get_by_role("dialog", name="Help").get_by_role("listitem")).to_have_count(5)
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog", name="Help")).to_be_hidden()
    finished(page)
    page.get_by_role("button", name="mas", exact=True).click()
    until(page, "location.search.includes('unit=mas')")
    for name in ("kf-lgs", "gpr-online"):
        card = page.locator(f'.card[data-name="{name}"]').last
        card.hover()
        about = page.locator(".hint .about").last
        expect(about).to_have_text(f"{OBSERVERS[name].label}: {OBSERVERS[name].help}.")
        page.mouse.move(0, 0)
        expect(about).to_have_text("")
        card.focus()
        expect(about).to_have_text(f"{OBSERVERS[name].label}: {OBSERVERS[name].help}.")
    figure = card.text_content()
    page.go_back()  # to nm: the table is written anew
    expect(card).not_to_have_text(figure or "")
    expect(about).to_have_text(f"{OBSERVERS[name].label}: {OBSERVERS[name].help}.")
    page.reload()
    expect(page.locator("p.verdict").first).to_be_visible()
    assert page.evaluate("localStorage.getItem('wfsobs-tour')") == "offered"
    context.close()


def test_run_and_status_stay_in_sight(wide: Page) -> None:
    page = wide
    page.set_viewport_size({"width": 1200, "height": 700})
    page.get_by_role("button", name="Close drawer").click()
    page.get_by_role("heading", name="RMS errors").scroll_into_view_if_needed()
    expect(page.get_by_role("button", name="Run", exact=True).first).to_be_in_viewport()
    expect(page.get_by_role("status").filter(has_text="Done in").first).to_be_in_viewport()


def no_wider_than(page: Page, width: int) -> None:
    until(page, "width => document.documentElement.scrollWidth <= width", arg=width)


def test_other_pages_by_keyboard_on_a_phone(phone: Page) -> None:
    page = phone
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
    page.get_by_role("button", name="Explore", exact=True).click()


def test_a_heading_says_what_differs(phone: Page) -> None:
    page = phone
    page.get_by_role("button", name="Open drawer").click()
    page.get_by_role("textbox", name="m/s").fill("20")
    page.get_by_role("textbox", name="m/s").press("Enter")
    expect(page.get_by_role("button", name=re.compile("Turbulence · 1 changed"))).to_be_visible()


def test_topics_open_below_their_names_by_keyboard(phone: Page) -> None:
    """What is opened above another moves that; a name keeps the focus, and Tab leads from it to its first field."""
    fields = {"loop": "Integrator gain g", "telescope": "Aperture diameter D [m]"}
    for topic, field in fields.items():
        heading = phone.locator(f"[data-key={topic}]")
        heading.focus()
        phone.keyboard.press("Enter")
        expect(heading).to_have_attribute("aria-expanded", "true")
        expect(phone.get_by_role("textbox", name=field)).to_be_visible()
        expect(heading).to_be_focused()
        phone.keyboard.press("Tab")
        expect(phone.locator("[data-key]:focus")).to_have_count(0)
    for topic, field in fields.items():
        heading = phone.locator(f"[data-key={topic}]")
        heading.focus()
        phone.keyboard.press("Enter")
        expect(phone.get_by_role("textbox", name=field)).to_have_count(0)
        expect(heading).to_be_focused()
