"""The live loop in a browser: started, changed while it runs, paused, stopped."""

from __future__ import annotations

import re
from typing import Any

from playwright.sync_api import expect

LONG = 120_000


def test_a_loop_that_is_changed_while_it_runs(open_page: Any, server: Any) -> None:
    page = open_page(url=server.url + "?run.duration=1&run.warm_up=0.2&gpr_online.training_size=40&gpr_offline.training_size=40")
    page.get_by_role("button", name="Live", exact=True).click()
    page.get_by_role("button", name="Start", exact=True).click()
    expect(page.get_by_text(re.compile(r"^Running at 1 × real time · [1-9]"))).to_be_visible(timeout=LONG)
    table = page.get_by_role("region", name="Live")
    expect(table.get_by_text("Multi-rate, all peaks", exact=True)).to_be_visible(timeout=LONG)
    expect(page.get_by_role("figure", name="Spectra")).to_be_visible()
    wind = page.get_by_role("textbox", name="Wind speed V₀ [m/s]")
    wind.fill("20")
    wind.press("Enter")
    expect(page.get_by_role("list", name="Events")).to_contain_text("Wind speed V₀ 15 → 20 m/s", timeout=LONG)
    page.get_by_role("button", name="Pause", exact=True).click()
    expect(page.get_by_text(re.compile("^Paused at 1 × real time"))).to_be_visible(timeout=LONG)
    page.get_by_role("button", name="Play", exact=True).click()
    expect(page.get_by_text(re.compile("^Running at 1 × real time"))).to_be_visible(timeout=LONG)
    page.get_by_role("button", name="Stop", exact=True).click()
    expect(page.get_by_text("Stopped", exact=True)).to_be_visible(timeout=LONG)
    expect(page.get_by_role("button", name="Start", exact=True)).to_be_enabled()
