"""Only what depends on a change runs again, and a setting without effect is grey and says why."""

from __future__ import annotations

import re
from typing import Any

from playwright.sync_api import Page, expect

# A record of its own: of one that another test has had here, some observers may be known, and not all of them run.
OWN = "?run.duration=2&run.warm_up=0.5&gpr_online.training_size=40&gpr_offline.training_size=40&adaptive.window=0.5&run.seed=1408"


def go_to(page: Page, words: str, role: str, name: str) -> Any:
    """Find a setting as a visitor does, and return its box."""
    page.get_by_role("combobox", name="Find a setting").focus()
    page.keyboard.type(words)
    page.keyboard.press("Enter")
    box = page.get_by_role(role, name=name).last  # type: ignore[arg-type]
    expect(box).to_be_visible()
    return box


def choose(page: Page, box: Any, word: str) -> None:
    box.click()
    page.get_by_role("option", name=word, exact=True).click()
    expect(page.locator(".MuiMenu-list")).to_have_count(0)


def test_one_filter_runs_alone_and_grey_settings_say_why(open_page: Any, server: Any) -> None:
    page = open_page(url=server.url + OWN)
    status = page.get_by_role("status").filter(has_text="Done in")
    expect(status.filter(has_text=re.compile(r"Done in [\d.]+ s$")).first).to_be_attached()

    between = go_to(page, "between frames", "combobox", "NGS KF between frames")
    choose(page, between, "propagate")
    expect(status.filter(has_text=re.compile(r"Done in [\d.]+ s, 1 of \d+ ran")).first).to_be_attached()

    why = page.get_by_text("Used only where Measurement noise R is manual").first
    expect(why).to_be_visible()
    noise = page.get_by_role("textbox", name="Model LGS noise [µm]", exact=True)
    expect(noise).to_be_disabled()
    choose(page, go_to(page, "measurement noise", "combobox", "Measurement noise R"), "manual")
    expect(noise).to_be_enabled()
    expect(status.filter(has_text=re.compile(r"\d of \d+ ran")).first).to_be_attached()
