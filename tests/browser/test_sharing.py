"""Undo, links, files: what a user takes along and brings back."""

from __future__ import annotations

import re
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Download, Locator, Page, expect

from tests.browser.conftest import QUICK, until
from wfsobs.app.style import look


@pytest.fixture
def open_short(open_page: Any, server: Any) -> Callable[..., Page]:
    """The dashboard on a short record, by a link."""

    def open_it(more: str = "", **options: Any) -> Page:
        return open_page(url=f"{server.url}{QUICK}{more}", **options)

    return open_it


@pytest.fixture(scope="module")
def short(open_shared: Any, server: Any) -> Page:
    """A page on that record for the tests below, in this order."""
    return open_shared(url=server.url + QUICK)


def speed(page: Page) -> Any:
    return page.get_by_role("textbox", name="m/s")


def set_speed(page: Page, text: str) -> None:
    speed(page).fill(text)
    speed(page).press("Enter")


def choose(page: Page, menu: str, item: str) -> None:
    page.get_by_role("button", name=menu, exact=True).click()
    page.get_by_role("button", name=item, exact=True).click()


def saved(page: Page, item: str, to: Path) -> Path:
    with page.expect_download() as waiting:
        choose(page, "File", f"Save {item}")
    download: Download = waiting.value
    path = to / download.suggested_filename
    download.save_as(path)
    expect(page.get_by_text("Saved ")).to_be_visible()
    return path


def copied(page: Page, item: str) -> Locator:
    """The text box that stands in for a clipboard that is refused; from a copy before it may have what that has put there."""
    page.evaluate("() => { navigator.clipboard.writeText = () => Promise.reject() }")
    choose(page, "Share", item)
    return page.get_by_role("textbox", name="Copy this by hand")


WINDOW = re.compile(r"\d\.\d\d – \d\.\d\d s")
"""Start and end of the time window, as the page writes it."""


def test_back_and_reload_return_to_the_view(short: Page) -> None:
    page = short
    start = page.evaluate("location.search")
    page.get_by_role("button", name="Tilt", exact=True).click()
    until(page, "location.search.includes('view.mode=tilt')")
    tilt = page.evaluate("location.search")
    page.get_by_role("button", name="Model", exact=True).click()
    until(page, "location.search.includes('view.page=model')")
    expect(page.get_by_role("heading", name=re.compile("State space"))).to_be_visible()
    page.go_back()
    expect(page.get_by_role("heading", name="RMS errors")).to_be_visible()
    until(page, "address => location.search === address", arg=tilt)
    page.get_by_role("button", name="Time window: 0.2 s").click()
    until(page, "location.search.includes('view.window=')")
    page.locator(".card[data-name=kf-lgs]").first.dblclick()
    # Not that of the first click of the two, which hides the line.
    until(page, "/view.hide.turbulence=/.test(location.search) && !/kf-lgs/.test(location.search)")
    address, stretch = page.evaluate("location.search"), page.locator("p.stretch").first
    expect(stretch).to_contain_text(WINDOW)
    window = WINDOW.search(stretch.inner_text())
    page.reload()
    expect(page.get_by_role("button", name="Tilt", exact=True)).to_have_attribute("aria-pressed", "true")
    expect(page.locator(".card[data-name=kf-multi]").first).to_have_attribute("aria-pressed", "false")
    expect(stretch).to_contain_text(window[0])
    until(page, "address => location.search === address", arg=address)
    page.go_back()
    until(page, "address => location.search === address", arg=start)
    expect(page.get_by_role("button", name="Tip", exact=True)).to_have_attribute("aria-pressed", "true")


def test_undo_by_key_and_by_button(short: Page) -> None:
    page = short
    set_speed(page, "20")
    until(page, "location.search.includes('turbulence.wind_speed=20')")
    page.locator("h2", has_text="Turbulence").click()
    page.keyboard.press("Control+z")
    expect(speed(page)).to_have_value("15")
    until(page, "!location.search.includes('turbulence.wind_speed')")
    page.keyboard.press("Control+Shift+z")
    expect(speed(page)).to_have_value("20")
    page.get_by_role("button", name="Undo", exact=True).click()
    expect(speed(page)).to_have_value("15")
    page.get_by_role("button", name="Redo", exact=True).click()
    expect(speed(page)).to_have_value("20")  # its address follows a little later, at the latest with the next view
    expect(page.get_by_role("button", name="Redo", exact=True)).to_be_disabled()
    speed(page).press("Control+z")
    page.get_by_role("button", name="Tilt", exact=True).click()
    until(page, "location.search.includes('view.mode=tilt')")  # the answer to what came after the keys
    assert "turbulence.wind_speed=20" in page.url, "in a text the keys belong to the text"


def test_a_link_with_one_bad_field(open_short: Any, open_page: Any) -> None:
    page = open_short("&turbulence.wind_speed=200&vibration.peaks=45,0.03,0.01,0.01;20,0,0.005,0")
    expect(page.get_by_text("Not used from the link: turbulence.wind_speed = 200")).to_be_visible()
    expect(page.locator('[data-cell$=".frequency"]')).to_have_count(2)
    expect(speed(page)).to_have_value("15")
    set_speed(page, "25")
    page.get_by_role("button", name="Dismiss").click()
    until(page, "location.search.includes('turbulence.wind_speed=25')")
    box = copied(page, "Copy link")
    expect(box).to_have_value(re.compile("turbulence.wind_speed=25"))
    link = box.input_value()
    expect(page).to_have_url(link)

    other = open_page(url=link)
    expect(speed(other)).to_have_value("25")
    expect(other.locator('[data-cell="1.frequency"]')).to_have_value("20")
    expect(other.get_by_text("Not used")).to_have_count(0)
    cell = 'tr[data-observer="kf-lgs"][data-target="turbulence"] td'
    expect(other.locator(cell).first).to_have_text(re.compile(r"\d\s*$"))
    value = other.locator(cell).first.inner_text().split()[-1]  # an interval over seeds comes before
    expect(page.locator(cell).first).to_have_text(re.compile(rf"(^|\s){re.escape(value)}\s*$"))


def test_other_languages(short: Page) -> None:
    page = short
    expect(copied(page, "Copy as command line")).to_have_value(re.compile("^wfsobs run --preset paper --set "))
    expect(copied(page, "Copy as Python")).to_have_value(re.compile(re.escape('wfsobs.PRESETS["paper"]().replace({')))


def test_data_and_figures(short: Page, tmp_path: Path) -> None:
    page = short
    lines = saved(page, "data as CSV", tmp_path).read_text(encoding="utf-8").splitlines()
    names, *rows = [line for line in lines if not line.startswith("#")]
    assert len(rows) == 2000 and {len(row.split(",")) for row in rows} == {len(names.split(","))}
    tomllib.loads("\n".join(line[1:] for line in lines if line.startswith("#")))
    with np.load(saved(page, "data as NPZ", tmp_path), allow_pickle=False) as file:
        assert file["y_lgs"].shape == file["gpr-online/vibration"].shape == (2000, 2)
    for name in ("Turbulence time trace", "Vibration spectrum"):
        root = ET.parse(saved(page, f"{name} as SVG", tmp_path)).getroot()
        assert root.tag == "{http://www.w3.org/2000/svg}svg" and len(list(root.iter())) > 50
        strip = page.locator(".strip").nth(0 if name.startswith("Turbulence") else 1)
        expect(strip.locator(".card[aria-pressed=true]").nth(3)).to_be_visible()
        cards = strip.locator(".card[aria-pressed=true]").evaluate_all("cards => cards.map(it => it.dataset.name)")
        labels = {look(line).label for line in cards if line != "truth"}  # of errors at first, which truth has none of
        assert labels <= {it.text for it in root.iter("{http://www.w3.org/2000/svg}text")}, "the legend"


def test_a_scenario_out_and_in_again(short: Page, tmp_path: Path) -> None:
    page = short
    set_speed(page, "22")
    until(page, "location.search.includes('turbulence.wind_speed=22')")
    path = saved(page, "scenario as TOML", tmp_path)
    assert tomllib.loads(path.read_text(encoding="utf-8"))["turbulence"]["wind_speed"] == 22.0
    page.get_by_role("button", name="Reset", exact=True).click()
    expect(speed(page)).to_have_value("15")
    file = page.get_by_label("Record file")
    bad = tmp_path / "bad.toml"
    bad.write_text("run.seed = -1", encoding="utf-8")
    file.set_input_files(bad)
    expect(page.get_by_text("bad.toml: run.seed = -1")).to_be_visible()
    expect(speed(page)).to_have_value("15")
    file.set_input_files(path)
    expect(speed(page)).to_have_value("22")
    expect(page.get_by_text("Opened wfsobs.toml.")).to_be_visible()
    expect(page.get_by_text("bad.toml")).to_have_count(0)
    expect(page.locator("[role=status]", has_text="Done in").first).to_be_attached()


def test_a_long_run_waits(open_short: Any) -> None:
    page = open_short("&run.duration=400", wait=False)
    expect(page.get_by_text("s: press Run.").first).to_be_visible()
    expect(page.get_by_role("status").filter(has_text="press Run").first).to_be_visible()
    set_speed(page, "20")
    expect(page.get_by_text("s: press Run.").first).to_be_visible()


def test_menus_by_keyboard(short: Page) -> None:
    page = short
    button = page.get_by_role("button", name="Share", exact=True)
    button.focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("group", name="Share", exact=True)).to_be_visible()
    page.keyboard.press("Tab")
    expect(page.get_by_role("button", name="Copy link")).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.get_by_role("group", name="Share", exact=True)).to_be_hidden()
    expect(button).to_be_focused()


def test_back_before_the_page_is_drawn_is_heard(open_page: Any, server: Any) -> None:
    left = "if (location.pathname.endsWith('/app')) history.replaceState(null, '', location.pathname)"
    page = open_page(url=f"{server.url}?view.mode=tilt", seeds=0, script=left, wait=False)
    expect(page.get_by_role("button", name="Tip", exact=True)).to_have_attribute("aria-pressed", "true")
