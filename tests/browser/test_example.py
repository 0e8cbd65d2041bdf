"""An observer of another package on the page: its row, its settings in the drawer, and a run with what is set there."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import expect

from tests.browser.conftest import QUICK


@pytest.fixture
def with_example(make_server: Any, example: Path, tmp_path: Path) -> Iterator[Any]:
    server = make_server(["-m", "wfsobs", "serve", "--port", "{port}"], tmp_path / "log", "/", packages=example)
    yield server
    server.close()
    assert server.errors(0) == []


def test_settings_of_another_package_in_the_drawer(with_example: Any, open_page: Any, tmp_path: Path) -> None:
    page = open_page(url=with_example.url + QUICK)
    row = page.locator('tr[data-observer="low-pass"][data-target="turbulence"]')
    expect(row).to_contain_text("Low-pass")
    error = row.get_by_role("cell").first
    expect(error).to_have_text(re.compile(r"\d$"))
    before = error.inner_text().split()[-1]  # an interval over seeds comes before it
    page.get_by_role("button", name="Low-pass", exact=True).click()  # the topic
    box = page.get_by_role("textbox", name="Corner [Hz]", exact=True)
    expect(box).to_have_value("150")
    expect(page.get_by_role("slider", name="Corner [Hz]", exact=True)).to_be_attached()
    box.fill("0")
    box.press("Enter")
    expect(page.get_by_text("takes a number from 0.1 to 10000 Hz")).to_be_visible()
    box.fill("1")
    box.press("Enter")
    expect(error).to_have_text(re.compile(rf"^(?!(.*\s)?{re.escape(before)}$).*\d$", re.S))
    expect(page.get_by_text("Low-pass: Corner").first).to_be_visible()
    page.screenshot(path=tmp_path / "drawer.png")
