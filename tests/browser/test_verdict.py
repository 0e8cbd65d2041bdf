"""The sentences above the figures say what the table says."""

from __future__ import annotations

import re
from typing import Any

from playwright.sync_api import Locator, Page, expect

from wfsobs.app.display import AT_LIMIT
from wfsobs.observers.base import TARGETS


def sentences(page: Page, target: str) -> Locator:
    return page.locator("p.verdict").nth(TARGETS.index(target))


def smallest(page: Page, target: str) -> tuple[str, float]:
    """Label and error of the row that the table marks."""
    row = page.locator(f'tr[data-target="{target}"]', has=page.locator(".smallest"))
    return row.locator("th").inner_text().removesuffix(AT_LIMIT).strip(), float(row.locator("td").first.inner_text().split()[-1])


def test_the_verdict_names_the_smallest_error_of_the_table_in_the_mode_and_unit_shown(open_page: Any) -> None:
    page: Page = open_page()
    expect(page.locator(".seeds")).to_have_text("one record")  # the verdict on the record alone
    for mode, unit in (("Tip", "nm"), ("Tilt", "nm"), ("Tilt", "mas")):
        page.get_by_role("button", name=mode, exact=True).click()
        page.get_by_role("button", name=unit, exact=True).click()
        for target in ("turbulence", "vibration"):
            start = sentences(page, target)
            expect(page.get_by_role("heading", name=f"{target.capitalize()}, {mode.lower()}", exact=True)).to_be_visible()
            expect(start).to_contain_text(re.compile(rf" {unit}[,.]"))
            expect(page.get_by_role("columnheader", name=f"RMS error [{unit}]", exact=True)).to_be_visible()
            expect(page.locator("th.target", has_text=f"{target.capitalize()}, {mode.lower()}")).to_be_visible()
            label, error = smallest(page, target)
            expect(start).to_contain_text(f": {label} ")
            said = re.search(rf": {re.escape(label)} ([\d.]+) ± [\d.]+ {unit}[,.]", start.inner_text())
            # Three digits either way.
            assert said and abs(float(said[1]) / error - 1.0) < 0.006
    expect(page.locator("table.rms").get_by_text("best", exact=True)).to_have_count(0)  # one record cannot tell
    expect(sentences(page, "vibration")).to_contain_text(
        re.compile("than assuming no vibration: (their models have|its model has) one of")
    )
    # Known a moment later, from the error budgets.
    expect(sentences(page, "vibration")).to_contain_text(re.compile(r"% of (their|its) error comes from unmodelled peaks"))
