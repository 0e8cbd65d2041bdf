"""The settings of a session and the one run that follows them."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from wfsobs import pipeline
from wfsobs.app.jobs import CANCELLED, DONE, FAILED, RUNNING, Tell
from wfsobs.app.store import Store
from wfsobs.app.work import RunResults
from wfsobs.progress import Cancelled, Watch
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.values import SettingError


def answer(scenario: Scenario) -> RunResults:
    """An empty result of a scenario."""
    record = Record(y_lgs=np.zeros((8, 2)), u=np.zeros((8, 2)), dt=1e-3)
    return RunResults(pipeline.Result(scenario, record, (), ()))


def instant(scenario: Scenario, *_: object) -> RunResults:
    return answer(scenario)


class Gated:
    """Work that waits to be let go, one gate per run, by wind speed; it does not listen to `cancelled`."""

    def __init__(self) -> None:
        self.gates: dict[float, threading.Event] = {}
        self.told_to_stop: dict[float, bool] = {}
        self.telling: dict[float, Tell] = {}
        self.entered: dict[float, threading.Event] = {}
        self.left: dict[float, threading.Event] = {}

    def expect(self, *speeds: float) -> None:
        for speed in speeds:
            self.gates[speed], self.entered[speed], self.left[speed] = (threading.Event() for _ in range(3))

    def __call__(self, scenario: Scenario, watch: Watch, tell: Tell, _loaded: object) -> RunResults:
        speed = scenario.turbulence.wind_speed
        self.telling[speed] = tell
        self.entered[speed].set()
        assert self.gates[speed].wait(20)
        self.told_to_stop[speed] = watch.is_cancelled()
        try:
            return answer(scenario)
        finally:
            self.left[speed].set()


def test_a_run_gives_what_the_core_gives(make_store: Any, loop: Any, short: Scenario) -> None:
    store = make_store()
    store.start()
    assert store.run.state == RUNNING
    loop.finish(store)
    assert store.run.state == DONE and store.run.progress == 1.0
    expected = pipeline.run(short)
    got = {(s.observer, s.target, s.mode): s.rms for s in store.run.result.result.scores}
    assert got == {(s.observer, s.target, s.mode): s.rms for s in expected.scores}


@pytest.mark.usefixtures("quick")
def test_a_change_runs_again(make_store: Any, loop: Any, short: Scenario) -> None:
    store = make_store()
    store.start()
    loop.finish(store)
    first = store.run.result
    assert store.change("turbulence.wind_speed", 25)
    assert store.stale and store.run.state == RUNNING
    loop.finish(store)
    assert not store.stale
    assert store.run.result.scenario.turbulence.wind_speed == 25.0
    assert store.run.result.result.scores != first.result.scores
    assert short.turbulence.wind_speed == 15.0, "a scenario that was handed over is a snapshot"


def test_the_same_value_again_does_not_run(make_store: Any) -> None:
    store = make_store(instant)
    assert store.change("turbulence.wind_speed", store.scenario.turbulence.wind_speed)
    assert store.run.state == "idle"


def test_a_bad_value_leaves_the_last_result_standing(make_store: Any, loop: Any) -> None:
    store = make_store(instant)
    store.start()
    loop.finish(store)
    scenario, shown = store.scenario, store.run.result
    assert not store.change("turbulence.wind_speed", 200)
    assert store.errors == {"turbulence.wind_speed": "turbulence.wind_speed = 200: takes a number from 0.1 to 100 m/s"}
    assert store.scenario is scenario and store.run.result is shown
    assert store.run.state == DONE and not store.stale


def test_a_bad_text_is_refused_by_the_setting_itself(make_store: Any) -> None:
    store = make_store(instant)
    assert not store.change("run.seed", "many")
    assert "run.seed" in store.errors["run.seed"] and "many" in store.errors["run.seed"]


def test_a_good_value_clears_the_error(make_store: Any, loop: Any) -> None:
    store = make_store(instant)
    store.change("turbulence.wind_speed", 200)
    assert store.change("turbulence.wind_speed", 20)
    assert store.errors == {} and store.run.state == RUNNING
    loop.finish(store)


def test_going_back_to_the_value_that_stands_clears_the_error(make_store: Any) -> None:
    store = make_store(instant)
    store.change("turbulence.wind_speed", 200)
    assert store.change("turbulence.wind_speed", store.scenario.turbulence.wind_speed)
    assert store.errors == {} and store.run.state == "idle"


def test_settings_that_do_not_go_together_are_refused(make_store: Any) -> None:
    store = make_store(instant)
    assert not store.change("run.warm_up", 5)
    assert "run.duration" in store.errors["run.warm_up"]


def test_settings_that_only_go_together_can_be_given_one_by_one(make_store: Any) -> None:
    store = make_store(instant)
    assert not store.change("run.duration", 0.4), "shorter than the warm-up"
    assert store.change("run.warm_up", 0.1)
    assert (store.scenario.run.duration, store.scenario.run.warm_up) == (0.4, 0.1)
    assert store.errors == {}


def test_an_error_of_one_setting_does_not_hold_up_another(make_store: Any) -> None:
    store = make_store(instant)
    store.change("turbulence.wind_speed", 200)
    assert store.change("loop.gain", 0.2)
    assert store.scenario.loop.gain == 0.2
    assert list(store.errors) == ["turbulence.wind_speed"]


def test_replacing_the_peaks_forgets_what_was_refused_of_one(make_store: Any) -> None:
    store = make_store(instant)
    assert not store.change("vibration.peaks.0.frequency", -1)
    assert store.change("vibration.peaks", [])
    assert store.errors == {} and store.scenario.vibration.peaks == []


def test_a_superseded_run_never_lands(make_store: Any, loop: Any) -> None:
    work = Gated()
    work.expect(15.0, 20.0)
    store = make_store(work)
    store.start()
    assert work.entered[15.0].wait(20)
    store.change("turbulence.wind_speed", 20)
    assert work.entered[20.0].wait(20)
    work.gates[20.0].set()
    loop.finish(store)
    assert store.run.result.scenario.turbulence.wind_speed == 20.0

    work.telling[15.0](progress=0.5, result=answer(PRESETS["paper"]()))
    work.gates[15.0].set()
    assert work.left[15.0].wait(20)
    assert store.session.service.close(20)
    assert loop.queue.empty(), "nothing of it is even posted"
    assert store.run.result.scenario.turbulence.wind_speed == 20.0 and store.run.progress == 1.0
    assert work.told_to_stop == {20.0: False, 15.0: True}


def test_what_was_posted_before_a_run_was_superseded_does_not_land_after(make_store: Any, loop: Any) -> None:
    work = Gated()
    work.expect(15.0, 20.0)
    store = make_store(work)
    store.start()
    assert work.entered[15.0].wait(20)
    work.telling[15.0](progress=0.5, result=answer(store.scenario))
    store.change("turbulence.wind_speed", 20)
    loop.land()
    assert store.run.result is None and store.run.progress == 0.0
    for gate in work.gates.values():
        gate.set()
    loop.finish(store)
    assert store.run.result.scenario.turbulence.wind_speed == 20.0


@pytest.mark.usefixtures("quick")
def test_a_run_is_done_once_its_result_has_landed(make_store: Any, loop: Any) -> None:
    """So that figures are drawn before what follows a whole run; a change in between supersedes it as any other."""
    store, seen = make_store(), []
    store.run.param.watch(lambda *events: seen.append({e.name: e.new for e in events}), ["state", "result"])
    store.start()
    loop.finish(store)
    assert seen[-1] == {"state": "done"} and "result" in seen[-2] and "state" not in seen[-2]


@pytest.mark.usefixtures("quick")
def test_many_changes_in_a_row_show_only_the_last(make_store: Any, loop: Any) -> None:
    store = make_store()
    speeds: list[float] = []
    store.run.param.watch(lambda event: speeds.append(event.new.scenario.turbulence.wind_speed), "result")
    for speed in (10, 12, 14, 16, 18):
        store.change("turbulence.wind_speed", speed)
    loop.finish(store)
    assert set(speeds) == {18.0} and not store.stale


def test_cancel_stops_and_keeps_what_was_shown(make_store: Any, loop: Any) -> None:
    work = Gated()
    work.expect(15.0)
    store = make_store(work)
    store.start()
    assert work.entered[15.0].wait(20)
    part = answer(store.scenario)
    work.telling[15.0](progress=0.3, result=part)
    loop.until(lambda: store.run.result is part)
    store.run.cancel()
    assert store.run.state == CANCELLED and store.run.progress == 0.3
    work.gates[15.0].set()
    assert work.left[15.0].wait(20)
    assert store.session.service.close(20)
    assert work.told_to_stop == {15.0: True}
    assert loop.queue.empty() and store.run.state == CANCELLED and store.run.result is part


def test_cancelling_before_anything_has_landed_leaves_the_results_stale(make_store: Any, loop: Any) -> None:
    work = Gated()
    work.expect(15.0, 20.0)
    store = make_store(work)
    work.gates[15.0].set()
    store.start()
    loop.finish(store)
    store.change("turbulence.wind_speed", 20)
    store.run.cancel()
    assert store.stale and store.run.result.scenario.turbulence.wind_speed == 15.0
    work.gates[20.0].set()


def test_cancelled_work_that_reports_it_itself(make_store: Any, loop: Any) -> None:
    def stops(*_: object) -> RunResults:
        raise Cancelled

    store = make_store(stops)
    store.start()
    loop.finish(store)
    assert store.run.state == CANCELLED


def test_a_failing_run_says_why_and_leaves_the_last_result_standing(make_store: Any, loop: Any, caplog: Any) -> None:
    def fails(scenario: Scenario, *_: object) -> RunResults:
        if scenario.loop.gain == 0.1:
            raise RuntimeError("no such luck")
        if scenario.loop.gain == 0.2:
            raise SettingError("loop.gain = 0.2: not today")
        return answer(scenario)

    store = make_store(fails)
    store.start()
    loop.finish(store)
    shown = store.run.result
    store.change("loop.gain", 0.1)
    loop.finish(store)
    assert (store.run.state, store.run.message) == (FAILED, "RuntimeError: no such luck")
    assert "no such luck" in caplog.text, "the traceback is in the log"
    store.change("loop.gain", 0.2)
    loop.finish(store)
    assert store.run.message == "loop.gain = 0.2: not today"
    assert store.run.result is shown and store.stale
    store.change("loop.gain", 0.3)
    loop.finish(store)
    assert store.run.state == DONE and store.run.message == "" and not store.stale


def test_a_preset_replaces_every_setting(make_store: Any, loop: Any) -> None:
    store = make_store(instant)
    store.change("turbulence.wind_speed", 200)
    store.choose("ut4")
    assert store.scenario == PRESETS["ut4"]() and store.preset == "ut4"
    assert store.errors == {} and store.changed_paths() == []
    store.change("loop.gain", 0.1)
    assert store.changed_paths() == ["loop.gain"]
    loop.finish(store)


def test_sessions_do_not_see_each_other(make_store: Any, loop: Any) -> None:
    one, other = make_store(instant), make_store(instant)
    one.change("turbulence.wind_speed", 30)
    one.change("vibration.peaks", [])
    one.change("loop.gain", 9)
    assert other.scenario.turbulence.wind_speed == 15.0 and other.scenario.vibration.peaks
    assert other.errors == {} and other.run.state == "idle"


def test_a_closed_session_hears_nothing(make_store: Any, loop: Any) -> None:
    work = Gated()
    work.expect(15.0)
    store: Store = make_store(work)
    store.start()
    assert work.entered[15.0].wait(20)
    store.session.leave()
    work.gates[15.0].set()
    assert work.left[15.0].wait(20)
    assert loop.queue.empty()
