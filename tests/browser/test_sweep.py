"""A sweep in a browser: from a setting in the drawer to the cells, stopped and gone on with, a cell loaded and taken back."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

from tests.browser.conftest import until
from tests.browser.test_quality import accessible, fits, focused, theme

QUICK = "?run.duration=1&run.warm_up=0.2&gpr_online.training_size=40&gpr_offline.training_size=40&adaptive.window=0.3"


def enter(page: Page, label: str, text: str) -> None:
    box = page.get_by_role("textbox", name=label, exact=True)
    box.fill(text)
    box.press("Enter")


def tab_to(page: Page, name: str, most: int = 40) -> None:
    """Go on with the Tab key until the focus is on what is called so."""
    for _ in range(most):
        if name in focused(page)["name"]:
            return
    raise AssertionError(f"no {name!r} in {most} stops")


def look_for_faults(page: Page) -> None:
    """Have axe look at the page."""
    page.evaluate(files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8"))
    accessible(page)
    fits(page, 1400)


def known(page: Page) -> Locator:
    """The cells of which something is known."""
    return page.get_by_role("region", name="Best observers, vibration, tip").locator('button:not([data-state="waiting"])')


@pytest.fixture(scope="module")
def page(open_shared: Any, server: Any) -> Page:
    """A page for the tests below, in this order."""
    return open_shared(url=server.url + QUICK)


def test_a_map_comes_cell_by_cell_and_one_is_loaded(page: Page) -> None:
    page.get_by_role("button", name="Sweep", exact=True).click()
    expect(page.get_by_text(re.compile(r"5 × 4 scenarios × 4 seeds = 80 runs, about \d+ s"))).to_be_visible()
    enter(page, "Values", "25:5:5")
    expect(page.get_by_text("the first number must be below the second").first).to_be_visible()
    expect(page.get_by_role("button", name="Run the sweep")).to_be_disabled()
    enter(page, "Values", "5,20")
    enter(page, "Values of the second", "5,10")
    enter(page, "Seeds of each", "40")
    expect(page.get_by_text("2 × 2 scenarios × 40 seeds = 160 runs")).to_be_visible()
    page.get_by_role("button", name="Run the sweep").click()
    expect(known(page)).to_have_count(4)  # each with its first seed
    page.get_by_role("button", name="Stop").click()
    expect(page.get_by_text(re.compile(r"Stopped · \d+ of 160 runs"))).to_be_visible()
    expect(known(page)).to_have_count(4)
    theme(page)
    look_for_faults(page)
    theme(page)
    wind = page.get_by_role("textbox", name="Wind speed V₀ [m/s]")
    expect(wind).to_have_value("15")
    page.get_by_role("region", name="Best observers, vibration, tip").get_by_role(
        "button", name=re.compile("^Wind speed V₀ 20, Exposure ratio n 10: ")
    ).click()
    expect(page.get_by_role("button", name="Explore", exact=True)).to_have_attribute("aria-pressed", "true")
    expect(wind).to_have_value("20")
    expect(page.get_by_role("textbox", name="Exposure ratio n")).to_have_value("10")
    page.get_by_role("button", name="Undo", exact=True).click()
    expect(wind).to_have_value("15")
    page.go_back()
    expect(page.get_by_role("button", name="Sweep", exact=True)).to_have_attribute("aria-pressed", "true")
    expect(page.get_by_role("region", name="Best observers, vibration, tip")).to_be_visible()


def test_a_sweep_over_one_setting_runs_after_back(page: Page) -> None:
    """With no second setting chosen, to Explore and back."""
    page.get_by_role("combobox", name="and over").click()
    page.get_by_role("option", name="no second setting").click()
    enter(page, "Values", "5,20")
    enter(page, "Seeds of each", "1")
    page.get_by_role("button", name="Explore", exact=True).click()
    until(page, "() => !location.search.includes('view.page')")
    page.go_back()
    until(page, "() => location.search.includes('view.page=sweep')")
    expect(page.get_by_text("2 scenarios × 1 seed = 2 runs")).to_be_visible()
    page.get_by_role("button", name="Run the sweep").click()
    expect(page.get_by_text("Finished · 2 of 2 runs")).to_be_visible()
    page.get_by_role("button", name="File", exact=True).click()
    with page.expect_download() as saved:
        page.get_by_text("Save Sweep as CSV").click()
    head, *rows = Path(saved.value.path()).read_text().splitlines()
    assert head.startswith("turbulence.wind_speed,target,mode,observer,seeds,mean_rms_nm")
    assert {row.split(",")[0] for row in rows} == {"5", "20"} and {row.split(",")[4] for row in rows} == {"1"}
    page.get_by_role("button", name="Explore", exact=True).click()


def test_error_over_a_setting_by_keyboard(page: Page) -> None:
    page.get_by_role("button", name="Sweep", exact=True).click()
    page.get_by_role("combobox", name="Error over").click()
    page.get_by_role("option", name="Exposure ratio n", exact=False).first.click()
    values = page.get_by_role("textbox", name="Values", exact=True)
    expect(values).to_have_value("1,6,10,15,20")
    expect(page.get_by_text(re.compile("5 scenarios × 1 seed = 5 runs"))).to_be_visible()
    values.focus()
    page.keyboard.press("ControlOrMeta+a")
    page.keyboard.type("5,10")
    tab_to(page, "Seeds of each")
    page.keyboard.press("ControlOrMeta+a")
    page.keyboard.type("2")
    tab_to(page, "Observers")
    expect(page.get_by_text("2 scenarios × 2 seeds = 4 runs")).to_be_visible()
    tab_to(page, "Run the sweep")
    page.keyboard.press("Enter")
    expect(page.get_by_text("Finished · 4 of 4 runs")).to_be_visible()
    tab_to(page, "Exposure ratio n 10:")
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="Explore", exact=True)).to_have_attribute("aria-pressed", "true")
    expect(page.get_by_role("textbox", name="Exposure ratio n")).to_have_value("10")
    page.get_by_role("button", name="Undo", exact=True).click()
    expect(page.get_by_role("textbox", name="Exposure ratio n")).to_have_value("5")


def test_intervals_of_several_seeds(page: Page) -> None:
    page.get_by_role("button", name="Sweep", exact=True).click()
    enter(page, "Values", "5,10")
    enter(page, "Seeds of each", "3")
    expect(page.get_by_text("2 scenarios × 3 seeds = 6 runs")).to_be_visible()
    page.get_by_role("button", name="Run the sweep").click()
    expect(page.get_by_text("Finished · 6 of 6 runs")).to_be_visible()
    expect(page.get_by_role("figure", name="Error over Exposure ratio n, turbulence")).to_be_visible()
    expect(page.get_by_role("button", name=re.compile(r"^Exposure ratio n 10: .*3 seeds$"))).to_have_count(3)
    look_for_faults(page)
