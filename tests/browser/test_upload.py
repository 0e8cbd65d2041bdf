"""Loading a record in a browser: a file, its preview, its results, and back."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from tests.browser.conftest import until
from wfsobs.scenario.presets import paper
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.records import save_record

SHORT = "run.duration=2&run.warm_up=0.5&gpr_online.training_size=40&gpr_offline.training_size=40"

ABOVE = "([one, other]) => one.getBoundingClientRect().bottom <= other.getBoundingClientRect().top"


@pytest.fixture(scope="module")
def page(open_shared: Any, server: Any) -> Page:
    """A page for the tests below, in this order."""
    return open_shared(url=f"{server.url}?{SHORT}")


def test_a_record_is_previewed_used_and_taken_back(page: Page, tmp_path: Path) -> None:
    """A file of more than one part; one that is none first."""
    record = simulate(paper().replace({"run.duration": 7.0}))
    y = record.y_lgs.copy()
    y[100:103] = float("nan")
    save_record(tmp_path / "night.csv", replace(record, y_lgs=y, turbulence=None, vibration=None))
    assert (tmp_path / "night.csv").stat().st_size > 1_000_000
    (tmp_path / "wrong.npz").write_text("hello")

    picker = page.get_by_label("Record file")
    picker.set_input_files(tmp_path / "wrong.npz")
    expect(page.get_by_text("wrong.npz: not an .npz file").first).to_be_visible()
    picker.set_input_files(tmp_path / "night.csv")
    expect(page.get_by_text("7000 steps at 1000 Hz, 7 s, 3 missing")).to_be_visible()
    page.get_by_role("button", name="Use this record").click()
    expect(page.get_by_text("Record night.csv: 7000 steps")).to_be_visible()
    switch, back = page.get_by_role("button", name="Tilt", exact=True).first, page.locator("button[data-do=simulate]")
    until(page, ABOVE, arg=[switch.element_handle(), back.element_handle()])
    expect(page.get_by_role("row", name=re.compile("^Next measurement, tip, with the mean over"))).to_be_visible()
    expect(page.get_by_role("row", name=re.compile("^Residual, tip, what the recorded loop left"))).to_be_visible()
    page.get_by_role("button", name="Back to the simulation").click()
    expect(page.get_by_text(re.compile(r"^Turbulence, tip, [\d.]+ to"))).to_be_visible()
    expect(page.get_by_text("Record night.csv")).to_have_count(0)


def test_template_and_sample(page: Page, tmp_path: Path) -> None:
    """The sample is a record that can be loaded at once."""
    dialog = page.get_by_role("dialog", name="Load data")
    for button, name in (("Template CSV", "wfsobs-template.csv"), ("Sample record", "wfsobs-sample.csv")):
        page.get_by_role("button", name="File", exact=True).click()
        page.get_by_role("button", name="Load data").click()
        expect(dialog.get_by_text("a row per step")).to_be_visible()
        with page.expect_download() as waiting:
            dialog.get_by_role("button", name=button).click()
        assert waiting.value.suggested_filename == name
        expect(dialog).to_be_hidden()
    waiting.value.save_as(tmp_path / "sample.csv")
    page.get_by_label("Record file").set_input_files(tmp_path / "sample.csv")
    expect(page.get_by_text("5000 steps at 1000 Hz, 5 s, 0 missing")).to_be_visible()
    expect(page.get_by_text("truth: turbulence and vibration")).to_be_visible()
    page.get_by_role("button", name="Discard").click()
    expect(page.get_by_text("5000 steps at 1000 Hz, 5 s, 0 missing")).not_to_be_visible()


def test_a_dropped_file_whose_columns_are_said_what_they_are(page: Page) -> None:
    """Dropped on the table, far from the button; names that say nothing; every choice by a menu of the form."""
    record = simulate(paper().replace({"run.duration": 3.0}))
    table = np.column_stack([record.y_lgs, record.u]).tolist()
    text = "\n".join(["a,b,c,d", *(",".join(map(repr, row)) for row in table)])
    page.evaluate(
        """([name, text]) => {
            const files = new DataTransfer()
            files.items.add(new File([text], name, {type: "text/csv"}))
            for (const kind of ["dragenter", "dragover", "drop"])
                document.querySelector("main, body").dispatchEvent(
                    new DragEvent(kind, {bubbles: true, composed: true, cancelable: true, dataTransfer: files}))
        }""",
        ["odd.csv", text],
    )
    expect(page.get_by_text("odd.csv: has no y_lgs").first).to_be_visible()
    for name, label in zip("abcd", ("measurement, tip", "measurement, tilt", "command, tip", "command, tilt"), strict=True):
        page.get_by_role("combobox", name=label.capitalize(), exact=True).click()
        page.get_by_role("option", name=re.compile(f"^{name}: ")).click()
        expect(page.get_by_role("combobox", name=label.capitalize(), exact=True)).to_have_text(re.compile(f"^{name}: "))
    expect(page.get_by_text("odd.csv: has no dt and no time").first).to_be_visible()
    page.get_by_label("Rate [Hz]").fill("1000")
    page.get_by_label("Rate [Hz]").press("Enter")
    expect(page.get_by_text("3000 steps at 1000 Hz, 3 s, 0 missing")).to_be_visible()
    expect(page.get_by_text("sign +1: commands move against the measurement of their row")).to_be_visible()
    use = page.get_by_role("button", name="Use this record")
    expect(page.get_by_text(re.compile("^Choose the unit first: .* plausible as um or"))).to_be_visible()
    expect(use).to_be_disabled()
    page.get_by_role("combobox", name="Unit").click()
    page.get_by_role("option", name="um", exact=True).click()
    expect(page.get_by_text("Choose the unit first")).to_have_count(0)
    use.click()
    expect(page.get_by_text("Record odd.csv: 3000 steps")).to_be_visible()
    expect(page.get_by_role("row", name=re.compile("^Residual, tip, what the recorded loop left"))).to_be_visible()
