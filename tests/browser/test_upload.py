"""Loading a record in a browser: a file, its preview, its results, and back."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from playwright.sync_api import expect

from wfsobs.scenario.presets import paper
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.records import save_record

SHORT = "run.duration=2&run.warm_up=0.5&gpr_online.training_size=40&gpr_offline.training_size=40"


def test_a_record_is_previewed_used_and_taken_back(open_page: Any, server: Any, tmp_path: Path) -> None:
    """A file of more than one part; one that is none first."""
    record = simulate(paper().replace({"run.duration": 7.0}))
    y = record.y_lgs.copy()
    y[100:103] = float("nan")
    save_record(tmp_path / "night.csv", replace(record, y_lgs=y, turbulence=None, vibration=None))
    assert (tmp_path / "night.csv").stat().st_size > 1_000_000
    (tmp_path / "wrong.npz").write_text("hello")

    page = open_page(url=f"{server.url}?{SHORT}")
    picker = page.get_by_label("Record file")
    picker.set_input_files(tmp_path / "wrong.npz")
    expect(page.get_by_text("wrong.npz: not an .npz file").first).to_be_visible()
    picker.set_input_files(tmp_path / "night.csv")
    expect(page.get_by_text("7000 steps at 1000 Hz, 7 s, 3 missing")).to_be_visible()
    page.get_by_role("button", name="Use this record").click()
    expect(page.get_by_text("Record night.csv: 7000 steps")).to_be_visible()
    expect(page.get_by_text("one step ahead: the record has no truth")).to_be_visible()
    expect(page.get_by_text("Recorded loop, residual")).to_be_visible()
    page.get_by_role("button", name="Back to the simulation").click()
    expect(page.get_by_text(re.compile(r"^Turbulence, tip, [\d.]+ to"))).to_be_visible()
    expect(page.get_by_text("Record night.csv")).to_have_count(0)
