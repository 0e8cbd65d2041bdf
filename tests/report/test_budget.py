"""The error budgets and the intervals over seeds in a report, against those of the core."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from itertools import takewhile
from typing import Any

import pytest

from wfsobs.app.display import AT_LIMIT
from wfsobs.app.render import number
from wfsobs.app.report.data import Report, State, state_of
from wfsobs.app.report.page import page
from wfsobs.app.report.sections import budget_groups
from wfsobs.evaluation.budget import TERMS, error_budget
from wfsobs.evaluation.evidence import gather_evidence
from wfsobs.evaluation.result import Result, row_label, target_title
from wfsobs.evaluation.scores import BOUND, SCORED
from wfsobs.observers.base import TARGETS
from wfsobs.pipeline import run
from wfsobs.scenario import Scenario

MADE = datetime(2026, 1, 2, tzinfo=UTC)


def test_every_linear_observer_has_its_terms_in_the_page(result: Result, short: Scenario, parse: Any) -> None:
    it = parse(page(Report("paper", short, (), (state_of(result),)), MADE))
    tip, tilt, table = (t for t in it.tables if t[0][:2] == ["Observer", "Parts"])
    main = {row_label(name) for names in state_of(result).main.values() for name in names}
    for mode, few in (("tip", tip), ("tilt", tilt)):  # beside the verdict those that it names
        assert [row[0] for row in few[1:] if len(row) == 1] == [f"{target_title(target)}, {mode}" for target in TARGETS]
        assert {row[0] for row in few[1:] if len(row) > 1} <= main and all(row in table for row in few)
    assert it.text.index("Error budget") < it.text.index("RMS errors")
    assert table[0][3:] == list(TERMS.values())
    titles = [row[0] for row in table[1:] if len(row) == 1]
    assert titles == [f"{target_title(target)}, {mode}" for target in SCORED for mode in ("tip", "tilt")]
    shown: dict[tuple[str, str], list[str]] = {}
    for row in table[1:]:
        if len(row) == 1:
            title = row[0]
        else:
            shown[title, row[0]] = row[2:]
    budgets = [b for b in error_budget(result) if b.terms]
    assert len(shown) == len(budgets) > 30
    for b in budgets:
        total, *terms = shown[f"{target_title(b.target)}, {b.mode}", row_label(b.observer)]
        assert total == number(1e6 * b.total)
        for value, said in zip((b.terms[name] for name in TERMS), terms, strict=True):
            # What rounding leaves is 0.
            shown_value = number(1e6 * value) if abs(value) > 1e-6 * b.total else "0"
            assert said == f"{shown_value} {round(100.0 * value / b.total)} %".replace("-", "−")


def bar(state: State, target: str, mode: str, observer: str) -> dict[str, Any]:
    (group,) = (g for g in budget_groups(state) if (g["target"], g["mode"]) == (target, mode))
    (row,) = (row for row in group["rows"] if row["observer"] == observer)
    return row | {"marks": group["marks"]}


def test_bars_begin_at_zero_and_end_at_the_error_less_what_is_negative(result: Result) -> None:
    terms = dict(zip(TERMS, (4e-6, 3e-6, -1e-6, 0.0, 2e-6), strict=True))
    plain = dict(zip(TERMS, (3e-6, 0.0, 0.0, 0.0, 0.0), strict=True))
    rows = [
        {"observer": name, "target": "vibration", "mode": "tip", "total_um2": sum(of.values()), "terms_um2": of}
        for name, of in (("kf-lgs", terms), ("kf-multi", plain))
    ]
    bound = {"observer": BOUND, "target": "vibration", "mode": "tip", "rms_um": 2e-3}
    state = replace(state_of(result), budgets=rows, rows=[bound])
    # From -1 to 9: a tenth per nm^2.
    one, other = (bar(state, "vibration", "tip", name) for name in ("kf-lgs", "kf-multi"))
    assert one["space"] == "0.0" and [float(width) for _, width in one["pieces"]] == [10.0, 40.0, 30.0, 20.0]
    assert other["space"] == "10.0" and [float(width) for _, width in other["pieces"]] == [30.0]
    ((_, _, at),) = one["marks"]
    assert at == "50.0", "4 nm^2"


def test_what_is_not_the_simulation_of_its_settings_has_none(result: Result, short: Scenario) -> None:
    state = state_of(result, is_simulated=False)
    assert not state.budgets and "<h2>Error budget</h2>" not in page(Report("paper", short, (), (state,)), MADE)


def test_errors_have_the_interval_over_seeds_and_the_best_is_significant(short: Scenario, parse: Any) -> None:
    names = ("kf-lgs", "kf-multi", "ridge-30")
    of = [run(short.replace({"run.seed": seed}), observers=names) for seed in (1, 2, 3, 4)]
    evidence = gather_evidence([result.scores for result in of])
    report = Report("paper", short, (), (state_of(of[0], evidence=evidence),))
    it = parse(page(report, MADE))
    table = next(t for t in it.tables if "RMS error [nm]" in t[0])
    start = next(i for i, row in enumerate(table) if row[0].startswith("Vibration, tilt"))
    rows = takewhile(lambda row: not row[0].startswith("Turbulence"), table[start + 1 :])  # up to the next target
    cells = {row[0].removesuffix(AT_LIMIT).strip(): row[1].split() for row in rows if len(row) > 1}
    leaders = evidence.leaders("vibration", "tilt")
    equal = [
        name
        for name in leaders
        if evidence.mean((name, "vibration", "tilt")) <= 1.25 * evidence.mean((leaders[0], "vibration", "tilt"))
    ]
    word = "tied" if len(equal) > 1 else "best" if len(leaders) == 1 else "smallest"
    for name in names:
        interval = evidence.interval((name, "vibration", "tilt"))
        assert interval is not None
        low, dash, high, *mark, rms = cells[row_label(name)]
        assert (low, dash, high) == (number(1e3 * interval[0]), "–", number(1e3 * interval[1]))
        assert mark == ([] if name not in equal else [word])
        errors = [s.rms for it in of for s in it.scores if (s.observer, s.target, s.mode) == (name, "vibration", "tilt")]
        assert rms == number(1e3 * sum(errors) / 4), "the mean over the seeds"
    assert "from 4 seeds" in it.text and "--seeds 4" in it.text


@pytest.mark.parametrize("seeds", [1, 3])
def test_export_runs_as_many_seeds_as_asked_for(seeds: int, short: Scenario, tmp_path: Any, parse: Any) -> None:
    from wfsobs.app.report.page import export

    path = tmp_path / "r.html"
    seen: list[int] = []
    export(
        path, short, observers=["kf-lgs", "kf-multi"], seeds=seeds, on_result=lambda result: seen.append(result.scenario.run.seed)
    )
    it = parse(path.read_text(encoding="utf-8"))
    assert seen == [short.run.seed] and ("from 3 seeds" in it.text) == (seeds == 3)
