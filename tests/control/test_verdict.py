"""The verdict on controllers says what the table of their residuals says."""

from __future__ import annotations

import numpy as np
import pytest

from wfsobs import PRESETS, close_loop
from wfsobs.app.display import Display
from wfsobs.app.loop_work import LoopResults
from wfsobs.app.pages.closed_loop import loop_html
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.run import ClosedLoop, Outcome, loop_verdict, rows
from wfsobs.evaluation.scores import BOUND_BOTH, BOUNDS
from wfsobs.prior import GIVEN, IDENTIFIED, TRUE
from wfsobs.simulation.loop import simulate


@pytest.mark.slow
def test_the_verdict_is_the_least_residual_of_each_kind_of_prior_knowledge_and_the_limit() -> None:
    result = close_loop(PRESETS["paper"]().replace({"run.duration": 3.0, "adaptive.window": 0.8}))
    for mode in ("tip", "tilt"):
        table = {r["controller"]: r["residual_rms_nm"] for r in rows(result, 1) if r["mode"] == mode}
        found = loop_verdict(result, mode)
        assert found is not None
        ran = {name: left for name, left in table.items() if left is not None and name != "none" and not name.startswith("bound")}
        # The same samples: rounding.
        assert [(p.observer, 1e3 * p.rms) for p in found.places] == [
            (name, pytest.approx(ran[name], rel=1e-9)) for name in sorted(ran, key=lambda name: ran[name])
        ]
        peaks = found.best_with("peaks")
        assert peaks is not None and peaks.observer == min(("lqg-kf-multi", "lqg-multirate-multi"), key=lambda name: ran[name])
        assert found.best_with("spectra").observer == "h2-fir"  # type: ignore[union-attr]
        nothing = found.best_with("nothing")
        assert nothing is not None and nothing.observer == min(
            ("lqg-kf-adaptive", "lqg-multirate-adaptive"), key=lambda n: ran[n]
        )
        limit = found.best.limit
        assert limit is not None and 1e3 * limit[0] == pytest.approx(table[BOUND_BOTH], rel=1e-9)
        lead, *others = found.sentences()
        assert lead.startswith(f"Residual, {mode}. ") and "the theoretical limit using LGS and NGS" in lead
        for label in ("Integrator", "LQG, LGS KF"):
            assert label in " ".join([lead, *others])


def test_a_controller_that_learns_is_ranked_where_its_own_laws_close_the_loop() -> None:
    scenario = PRESETS["paper"]().replace({"run.duration": 2.0, "run.warm_up": 0.5, "adaptive.window": 1.0})
    names = ["integrator", "lqg-kf-adaptive"]
    for warm_up, ranked, said in (
        (0.5, {"integrator"}, "until its first window is full, at 1.002 s; residuals count from 0.5 s"),
        (1.2, set(names), ""),
    ):
        result = close_loop(scenario.replace({"run.warm_up": warm_up}), controllers=names)
        found = loop_verdict(result, "tip")
        assert found is not None and {place.observer for place in found.places} == ranked
        table = rows(result, 1)
        assert {r["controller"] for r in table if r["ranked"]} - set(BOUNDS) == ranked
        notes = {r["note"] for r in table if r["controller"] == "lqg-kf-adaptive"}
        assert len(notes) == 1 and said in notes.pop()
        page = loop_html(LoopResults(result, tuple(table)), Display())
        assert ('<p class="text">LQG, adaptive KF: an integrator' in page) == (said != "") and 'class="failure"' not in page
    (outcome,) = close_loop(scenario.replace({"run.duration": 0.9}), controllers=names[1:]).outcomes
    assert outcome.residual is None and outcome.note.startswith("the record has 900 steps, its first window is full after 100")


def test_controllers_that_one_record_cannot_tell_apart_are_equal_only_where_their_residuals_are_alike() -> None:
    names = ["integrator", "lqg-kf-lgs", "lqg-kf-multi"]
    plan = design(PRESETS["paper"]().replace({"run.duration": 1.0, "run.warm_up": 0.5}), names)
    record, outcomes = simulate(plan.scenario), []
    for name, size, at in zip(plan.laws, (1.0, 1.2, 8.0), (550, 750, 950), strict=True):
        # One sample is all of a residual, which is then known badly.
        residual = np.full((record.n_steps, record.n_modes), 1e-3)
        residual[at] = size
        outcomes.append(Outcome(name, (True, True), residual))
    found = loop_verdict(ClosedLoop(plan, record, tuple(outcomes)), "tip")
    assert found is not None and found.ties == ("lqg-kf-lgs",)
    loop = ClosedLoop(plan, record, tuple(outcomes[-1:]))
    for source in (TRUE, IDENTIFIED, GIVEN):
        named = loop_verdict(loop, "tip", source=source)
        assert named is not None and f"With {'known' if source == TRUE else source} peak frequencies: " in named.sentences()[0]
