"""A sweep in a report: its maps and its table, as they stand on the page of sweeps."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from wfsobs.app.pages.sweep_views import report_part
from wfsobs.app.report.data import Report, state_of
from wfsobs.app.report.packing import pack, unpack
from wfsobs.app.report.page import page
from wfsobs.campaign.sweep import parse_axis, plan_sweep
from wfsobs.campaign.sweep_results import SweepResults
from wfsobs.evaluation.scores import Score
from wfsobs.result import Result
from wfsobs.scenario import Scenario


@pytest.fixture
def results(short: Scenario) -> SweepResults:
    """Two by two cells, the multi-peak filter clearly the best in the first, by half, and nothing known of the last."""
    axes = [parse_axis("turbulence.wind_speed=5,20"), parse_axis("sensors.exposure_ratio=5,10")]
    results = SweepResults(plan_sweep(short, axes, 4))
    for cell in range(3):
        for seed in range(4):
            errors = {"kf-lgs": 0.015 + 0.001 * seed, "kf-multi": 0.010 + 0.001 * seed if cell == 0 else 0.016 - 0.001 * seed}
            results = results.add(cell, [Score(n, "vibration", "tip", rms, 0.02, None, None, 0.0) for n, rms in errors.items()])
    return results


def test_maps_and_table(results: SweepResults, result: Result, parse: Any) -> None:
    report = Report("paper", result.scenario, (), (state_of(result),), sweep=report_part(results))
    text = page(unpack(pack(report)), datetime(2026, 1, 2, tzinfo=UTC))
    it = parse(text)
    cells = [attributes for tag, attributes in it.tags if tag == "td" and "data-state" in attributes]
    assert [c["data-state"] for c in cells] == ["open", "waiting", "decided", "open"], "5 at the bottom, 10 above it"
    mean = 10.0 + np.mean([0, 1, 2, 3])
    assert f"Multi-peak KF {mean:.1f} nm, {100 * 5 / mean:.0f} % before the next; 4 seeds" in str(cells[2]["title"])
    rows = next(table for table in it.tables if table[0][:3] == ["Wind speed V₀ [m/s]", "Exposure ratio n", "target"])
    assert len(rows) == 1 + 3 * 2
    (best,) = (row for row in rows if row[:2] == ["5", "5"] and row[-1] == "best")
    assert best[2:7] == ["vibration", "tip", "Multi-peak KF", "4", f"{mean:.1f}"]
    low, high = (float(x) for x in best[7].split(" – "))
    assert low < mean < high and low + high == pytest.approx(2 * mean, abs=0.11), "rounded to 0.05 each"
    without = page(unpack(pack(Report("paper", result.scenario, (), (state_of(result),)))), datetime(2026, 1, 2, tzinfo=UTC))
    assert "Best observers" not in without
