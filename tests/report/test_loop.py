"""The closed loop in a report: the rows of `wfsobs loop`."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from wfsobs.app.render import number
from wfsobs.app.report.data import Report, state_of
from wfsobs.app.report.page import page
from wfsobs.closed_loop.run import LIMITED, NOT_APPLICABLE, label
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.result import Result
from wfsobs.evaluation.scores import COMMON_BOUNDS
from wfsobs.scenario import Scenario

MADE = datetime(2024, 1, 2, tzinfo=UTC)


@pytest.fixture(scope="module")
def report(result: Result, short: Scenario) -> Report:
    return Report("paper", short, (), (state_of(result),))


def test_rows_of_the_controllers_that_take_a_moment(report: Report) -> None:
    (state,) = report.states
    quick = [name for name, controller in CONTROLLERS.items() if controller.is_quick]
    assert [(r["controller"], r["mode"]) for r in state.loop] == [
        (n, m) for n in (*quick, *COMMON_BOUNDS) for m in ("tip", "tilt")
    ]


def test_they_stand_in_the_page_best_first(report: Report) -> None:
    text = page(report, MADE)
    section = text[text.index("<h2>Closed loop</h2>") : text.index("<h2>Scenario</h2>")]
    tip, tilt = section.split('<tbody data-mode="')[1:]
    for mode, body in (("tip", tip), ("tilt", tilt)):
        rows = sorted((r for r in report.states[0].loop if r["mode"] == mode), key=lambda r: r["residual_rms_nm"])
        at = [body.index(f'data-controller="{r["controller"]}"') for r in rows]
        assert at == sorted(at)
        for row in rows:
            assert label(row["controller"]) in body and f"{row['strehl']:.4f}" in body


def test_an_unstable_loop_says_so(result: Result) -> None:
    changed = replace(result, scenario=result.scenario.replace({"control.integrator": "manual", "control.gain": 1.5}))
    text = page(Report("paper", changed.scenario, (), (state_of(changed),)), MADE)
    assert text.count("unstable</span>") == 2


def test_a_limited_loop_has_its_share_and_no_theory(result: Result, report: Report) -> None:
    changed = replace(result, scenario=result.scenario.replace({"control.stroke": 0.05}))
    state = state_of(changed)
    text = page(Report("paper", changed.scenario, (), (state,)), MADE)
    section = text[text.index("<h2>Closed loop</h2>") : text.index("<h2>Scenario</h2>")]
    limited = [row for row in state.loop if row["limited"]]
    assert limited and not any(row["limited"] for row in report.states[0].loop)
    assert section.count(f"<td>{NOT_APPLICABLE}</td>") == 4 * len(limited) and LIMITED in section
    assert all(f"<td>{number(100.0 * row['limited'], 2)}</td>" in section for row in limited)


def test_a_record_without_a_truth_has_no_such_section(result: Result, short: Scenario) -> None:
    bare = replace(result, record=replace(result.record, turbulence=None), scores=())
    assert "<h2>Closed loop</h2>" not in page(Report("paper", short, (), (state_of(bare),)), MADE)
