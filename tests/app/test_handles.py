"""Handles on the spectra: from messages of the browser to settings, and from settings to what is shown."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.pages.pages import LOOP
from wfsobs.app.views import spectrum_editor
from wfsobs.app.views.gain_editor import GainEditor
from wfsobs.app.views.spectrum_editor import (
    DRAGGED,
    PEAK,
    Frames,
    SpectrumEditor,
    changes_of,
    handles_of,
    highest_frequency,
    with_new_peak,
    without_peak,
)
from wfsobs.closed_loop.design import design
from wfsobs.control.laws import highest_stable_gain
from wfsobs.evaluation.exact_errors import Theory
from wfsobs.priors_from.controllers import plant_of
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.values import SettingError
from wfsobs.simulation.disturbance import turbulence_process

pytestmark = pytest.mark.usefixtures("quick")


def moved(scenario: Scenario, target: str, name: str, mode: int = 0, **by: float) -> Scenario:
    handle = next(h for h in handles_of(scenario, target, mode) if h.id == name)
    return scenario.replace(changes_of(scenario, target, mode, handle.at(**by)))


class TestSettings:
    @pytest.mark.parametrize("preset", sorted(PRESETS))
    @pytest.mark.parametrize("target", ["turbulence", "vibration"])
    def test_each_handle_goes_where_it_is_moved(self, preset: str, target: str) -> None:
        scenario = PRESETS[preset]()
        for handle in handles_of(scenario, target, 0):
            to = handle.at(1.1 * handle.frequency, 1.5, 1.2)
            after = scenario.replace(changes_of(scenario, target, 0, to))
            (found,) = [h for h in handles_of(after, target, 0) if h.id == handle.id]
            # Settings have four digits, so that half of the last is at most 5e-4; a corner's wind is another such number.
            assert found.frequency == pytest.approx(1.1 * handle.frequency, rel=1e-3)
            assert (found.rms, found.damping) == (pytest.approx(to.rms), pytest.approx(to.damping))
            written = [v for v in (found.rms, found.damping, after.turbulence.wind_speed) if v is not None]
            assert all(v == float(f"{v:.4g}") for v in written), "as a hand would set them"
            others = [h for h in handles_of(after, target, 0) if h.id != handle.id]
            assert others == [h for h in handles_of(scenario, target, 0) if h.id != handle.id], "the others stay"

    def test_a_peak_changes_in_the_mode_shown_alone(self) -> None:
        scenario = moved(PRESETS["paper"](), "vibration", "peak-14", mode=1, frequency=50.0, strength=2.0)
        assert scenario.vibration.peaks[14].rms == [0.0079, pytest.approx(2 * 0.0027)]
        assert scenario.vibration.peaks[14].frequency == 50.0

    def test_a_peak_that_is_not_there_in_a_mode_can_grow(self) -> None:
        assert moved(PRESETS["paper"](), "vibration", "peak-3", strength=2.0).vibration.peaks[3].rms[0] == pytest.approx(2e-4)
        assert moved(PRESETS["paper"](), "vibration", "peak-3", frequency=12.5).vibration.peaks[3].rms[0] == 0.0

    def test_the_corner_goes_with_the_wind(self) -> None:
        scenario = PRESETS["ut4"]()
        before = turbulence_process(scenario, 0, scenario.dt).omega / (2.0 * np.pi)
        after = moved(scenario, "turbulence", "corner-0", frequency=2.0 * before)
        assert after.turbulence.wind_speed == pytest.approx(2.0 * scenario.turbulence.wind_speed)

    def test_matched_models_and_measured_lines_have_no_handles(self) -> None:
        scenario = PRESETS["ut4"]().replace({"kalman.peak": "matched"})
        assert {h.kind for h in handles_of(scenario, "vibration", 0)} == {"band"}

    def test_a_new_peak_is_one_of_the_mode(self) -> None:
        scenario = PRESETS["paper"]()
        after = scenario.replace(with_new_peak(scenario, 0, 30.0))
        peak = after.vibration.peaks[-1]
        assert peak.frequency == 30.0 and peak.rms[0] > 0.0 and peak.rms[1] == 0.0
        assert after.replace(without_peak(after, 15)) == scenario
        with pytest.raises(SettingError, match="measured"):
            with_new_peak(PRESETS["ut4"](), 0, 30.0)

    def test_there_is_no_peak_above_the_cut_off(self) -> None:
        scenario = PRESETS["paper"]().replace({"vibration.cutoff": 60.0})
        assert highest_frequency(scenario, PEAK) == 60.0
        with pytest.raises(SettingError, match="60 Hz"):
            with_new_peak(scenario, 0, 61.0)
        free = scenario.replace({"vibration.source": "ar2"})  # no cut-off: up to Nyquist
        assert highest_frequency(free, PEAK) == pytest.approx(500.0)


@pytest.fixture
def editor(dashboard: Dashboard, loop: Any) -> SpectrumEditor:
    assert dashboard.explore.editors == {}, "made when first wanted"
    dashboard.display.editing = True
    editor = dashboard.explore.editors["vibration"]
    loop.until(lambda: bool(editor.layer.frame["numbers"]))
    return editor


def numbers(editor: SpectrumEditor) -> dict[str, str]:
    return {it["name"]: it["value"] for it in editor.layer.frame["numbers"]}


def drag(number: int, action: str = "drag", **to: float) -> dict[str, Any]:
    return {"action": action, "id": "peak-14", "number": number, "frequency": 47.44, "strength": 1.0, "damping": 1.0, **to}


class TestMessages:
    def test_a_drag_moves_numbers_and_line_and_sets_nothing(self, editor: SpectrumEditor, loop: Any) -> None:
        store, before = editor.store, numbers(editor)
        scenario, line = store.scenario, editor.lines.source.data["ys"][0]
        editor.layer._handle_msg(drag(1, frequency=60.0, strength=3.0))
        loop.until(lambda: editor.layer.frame["answered"] == 1)
        assert store.scenario is scenario and not store.can_undo
        assert editor.theory.most == DRAGGED, "a coarse grid while it moves"
        assert before and numbers(editor) != before
        assert not np.array_equal(editor.lines.source.data["ys"][0], line)
        (handle,) = [h for h in editor.layer.frame["handles"] if h["id"] == "peak-14"]
        assert (handle["frequency"], handle["text"]) == (60.0, "60 Hz, 23.7 nm rms, damping 0.004")
        trial = scenario.replace({"vibration.peaks.14.frequency": 60.0, "vibration.peaks.14.rms": [3 * 0.0079, 0.0027]})
        expected = {p.observer: p for p in Theory().predict(trial, 0, "vibration")}
        three_digits = {name: pytest.approx(1e3 * expected[name].rms, rel=5e-3) for name in before}
        loop.until(lambda: {name: float(value) for name, value in numbers(editor).items()} == three_digits)

    def test_a_frame_has_those_for_which_there_is_time_and_the_next_one_begins_with_the_others(
        self, editor: SpectrumEditor, loop: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(spectrum_editor, "FRAME", -1.0)  # one observer each
        waiting: list[set[str]] = []

        def note(event: Any) -> None:
            waiting.append({it["name"] for it in event.new["numbers"] if it["waits"]})

        editor.layer.param.watch(note, "frame")
        editor.layer._handle_msg(drag(1, frequency=60.0))
        loop.until(lambda: bool(waiting) and not waiting[-1])
        trial = editor.store.scenario.replace({"vibration.peaks.14.frequency": 60.0})
        expected = {p.observer: p for p in Theory().predict(trial, 0, "vibration")}
        assert list(numbers(editor)) == [name for name in expected if name in numbers(editor)], "in their usual order"
        assert [len(names) for names in waiting] == list(range(len(numbers(editor)) - 1, -1, -1))
        for name, value in numbers(editor).items():
            assert float(value) == pytest.approx(1e3 * expected[name].rms, rel=1e-2), name  # three digits, on a coarse grid

    def test_letting_go_sets_and_runs_and_undo_takes_it_back(self, editor: SpectrumEditor, loop: Any) -> None:
        store, before = editor.store, numbers(editor)
        editor.layer._handle_msg(drag(1, "release", frequency=60.0))
        assert store.scenario.vibration.peaks[14].frequency == 60.0
        assert store.run.state == "running"
        loop.finish(store)
        assert store.run.result.scenario == store.scenario
        store.undo()
        loop.until(lambda: numbers(editor) == before)
        assert store.scenario.vibration.peaks[14].frequency == 47.44
        loop.finish(store)

    def test_giving_up_brings_it_back(self, editor: SpectrumEditor, loop: Any) -> None:
        before = numbers(editor)
        editor.layer._handle_msg(drag(1, frequency=60.0))
        editor.layer._handle_msg({"action": "cancel", "number": 2})
        loop.until(lambda: editor.layer.frame["answered"] == 2)
        assert numbers(editor) == before and editor.theory.most is None
        assert not editor.store.can_undo

    def test_what_cannot_be_is_refused_in_one_line(self, editor: SpectrumEditor, subtests: pytest.Subtests) -> None:
        wrongs: list[dict[str, Any]] = [
            {"frequency": -1.0},
            {"frequency": float("nan")},
            {"frequency": "x"},
            {"frequency": 1e9},
            {"strength": 1e12},
            {"id": "peak-99"},
            {"id": None},
        ]
        for number, wrong in enumerate(wrongs, start=1):
            with subtests.test(str(wrong)):
                scenario = editor.store.scenario
                editor.layer._handle_msg(drag(number, "release", **wrong))
                assert editor.store.scenario is scenario
                assert editor.layer.frame["answered"] == number
                assert editor.layer.frame["note"] and "\n" not in editor.layer.frame["note"]

    def test_messages_without_sense_are_none(self, editor: SpectrumEditor) -> None:
        frame = editor.layer.frame
        for message in ("drag", 3, None, [1]):
            editor.layer._handle_msg(message)
        assert editor.layer.frame is frame

    def test_what_has_no_prediction_says_why(self, editor: SpectrumEditor, loop: Any) -> None:
        event = {"kind": "peak", "start": 1.0, "peak": 2, "frequency_shift": 3.0}
        editor.store.replace({"events": [event]})
        loop.until(lambda: bool(editor.layer.frame["note"]))
        assert "events" in editor.layer.frame["note"]
        assert editor.layer.frame["numbers"] == []
        assert len(editor.layer.frame["handles"]) == 22, "they can be moved all the same"
        loop.finish(editor.store)

    def test_another_mode_or_none(self, editor: SpectrumEditor, loop: Any) -> None:
        editor.display.mode = "tilt"
        loop.until(lambda: editor.layer.frame["handles"][14]["text"].startswith("47.44 Hz, 2.70 nm"))
        editor.display.editing = False
        assert not editor.layer.visible
        assert editor.lines.source.data["ys"] == []


def test_the_newest_wish_of_each_figure_wins(dashboard: Dashboard, loop: Any) -> None:
    frames, worked, landed = Frames(dashboard.store.session), [], []

    def ask(name: str, i: int) -> None:
        frames.ask(name, lambda: worked.append(i) or i, lambda result, why: landed.append((name, result, why)))

    for i in range(1, 11):
        ask("a", i)
    ask("b", 20)
    loop.until(lambda: len(landed) == 3)
    assert landed == [("a", 1, ""), ("a", 10, ""), ("b", 20, "")], "those between are dropped"
    assert worked == [1, 10, 20], "one at a time"


def test_a_wish_that_fails_says_why(dashboard: Dashboard, loop: Any) -> None:
    def fail() -> None:
        raise ValueError("not today")

    landed: list[Any] = []
    Frames(dashboard.store.session).ask("a", fail, lambda *told: landed.append(told))
    loop.until(lambda: bool(landed))
    assert landed == [(None, "not today")]


class TestGain:
    @pytest.fixture
    def gain(self, dashboard: Dashboard, loop: Any) -> GainEditor:
        dashboard.pages.current = LOOP
        page = dashboard.pages.by_name[LOOP]
        loop.until(lambda: page.results is not None and page.results.complete)
        assert page.editor is None, "made when first wanted"
        dashboard.display.editing = True
        loop.until(lambda: all(it.layer.frame.get("handles") for it in page.editor.handles))
        return page.editor

    def test_a_drag_says_what_the_loop_would_do(self, gain: GainEditor, loop: Any) -> None:
        store = gain.store
        (handle,) = gain.handles[0].layer.frame["handles"]
        gain.handles[0].layer._handle_msg({"action": "drag", "id": "gain-0", "number": 1, "frequency": 0.5 * handle["frequency"]})
        loop.until(lambda: gain.handles[0].layer.frame["answered"] == 1)
        (after,) = gain.handles[0].layer.frame["handles"]
        # between two points of the curve the level is taken as linear
        assert after["frequency"] == pytest.approx(0.5 * handle["frequency"], rel=5e-3)
        values = {it["name"]: it["value"] for it in gain.handles[0].layer.frame["numbers"]}
        scenario = store.scenario.replace({"control.integrator": "manual", "control.gain": float(values["gain"])})
        expected = design(scenario, ["integrator"]).laws["integrator"][0].predicted_rms
        assert expected is not None
        assert float(values["integrator"]) == pytest.approx(1e3 * expected, rel=0.01)  # three digits, of the gain too
        assert store.scenario.control.integrator == "optimised" and not store.can_undo
        assert "other controllers follow" in gain.handles[0].layer.frame["hint"], "what a drag does not show"

    def test_what_comes_in_leaves_a_gain_on_its_way_where_it_is(self, gain: GainEditor, loop: Any) -> None:
        layer = gain.handles[0].layer
        (before,) = layer.frame["handles"]
        layer._handle_msg({"action": "drag", "id": "gain-0", "number": 1, "frequency": 0.5 * before["frequency"]})
        loop.until(lambda: layer.frame["answered"] == 1)
        held = layer.frame
        gain.follow()  # as a result does
        loop.until(lambda: layer.frame is not held)
        assert layer.frame["numbers"] == held["numbers"] and layer.frame["handles"] == held["handles"]
        gain._land([1, 1], None, "not stable")
        assert layer.frame["handles"] == held["handles"], "a handle that went would take the focus with it"
        layer._handle_msg({"action": "cancel", "id": "gain-0", "number": 2})
        loop.until(lambda: layer.frame["answered"] == 2)
        assert layer.frame["handles"] == [before]

    def test_letting_go_sets_the_gain(self, gain: GainEditor, loop: Any) -> None:
        gain.handles[0].layer._handle_msg({"action": "release", "id": "gain-0", "number": 1, "frequency": 40.0})
        control = gain.store.scenario.control
        assert control.integrator == "manual"
        mirror, dt = plant_of(gain.store.scenario).mirror, gain.store.scenario.dt
        at = np.array([2.0 * np.pi * 40.0 * dt])
        L = control.gain * mirror.response(at) / (1.0 - control.leak * np.exp(-1j * at))
        assert abs(1.0 / (1.0 + L[0])) == pytest.approx(1.0, abs=1e-3)  # four decimals of the gain
        loop.finish(gain.store)

    def test_no_handle_makes_the_loop_unstable(self, gain: GainEditor, loop: Any) -> None:
        for i, frequency in enumerate((120.0, 300.0, 499.0), 1):
            gain.handles[0].layer._handle_msg({"action": "drag", "id": "gain-0", "number": i, "frequency": frequency})
            loop.until(lambda i=i: gain.handles[0].layer.frame["answered"] == i)
            assert gain.handles[0].layer.frame["note"] == "" and gain.handles[0].layer.frame["numbers"]
        gain.handles[0].layer._handle_msg({"action": "drag", "id": "gain-0", "number": 4, "frequency": -1.0})
        loop.until(lambda: gain.handles[0].layer.frame["answered"] == 4)
        assert "positive" in gain.handles[0].layer.frame["note"]

    def test_on_the_nyquist_figure_as_on_the_rejection(self, gain: GainEditor, loop: Any) -> None:
        rejection, nyquist = (it.layer for it in gain.handles)
        (handle,) = nyquist.frame["handles"]
        shown = margin_of(gain)
        assert handle["frequency"] == pytest.approx(-1.0 / shown, rel=1e-3) and handle["y"] == 0.0
        nyquist._handle_msg({"action": "drag", "id": "gain-0", "number": 1, "frequency": -0.25})
        loop.until(lambda: nyquist.frame["answered"] == 1)
        # the margin is found on the law itself, the gain of the place in proportion to the highest one, to four decimals
        assert nyquist.frame["handles"][0]["frequency"] == pytest.approx(-0.25, rel=1e-3)
        values = {it["name"]: it["value"] for it in nyquist.frame["numbers"]}
        assert float(values["gain-margin"]) == pytest.approx(20.0 * np.log10(4.0), abs=0.06)  # one decimal
        assert rejection.frame["numbers"] == nyquist.frame["numbers"], "one gain"
        (x,), (y,) = (gain.handles[1].lines.source.data[name] for name in ("xs", "ys"))
        near = np.flatnonzero((y[:-1] < 0.0) & (y[1:] >= 0.0) & (x[1:] < 0.0))
        share = -y[near] / (y[near + 1] - y[near])
        assert np.min(np.abs(x[near] + share * (x[near + 1] - x[near]) + 0.25)) < 2e-3, "the line goes through the handle"
        nyquist._handle_msg({"action": "release", "id": "gain-0", "number": 2, "frequency": -3.0})
        control = gain.store.scenario.control
        mirror = plant_of(gain.store.scenario).mirror
        assert control.gain == pytest.approx(0.98 * highest_stable_gain(mirror, control.leak), abs=1e-4), "beyond -1: 2 % below"
        loop.finish(gain.store)
        nyquist._handle_msg({"action": "drag", "id": "gain-0", "number": 3, "frequency": None})
        loop.until(lambda: nyquist.frame["answered"] == 3)
        assert "numbers only" in nyquist.frame["note"]


def margin_of(gain: GainEditor) -> float:
    """The gain margin of the closed loop shown."""
    shown = gain.results()
    assert shown is not None
    margins = shown.result.design.laws["integrator"][0].margins
    assert margins is not None and margins.gain is not None
    return margins.gain
