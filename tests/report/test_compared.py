"""Compared runs in a report: their names and errors, and the change from there."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest

from wfsobs.app.compared import ComparedRun, comparison_of
from wfsobs.app.report.data import Report, state_of
from wfsobs.app.report.page import page
from wfsobs.evaluation.result import Result


def test_errors_and_changes_of_every_run(result: Result, parse: Any) -> None:
    worse = tuple(replace(s, rms=1.25 * s.rms) for s in result.scores)
    few = tuple(s for s in result.scores if s.observer == "kf-lgs")
    runs = [
        ComparedRun("1", "A", "Wind <20 m/s>", result.scenario, worse),
        ComparedRun("2", "C", "Seed 7", result.scenario, few),
    ]
    report = Report("paper", result.scenario, (), (state_of(result),), comparison=comparison_of(runs, result, None))
    text = page(report, datetime(2026, 1, 2, tzinfo=UTC))
    assert "<strong>A</strong> Wind &lt;20 m/s&gt;" in text and "<strong>C</strong> Seed 7" in text
    tables = [table for table in parse(text).tables if table[0] == ["Observer", "shown [nm]", "A [nm]", "C [nm]"]]
    assert len(tables) == len({(s.target, s.mode) for s in result.scores})
    rows = {row[0]: row[1:] for row in tables[0][1:]}
    first = next(s for s in result.scores if s.observer == "kf-multi")
    shown, before, missing = rows["Multi-peak KF"]
    assert float(shown) == pytest.approx(1e3 * first.rms, rel=5e-3), "three digits"
    assert float(before.split()[0]) == pytest.approx(1.25e3 * first.rms, rel=5e-3) and before.endswith("(−20.0 %)")
    assert missing == "–" and rows["LGS KF"][2].endswith("(+0.0 %)")


def test_without_any_there_is_no_section(result: Result) -> None:
    assert comparison_of([], result, None) is None
    text = page(Report("paper", result.scenario, (), (state_of(result),)), datetime(2026, 1, 2, tzinfo=UTC))
    assert "Compared runs" not in text
