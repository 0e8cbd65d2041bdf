"""The history in a browser: results come, are starred, named, compared, restored, saved to a file and opened from it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from playwright.sync_api import Locator, Page, expect

from tests.browser.conftest import QUICK, eventually, until
from tests.browser.test_pages import PINNED

OWN = QUICK + "&run.seed=7"


def sheet(page: Page) -> Locator:
    return page.get_by_role("dialog", name="History")


def rows(page: Page) -> Locator:
    return sheet(page).get_by_role("listitem")


def row(page: Page, name: str) -> Locator:
    """The row of a result; its name is what stands in a box."""
    return rows(page).filter(has=page.get_by_role("button", name=f"Restore {name}", exact=True))


def wind(page: Page, speed: str) -> None:
    box = page.get_by_role("textbox", name="m/s")
    box.fill(speed)
    box.press("Enter")


def current(page: Page, name: str) -> None:
    """Wait until the result of that name is the one shown."""
    expect(sheet(page).locator(".current .name")).to_have_value(name)


def scores(page: Page) -> list[str]:
    """RMS errors of all rows of the table, without the intervals over seeds."""
    found = cells_of_first_column(page)
    return [text.split()[-1] for text in found]


def cells_of_first_column(page: Page) -> list[str]:
    return page.locator("table.rms tr[data-observer] td:nth-child(2)").all_inner_texts()


def test_a_session_from_runs_to_a_file_and_back(open_page: Any, server: Any, tmp_path: Path) -> None:
    page = open_page(url=f"{server.url}{OWN}")
    page.keyboard.press("h")
    expect(sheet(page)).to_be_visible()
    expect(sheet(page).get_by_role("button", name="Close")).to_be_focused()
    expect(rows(page)).to_have_count(1)
    first = sheet(page).locator(".current .name").input_value()
    assert first.startswith("Preset Paper, ")
    before = scores(page)

    wind(page, "22")
    windy = "Wind speed V₀ 15 → 22 m/s"
    current(page, windy)
    wind(page, "30")
    current(page, "Wind speed V₀ 22 → 30 m/s")
    expect(rows(page)).to_have_count(3)

    row(page, windy).get_by_role("button", name=f"Star {windy}").click()
    expect(row(page, windy).get_by_role("button", name=f"Star {windy}")).to_have_attribute("aria-pressed", "true")
    row(page, windy).get_by_role("textbox").fill("windy")
    row(page, windy).get_by_role("textbox").press("Enter")
    sheet(page).get_by_role("checkbox", name="Starred only").click()
    expect(sheet(page).get_by_role("checkbox", name="Starred only")).to_be_checked()  # of the sheet drawn again
    expect(rows(page)).to_have_count(1)
    expect(row(page, "windy")).to_be_visible()
    sheet(page).get_by_role("checkbox", name="Starred only").click()

    for name, letter in ((first, "A"), ("windy", "B")):
        row(page, name).get_by_role("checkbox").check()
        expect(page.get_by_role("columnheader", name=f"{letter} [nm]")).to_be_visible()
    of_a = page.locator('tr[data-observer="kf-lgs"][data-target="turbulence"] td').nth(1)
    of_kf = [
        i
        for i, text in enumerate(
            page.locator("table.rms tr[data-observer]").evaluate_all(
                "rows => rows.map(row => `${row.dataset.observer} ${row.dataset.target}`)"
            )
        )
        if text == "kf-lgs turbulence"
    ]
    assert of_kf
    expect(of_a).to_have_text(re.compile(r"[+−][\d.]+ % \d"))
    legend = page.get_by_role("status").filter(has_text="Compared with")
    expect(legend).to_contain_text("windy since then: Wind speed V₀ 22 → 30 m/s")
    until(page, f"({PINNED})().every(n => n > 0)")

    row(page, first).get_by_role("button", name="Restore").click()
    current(page, first)
    expect(page.get_by_role("textbox", name="m/s")).to_have_value("15")
    expect(rows(page)).to_have_count(3)
    eventually(page, lambda: sorted(scores(page)) == sorted(before))

    row(page, "windy").get_by_role("button", name="Delete").click()
    expect(rows(page)).to_have_count(2)
    sheet(page).get_by_role("button", name="Undo delete").click()
    expect(row(page, "windy")).to_be_visible()

    sheet(page).get_by_role("button", name="Close").click()
    expect(sheet(page)).to_be_hidden()
    with page.expect_download() as download:
        page.get_by_role("button", name="File", exact=True).click()
        page.get_by_role("button", name="Save session").click()
    file = tmp_path / "mine.wfsobs-session"
    download.value.save_as(file)

    page = open_page(url=f"{server.url}{QUICK}&turbulence.wind_speed=11")
    expect(page.get_by_role("textbox", name="m/s")).to_have_value("11")
    (tmp_path / "none.wfsobs-session").write_bytes(file.read_bytes()[:500])
    page.get_by_label("Record file").set_input_files(tmp_path / "none.wfsobs-session")
    expect(page.get_by_text("none.wfsobs-session: damaged, or no session of wfsobs")).to_be_visible()
    expect(sheet(page)).to_be_hidden()
    page.get_by_label("Record file").set_input_files(file)
    expect(rows(page)).to_have_count(4)
    current(page, first)
    expect(page.get_by_role("textbox", name="m/s")).to_have_value("15")
    eventually(page, lambda: sorted(scores(page)) == sorted(before))  # bit for bit the same simulation
    expect(row(page, "windy").get_by_role("button", name="Star windy")).to_have_attribute("aria-pressed", "true")
    row(page, "windy").get_by_role("button", name="Restore").click()
    current(page, "windy")
    expect(page.get_by_role("textbox", name="m/s")).to_have_value("22")
    page.keyboard.press("Escape")
    expect(sheet(page)).to_be_hidden()
    page.get_by_role("button", name="History").click()
    expect(sheet(page)).to_be_visible()
    page.keyboard.press("Escape")
    expect(sheet(page)).to_be_hidden()
    expect(page.get_by_role("button", name="History")).to_be_focused()
