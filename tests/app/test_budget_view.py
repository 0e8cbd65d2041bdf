"""The error budget on the first page: computed when it is opened, of what is shown."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from wfsobs.app.causes import Causes
from wfsobs.app.display import Display
from wfsobs.app.jobs import CANCELLED, DONE, FAILED, RUNNING
from wfsobs.app.sources import LoadedRecord
from wfsobs.app.store import Store
from wfsobs.app.views.budget import BudgetView, bar_data
from wfsobs.app.views.verdict import VerdictLine
from wfsobs.evaluation.budget import TERMS, Budget
from wfsobs.evaluation.scores import COMMON_BOUNDS
from wfsobs.simulation.loop import simulate


def end(bars: Any, observer: str) -> float:
    """How long a bar is, negative pieces taken off."""
    data = bars.source.data
    of = [i for i, name in enumerate(data["observer"]) if name.startswith(observer)]
    return sum(data["right"][i] - data["left"][i] for i in of)


def test_bars_are_as_long_as_the_scores_in_every_mode_and_unit(make_store: Any, loop: Any) -> None:
    store: Store = make_store()
    display = Display()
    view = BudgetView(store, display)
    store.start()
    loop.finish(store)
    assert view.task.state != RUNNING and not view.bars  # nothing before it is asked for
    view.open.value = True
    for mode, unit, scale in (("tip", "nm", 1e3), ("tilt", "nm", 1e3), ("tilt", "um", 1.0)):
        display.param.update(mode=mode, unit=unit)
        loop.until(lambda: view.task.state == DONE)
        scores = {(s.observer, s.target): s.rms for s in store.run.result.result.scores if s.mode == mode}
        for target in ("turbulence", "vibration"):
            # Rounding: the terms of a linear observer are exact.
            assert end(view.bars[target], "LGS KF") == pytest.approx((scores["kf-lgs", target] * scale) ** 2, rel=1e-6)
            for bound, mark in view.bars[target].bounds.items():
                assert mark.visible and mark.location == pytest.approx((scores[bound, target] * scale) ** 2, rel=1e-12)
            assert set(view.bars[target].bounds) == set(COMMON_BOUNDS)
            assert mode in view.bars[target].figure.xaxis.axis_label
        assert "Online GPR" in view.learners.line.object and "LGS KF" not in view.learners.line.object
    view.open.value = False
    assert not view.room.visible and view.task.state == DONE


def test_a_new_run_has_a_new_budget_and_a_loaded_record_none(make_store: Any, loop: Any) -> None:
    store: Store = make_store()
    view = BudgetView(store, Display())
    view.open.value = True
    store.start()
    loop.until(lambda: view.task.state == DONE)
    before = end(view.bars["turbulence"], "LGS KF")
    store.change("turbulence.wind_speed", 30.0)
    loop.until(lambda: store.run.state == DONE and view.task.state == DONE and end(view.bars["turbulence"], "LGS KF") != before)
    store.run_on(LoadedRecord(simulate(store.scenario), "mine", "key"), store.scenario)
    loop.until(lambda: view.task.state == FAILED)
    assert "Only for simulations" in view.line.object


def test_learners_have_bars_by_simulation_which_can_be_stopped_and_gone_on_with(make_store: Any, loop: Any) -> None:
    store: Store = make_store()
    view = BudgetView(store, Display())
    learners = view.learners
    store.start()
    loop.finish(store)
    view.open.value = True
    loop.until(lambda: view.task.state == DONE)
    assert learners.start.visible and not learners.stop.visible
    assert "Nonlinear observers need a simulation" in learners.line.object
    learners.simulate()
    loop.until(lambda: bool(learners.by_observer))
    learners.stop.clicks += 1
    assert learners.task.state == CANCELLED and learners.start.visible
    some = dict(learners.by_observer)
    learners.simulate()
    loop.until(lambda: learners.task.state == DONE)
    assert not learners.start.visible and all(learners.by_observer[name] is found for name, found in some.items())
    scores = {(s.observer, s.target): s.rms for s in store.run.result.result.scores if s.mode == "tip"}
    # Shapley's shares add up to the estimate exactly, those of one that learns as well
    expected = (scores["gpr-offline", "vibration"] * 1e3) ** 2
    assert end(view.bars["vibration"], "Offline GPR") == pytest.approx(expected, rel=1e-6)
    view.open.value = False
    view.open.value = True
    loop.until(lambda: view.task.state == DONE)
    assert end(view.bars["vibration"], "Offline GPR") > 0.0, "they are not simulated again"
    store.change("turbulence.wind_speed", 30.0)
    loop.until(lambda: store.run.state == DONE and view.task.state == DONE and learners.start.visible)
    assert not learners.by_observer and end(view.bars["vibration"], "Offline GPR") == 0.0


def test_negative_terms_lie_left_of_zero() -> None:
    terms = dict(zip(TERMS, (4.0, 3.0, -1.0, -0.5, 2.0), strict=True))
    data = bar_data([Budget("kf-lgs", "vibration", "tip", 7.5, terms)], 1.0, "um")
    np.testing.assert_allclose(data["left"], [0.0, 4.0, 0.0, -1.0, 7.0])
    np.testing.assert_allclose(data["right"], [4.0, 7.0, -1.0, -1.5, 9.0])
    assert data["share"] == ["53 %", "40 %", "-13 %", "-7 %", "27 %"]


def test_the_verdict_says_the_largest_term_of_those_that_do_harm_when_it_is_known(make_store: Any, loop: Any) -> None:
    store, display = make_store(), Display()
    causes = Causes(store, display)
    line = VerdictLine("vibration", store.run, display, None, causes)
    store.start()
    for mode in ("tip", "tilt"):
        display.mode = mode
        loop.until(lambda: store.run.state == DONE and bool(causes.budgets))
        terms = {b.observer: b.terms for b in causes.budgets if (b.target, b.mode) == ("vibration", mode)}
        assert max(terms["kf-lgs"], key=terms["kf-lgs"].__getitem__) == "lines"
        assert "error comes from unmodelled peaks." in line.html()
        assert line.pane.object == line.html()
    store.run_on(LoadedRecord(simulate(store.scenario), "mine", "key"), store.scenario)
    assert not causes.budgets
    loop.finish(store)
    assert not causes.budgets and "error is lines" not in line.html()
