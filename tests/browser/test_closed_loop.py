"""The page of the closed loop in a browser."""

from __future__ import annotations

import re
from typing import Any

from playwright.sync_api import expect

SLOW = 60_000
"""What the slowest controller may take on a machine that is busy with other things [ms]."""
QUICK = "?run.duration=2&gpr_online.training_size=40&gpr_online.depth=20"


def test_controllers_side_by_side(open_page: Any, server: Any) -> None:
    page = open_page(url=server.url + QUICK)
    page.get_by_role("button", name="Closed loop", exact=True).click()
    expect(page.get_by_role("heading", name="Residual in closed loop")).to_be_visible(timeout=SLOW)
    rows = page.get_by_role("region", name="Controllers").locator("tr[data-controller]")
    for name in ("integrator+gpr-online", "lqg-multirate-multi", "integrator", "none"):
        expect(page.locator(f'tr[data-controller="{name}"] td').first).to_have_text(re.compile(r"\d$"), timeout=SLOW)
    best = page.locator('tr[data-controller="lqg-multirate-multi"]')
    expect(best.locator(".smallest")).to_be_visible(timeout=SLOW)
    values = rows.evaluate_all("rows => Object.fromEntries(rows.map(it => [it.dataset.controller, it.cells[1].innerText]))")
    residual = {name: float(text.split()[-1]) for name, text in values.items()}
    assert residual["lqg-multirate-multi"] < residual["integrator"] < residual["none"]
    card = page.locator('button.card[data-name="integrator"]')
    card.click()
    expect(card).to_have_attribute("aria-pressed", "false")
    page.set_viewport_size({"width": 390, "height": 844})
    page.wait_for_function("() => document.documentElement.scrollWidth <= 390")
