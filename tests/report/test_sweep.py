"""A sweep in a report: its maps, its lines over one setting and its table, as they stand on the page of sweeps."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest
from bokeh.document import Document
from scipy import stats

from wfsobs.app.pages.sweep_views import report_part
from wfsobs.app.report.data import Report, state_of
from wfsobs.app.report.page import page
from wfsobs.campaign.sweep import SweepResults, parse_axis, plan_sweep
from wfsobs.evaluation.result import Result
from wfsobs.evaluation.scores import Score
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
    text = page(report, datetime(2026, 1, 2, tzinfo=UTC))
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
    without = page(Report("paper", result.scenario, (), (state_of(result),)), datetime(2026, 1, 2, tzinfo=UTC))
    assert "Best observers" not in without


def test_lines_over_one_setting(short: Scenario, result: Result, parse: Any) -> None:
    """One figure per target and mode: means and Student's intervals of every observer, by increasing value."""
    values = "20,5,10"
    results = SweepResults(plan_sweep(short, [parse_axis(f"turbulence.wind_speed={values}")], 4, ["kf-lgs", "kf-multi"]))
    speeds = [float(v) for v in values.split(",")]
    errors = {(speed, seed): 1e-3 * (speed + 0.5 * seed**2) for speed in (5.0, 10.0) for seed in range(4)}  # 20 is not run yet
    for (speed, _), error in errors.items():
        score = Score("kf-multi", "vibration", "tip", error, 0.02, None, None, 0.0)
        bound = Score("bound", "vibration", "tip", 2e-3, 0.02, None, None, 0.0)
        results = results.add(speeds.index(speed), [score, bound])
    report = Report("paper", result.scenario, (), (state_of(result),), sweep=report_part(results))
    it = parse(page(report, datetime(2026, 1, 2, tzinfo=UTC)))
    assert "Error over Wind speed V₀, vibration, tip" in it.text
    figures = it.data("figures")
    drawn = [name for name in figures["roots"].values() if name.startswith("part-")]
    assert drawn == ["part-0"] and ("div", "part-0") in {(tag, attributes.get("id")) for tag, attributes in it.tags}
    figure = Document.from_json(figures["document"]).get_model_by_name("part-0")
    assert figure.xaxis[0].axis_label == "Wind speed V₀ [m/s]" and figure.yaxis[0].axis_label == "mean rms error, tip [nm]"
    lines = {r.name: r.data_source.data for r in figure.renderers if type(r.glyph).__name__ == "Line"}
    assert {"kf-lgs", "kf-multi", "bound"} <= set(lines)
    line = lines["kf-multi"]
    samples = np.array([[1e3 * errors[speed, seed] for seed in range(4)] for speed in (5.0, 10.0)])
    half = stats.t.ppf(0.975, 3) * samples.std(axis=1, ddof=1) / 2.0
    expected = {"y": samples.mean(axis=1), "low": samples.mean(axis=1) - half, "high": samples.mean(axis=1) + half}
    assert list(line["x"]) == [5.0, 10.0, 20.0]
    for name, column in expected.items():
        assert np.allclose(line[name], [*column, np.nan], rtol=1e-9, atol=0.0, equal_nan=True), name
    assert np.allclose(lines["bound"]["y"], [2.0, 2.0, np.nan], rtol=1e-12, atol=0.0, equal_nan=True)
    assert figure.y_range.end > max(line["y"][:2])


def test_no_lines_over_two_settings(results: SweepResults, result: Result, parse: Any) -> None:
    report = Report("paper", result.scenario, (), (state_of(result),), sweep=report_part(results))
    it = parse(page(report, datetime(2026, 1, 2, tzinfo=UTC)))
    assert not any(name.startswith("part-") for name in it.data("figures")["roots"].values())
