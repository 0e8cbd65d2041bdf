"""The page of the closed loop in a browser."""

from __future__ import annotations

import re
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import until

QUICK = "?run.duration=2&gpr_online.training_size=40&gpr_online.depth=20"


@pytest.fixture(scope="module")
def shared(open_shared: Any, server: Any) -> Page:
    page = open_shared(url=server.url + QUICK)
    page.get_by_role("button", name="Closed loop", exact=True).click()
    return page


@pytest.fixture
def page(shared: Page) -> Page:
    """The page in a wide window."""
    shared.set_viewport_size({"width": 1400, "height": 1000})
    return shared


def test_controllers_side_by_side(page: Page) -> None:
    expect(page.get_by_role("heading", name="Residual in closed loop")).to_be_visible()
    for name in ("integrator+gpr-online", "lqg-multirate-multi", "integrator", "none"):
        expect(page.locator(f'tr[data-controller="{name}"] td').first).to_have_text(re.compile(r"\d$"))
    best = page.locator('tr[data-controller="lqg-multirate-multi"]')
    expect(best.locator(".smallest")).to_be_visible()
    cells = [page.locator(f'tr[data-controller="{name}"] td').first for name in ("lqg-multirate-multi", "integrator", "none")]
    residuals = [float(cell.inner_text().split()[-1]) for cell in cells]
    assert residuals == sorted(residuals)
    card = page.locator('button.card[data-name="integrator"]')
    card.click()
    expect(card).to_have_attribute("aria-pressed", "false")
    page.set_viewport_size({"width": 390, "height": 844})
    until(page, "() => document.documentElement.scrollWidth <= 390")


def test_an_uncertain_plant_is_asked_for(page: Page) -> None:
    page.get_by_role("button", name="Compute", exact=True).click()
    expect(page.get_by_role("button", name="Stop", exact=True)).to_be_enabled()
    worst = page.locator('tr[data-controller="integrator"] td').nth(3)
    expect(worst).to_have_text(re.compile(r"\d$"))  # the first controllers are there while the others are computed
    expect(page.locator("p.verdict", has_text="Residual, tip")).to_contain_text("With the plant uncertain (delay ±0.5 frames")
    expect(page.get_by_role("figure", name="Residual against delay error")).to_be_visible()
    page.set_viewport_size({"width": 390, "height": 844})
    until(page, "() => document.documentElement.scrollWidth <= 390")
