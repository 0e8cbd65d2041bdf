"""Undo and redo, and runs that wait to be asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from wfsobs.app.controls.panel import Controls
from wfsobs.app.jobs import DONE
from wfsobs.app.store import STEPS_BACK, Store
from wfsobs.app.work import RunResults
from wfsobs.cost import run_seconds
from wfsobs.evaluation.result import Result
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS

WIND = "turbulence.wind_speed"
LONG = {"run.duration": 300}


def nothing(scenario: Scenario, *_: object) -> RunResults:
    """An empty result, at once."""
    return RunResults(Result(scenario, Record(y_lgs=np.zeros((8, 2)), u=np.zeros((8, 2)), dt=1e-3), (), ()))


@pytest.fixture
def store(make_store: Any) -> Store:
    return make_store(nothing)


def wind(store: Store) -> float:
    return store.value(WIND)


def test_undo_and_redo(store: Store, loop: Any) -> None:
    first = store.scenario
    assert not store.can_undo and not store.can_redo
    store.change(WIND, 20)
    store.change("loop.gain", 0.2)
    assert store.can_undo and not store.can_redo
    store.undo()
    assert (wind(store), store.scenario.loop.gain) == (20.0, 0.3) and store.can_redo
    store.undo()
    assert store.scenario == first and not store.can_undo
    store.undo()
    assert store.scenario == first, "nothing left to undo"
    store.redo()
    store.redo()
    store.redo()
    assert (wind(store), store.scenario.loop.gain) == (20.0, 0.2) and not store.can_redo
    loop.finish(store)
    assert store.run.result is not None and store.run.result.scenario == store.scenario, "what is undone or redone runs"


def test_a_change_after_undo_leaves_nothing_to_redo(store: Store) -> None:
    store.change(WIND, 20)
    store.undo()
    store.change(WIND, 30)
    assert not store.can_redo
    store.redo()
    assert wind(store) == 30.0
    store.undo()
    assert wind(store) == 15.0


def test_a_preset_is_one_step(store: Store) -> None:
    store.change(WIND, 20)
    before = store.scenario
    store.choose("ut4")
    store.undo()
    assert (store.scenario, store.preset) == (before, "paper")
    store.redo()
    assert (store.scenario, store.preset) == (PRESETS["ut4"](), "ut4")


def test_refused_and_repeated_values_are_no_steps(store: Store) -> None:
    store.change(WIND, 20)
    assert not store.change(WIND, 200)
    store.change("loop.gain", store.scenario.loop.gain)
    store.undo()
    assert wind(store) == 15.0 and store.errors == {}, "and undo clears what was refused"


def test_settings_refused_until_they_go_together_are_one_step(store: Store) -> None:
    assert not store.change("run.duration", 0.4)
    assert store.change("run.warm_up", 0.1)
    store.undo()
    assert (store.scenario.run.duration, store.scenario.run.warm_up) == (2.0, 0.5)
    assert not store.can_undo


def test_history_is_bounded(store: Store) -> None:
    for i in range(STEPS_BACK + 20):
        store.change("run.seed", 1000 + i)
    for _ in range(2 * STEPS_BACK):
        store.undo()
    assert store.scenario.run.seed == 1019 and not store.can_undo


def test_the_drawer_has_undo_and_redo(store: Store) -> None:
    controls = Controls(store)
    controls.view()
    assert controls.undo.disabled and controls.redo.disabled
    store.change(WIND, 20)
    assert not controls.undo.disabled
    controls.undo.clicks += 1
    assert wind(store) == 15.0 and controls.undo.disabled and not controls.redo.disabled
    controls.redo.clicks += 1
    assert wind(store) == 20.0


def test_a_long_run_waits_to_be_asked_for(store: Store, loop: Any) -> None:
    controls = Controls(store)
    controls.view()
    store.start()
    loop.finish(store)
    long = store.scenario.replace(LONG)
    assert run_seconds(long) > 5
    store.change("run.duration", 300)
    assert store.run.state == DONE and store.stale and store.waiting == pytest.approx(run_seconds(long))
    assert controls.status.text == f"About {store.waiting:.0f} s: press Run"
    store.start()
    assert store.waiting == 0.0 and "press Run" not in controls.status.text
    loop.finish(store)
    assert not store.stale


def test_going_back_to_a_short_run_starts_it(store: Store, loop: Any) -> None:
    store.change("run.duration", 300)
    assert store.waiting > 5 and store.run.state == "idle"
    store.undo()
    assert store.waiting == 0.0
    loop.finish(store)
    assert store.run.result is not None and not store.stale
