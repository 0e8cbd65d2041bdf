"""Further seeds in idle time, as a visitor sees them: intervals come, a change of settings takes them away."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import QUICK, until


def set_seeds(page: Page, count: int) -> None:
    """Type a number, see it, and leave the field."""
    field = page.get_by_label("Seeds", exact=True)
    field.fill(str(count))
    expect(field).to_have_value(str(count))
    field.press("Tab")


@pytest.fixture(scope="module")
def page(open_shared: Any, server: Any) -> Page:
    """A page for the tests below, in this order; nobody has its seeds yet."""
    return open_shared(url=f"{server.url}{QUICK}&run.seed=4711", seeds=0)


def test_what_one_is_at_stays_when_seeds_come(page: Page) -> None:
    """What stands in a text or a card changes; the word that is open, the focus and the card do not go with it."""
    set_seeds(page, 3)
    card = page.locator('.card[data-name="kf-lgs"]').first
    card.evaluate("card => { card.same = true }")
    word = page.get_by_role("button", name="Lag [ms]", exact=True)
    word.focus()
    page.keyboard.press("Enter")
    definition = page.get_by_role("note").filter(has_text="cross-correlation")
    expect(definition).to_be_visible()
    expect(page.locator(".seeds")).to_have_text("over 3 seeds")
    expect(page.locator('tr[data-target="vibration"][data-observer="kf-lgs"] .range')).to_have_attribute(
        "title", re.compile("3 seeds$")
    )
    expect(card.locator(".half")).to_have_attribute("title", re.compile("3 seeds$"))
    assert card.evaluate("card => card.same")
    expect(definition).to_be_visible()
    expect(word).to_be_focused()


def test_the_error_budgets_stand_beside_the_verdict(page: Page) -> None:
    strip = page.locator(".strip").nth(1)
    bars = strip.locator(".bar[role=img]").filter(visible=True)
    expect(bars.first).to_have_attribute("aria-label", re.compile(r"^Noise \d+ %, Lag \d+ %, Unmodelled peaks \d+ %"))
    expect(strip.locator(".card[data-name=gpr-online] .bar")).to_have_attribute("aria-label", re.compile("^Noise "))
    few = strip.locator(".card").filter(visible=True).count()
    expect(strip.locator(".card[data-name=ridge]")).to_be_hidden()
    page.get_by_role("button", name=re.compile(r"^All \d+ observers$")).nth(1).click()
    expect(page.get_by_role("button", name="Main observers")).to_be_focused()
    expect(strip.locator(".card[data-name=ridge]")).to_be_visible()
    expect(strip.locator(".card[data-name=gpr-offline] .bar")).to_have_attribute("aria-label", re.compile("^Noise "))
    page.keyboard.press("Enter")
    expect(strip.locator(".card").filter(visible=True)).to_have_count(few)


def test_seeds_give_intervals_and_go_with_the_settings(page: Page) -> None:
    set_seeds(page, 3)
    expect(page.locator(".seeds")).to_have_text("over 3 seeds")
    row = page.locator('tr[data-target="vibration"][data-observer="kf-lgs"]')
    expect(row.locator("td").first).to_contain_text(re.compile(r"\d – \d"))
    expect(row.locator(".range")).to_have_attribute("title", re.compile("3 seeds$"))
    expect(page.locator('.card[data-name="kf-lgs"] .half').first).to_have_attribute("title", re.compile("3 seeds$"))
    expect(page.get_by_role("heading", name="Vibration, tip, over 3 seeds")).to_be_visible()
    set_seeds(page, 1)
    expect(page.locator(".seeds")).to_have_text("one record")
    expect(row.locator(".range")).to_have_attribute("title", re.compile("from one record$"))
    expect(page.get_by_role("heading", name="Vibration, tip", exact=True)).to_be_visible()


def test_what_is_being_typed_stays_when_what_was_typed_before_is_taken(page: Page) -> None:
    first, second = (page.locator(f'input[data-cell="0.{key}"]') for key in ("frequency", "damping"))
    first.fill("6.50")
    page.keyboard.press("Tab")
    page.keyboard.press("ControlOrMeta+a")
    page.keyboard.type("0.0123")
    expect(first).to_have_value("6.5")  # as the server writes it
    expect(second).to_have_value("0.0123")
    expect(second).to_be_focused()
    page.keyboard.press("Enter")
    until(page, "() => location.search.includes('vibration.peaks=6.5,0.0123,')")


def test_a_change_shows_its_effect_beside_the_errors(page: Page) -> None:
    change = page.locator(".card[data-name=kf-lgs] .change").first
    expect(change).to_have_text("")
    cell = page.locator('input[data-cell="0.frequency"]')
    cell.fill("9")
    page.keyboard.press("Enter")
    expect(change).to_have_text(re.compile(r"^([+−]\d+\.\d+|0)$"))
