"""An outcome that is known is what a run would give, bit by bit, and a change runs the controllers that it reaches alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.run import Outcome, each_outcome
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.dependence import Memo
from wfsobs.record import Record
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.testing import QUICK

BASE = PRESETS["paper"]().replace({**QUICK, "run.duration": 0.5})
GPR = {"integrator+gpr-offline", "integrator+gpr-online"}
OF_LINES = {"lqg-kf-multi", "lqg-multirate-multi"}
ADAPTIVE = {"lqg-kf-adaptive", "lqg-multirate-adaptive"}
OF_ONE_LINE = {"lqg-kf-lgs", "lqg-multirate", "lqg-multirate-optimal"}

CASES: dict[str, tuple[dict[str, Any], set[str]]] = {
    "gain": ({"control.integrator": "manual", "control.gain": 0.31}, {"integrator", *GPR}),
    "line width": ({"multipeak.line_width": 1.0}, OF_LINES),
    "Kalman peak": ({"kalman.peak": "manual", "kalman.frequency": 21.0}, OF_ONE_LINE),
    "GPR": ({"gpr_online.length_scale": 20.0}, {"integrator+gpr-online"}),
    "delay": ({"control.delay": 3.0}, set(CONTROLLERS)),
    "stroke": ({"control.stroke": 0.3}, set(CONTROLLERS)),
    "supervision": ({"control.supervised": True}, set(CONTROLLERS) - {"none", "integrator"}),
    "windows of a filter": ({"adaptive.window": 0.3}, ADAPTIVE),
    "an observer's own, what the Strehl ratio is of, windows of z in the loop, and a width below that of every line": (
        {"gp.background_rms": 0.1, "control.wavelength": 1.6, "gpr_online.inputs": "z", "multipeak.line_width": 0.011},
        set(),
    ),
}


@pytest.fixture(scope="module")
def before() -> tuple[Memo, Record, list[Outcome]]:
    memo, record = Memo(), simulate(BASE)
    return memo, record, list(each_outcome(record, design(BASE), memo=memo))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_what_a_change_reaches_runs_and_nothing_else(case: str, before: tuple[Memo, Record, list[Outcome]]) -> None:
    memo, record, kept = before
    assert [o.controller for o in kept if o.residual is None] == []
    changes, reached = CASES[case]
    plan = design(BASE.replace(changes))
    found = list(each_outcome(record, plan, memo=memo))
    assert {o.controller for o in found if not any(o is old for old in kept)} == reached
    known = [o for o in found if o.controller not in reached]
    for one, alone in zip(known, each_outcome(record, plan, controllers=[o.controller for o in known]), strict=True):
        assert (one.controller, one.stable, one.limited_share) == (alone.controller, alone.stable, alone.limited_share)
        np.testing.assert_array_equal(one.residual, alone.residual)
        np.testing.assert_array_equal(one.u, alone.u)


@pytest.mark.slow
def test_another_record_runs_them_all(before: tuple[Memo, Record, list[Outcome]]) -> None:
    memo, _, kept = before
    other = simulate(BASE.replace({"run.seed": 2}))
    found = list(each_outcome(other, design(BASE), memo=memo))
    assert not any(one is old for one in found for old in kept)
