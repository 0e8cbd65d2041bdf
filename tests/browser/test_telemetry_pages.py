"""From the record shown to its model, and to a tuned observer, in a browser."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import Page, expect

QUICK = "?run.duration=5&run.warm_up=0.5&gpr_online.training_size=40&gpr_offline.training_size=40"


@pytest.fixture(scope="module")
def page(open_shared: Any, server: Any) -> Page:
    """A page for the tests below, in this order."""
    return open_shared(url=server.url + QUICK)


def test_identify_and_use_it(page: Page) -> None:
    page.get_by_role("button", name="Identify", exact=True).click()
    expect(page.get_by_role("button", name="Filters only")).to_be_disabled()
    page.get_by_role("button", name="Identify the record").click()
    expect(page.get_by_text(re.compile("tip: residual is (NOT )?white at 1 %"))).to_be_visible()
    row = page.get_by_role("region", name="Identified in tip").locator("tr", has_text="turbulence")
    expect(row.locator("td").first).to_have_text(re.compile(r"^\s*\d"))
    corner = float(row.locator("td").first.inner_text().split()[0])
    assert 0.4 < corner < 3.0, "the paper's is 1.125 Hz, of 5 s a third of an octave wide"
    wind = page.get_by_role("textbox", name="m/s")
    before = wind.input_value()
    page.get_by_role("button", name="Filters only").click()
    expect(wind).not_to_have_value(before)
    expect(page.get_by_text("The simulation with 15 peaks is kept; the settings")).to_be_visible()
    page.get_by_role("button", name="As a new simulation").click()
    expect(page.get_by_text(re.compile("A simulation of the model has replaced the record"))).to_be_visible()
    expect(page.get_by_text("is kept; the settings")).to_have_count(0)
    page.get_by_role("button", name="Undo", exact=True).click()
    expect(page.get_by_text("is kept; the settings")).to_be_visible()
    page.get_by_role("button", name="Back to the simulation").click()
    expect(wind).to_have_value(before)


def test_tune_stop_and_use_it(page: Page) -> None:
    page.get_by_role("button", name="Tune", exact=True).click()
    start, evaluations = page.get_by_role("button", name="Start tuning"), page.get_by_role("textbox", name="Evaluations")
    evaluations.fill("1000")
    evaluations.press("Enter")
    start.click()
    expect(page.get_by_text(re.compile(r"Computing, \d+ % · \d+ evaluations, best"))).to_be_visible()
    page.get_by_role("button", name="Stop").click()
    expect(page.get_by_text("Stopped")).to_be_visible()
    expect(page.get_by_role("button", name="Use it")).to_be_disabled()
    page.get_by_role("combobox", name="Observer").click()
    page.get_by_role("option", name="LGS KF", exact=True).click()
    evaluations.fill("12")
    evaluations.press("Enter")
    start.click()
    table = page.get_by_role("region", name="Before and after")
    expect(table.get_by_text("rms over modes").first).to_be_visible()
    page.get_by_role("button", name="Use it").click()
    expect(page.get_by_text(re.compile(r"changed: .*Model vibration rms"))).to_be_visible()
