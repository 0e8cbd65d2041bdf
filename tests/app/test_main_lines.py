"""Which lines are shown before anything has been chosen, and how the choice is made."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import param
import pytest

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.display import Display
from wfsobs.app.jobs import DONE, RUNNING
from wfsobs.app.render import number
from wfsobs.app.style import look, observers_of
from wfsobs.app.views.errors import REFERENCES, MainLines, main_observers
from wfsobs.app.views.plots import GREY, MOST_COLOURED, ROOM_OF_NAME
from wfsobs.app.views.traces import first_window
from wfsobs.app.work import TRUTH
from wfsobs.evaluation.evidence import gather_evidence, rank_observers
from wfsobs.evaluation.result import NO_ESTIMATE, NOTHING, PEAKS, is_non_causal, prior_knowledge
from wfsobs.evaluation.scores import PREDICTION, Score
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.scenario import Scenario


@pytest.fixture
def scores(shared: Dashboard) -> tuple[Score, ...]:
    return shared.store.run.result.result.scores


def hidden(dashboard: Dashboard, target: str) -> list[str]:
    lines = dashboard.explore.traces.traces[target].lines
    assert dashboard.explore.strips[target].cards.hidden_lines == [
        name for name in observers_of(target) if not lines[name].visible
    ]
    return dashboard.explore.strips[target].cards.hidden_lines


def others_of(scores: tuple[Score, ...], target: str) -> list[str]:
    main = main_observers(scores, target, "tip")
    return [name for name in observers_of(target) if name not in main]


class Run(param.Parameterized):
    """What a run says of itself, and its seeds, which say nothing."""

    state = param.String(RUNNING)
    result = param.Parameter()
    evidence = param.Parameter()

    @property
    def run(self) -> Run:
        return self


def test_another_mode_has_its_own_lines(shared: Dashboard, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wfsobs.app.views.errors.main_observers", lambda _scores, _target, mode, *_: [{"tilt": "kf-multi"}[mode]])
    shared.display.mode = "tilt"
    assert shared.display.named_lines == {target: ["kf-multi"] for target in TARGETS}


class TestRule:
    @pytest.mark.parametrize("target", TARGETS)
    def test_the_references_and_the_best_by_prior_knowledge_that_are_causal(self, scores: tuple[Score, ...], target: str) -> None:
        errors = {
            s.observer: s.rms
            for s in scores
            if (s.target, s.mode) == (target, "tip") and s.observer in observers_of(target) and not is_non_causal(s.observer)
        }
        ranked = rank_observers(errors)
        best = {kind: name for name in reversed(ranked) if (kind := prior_knowledge(name)) in (NOTHING, PEAKS)}
        expected = {ranked[0], *best.values()} | {name for name in REFERENCES if target in OBSERVERS[name].targets}
        assert set(main_observers(scores, target, "tip")) == expected

    def test_who_looks_ahead_is_not_among_the_best(self, scores: tuple[Score, ...]) -> None:
        first = [replace(s, rms=0.0) if s.observer == "butterworth-ol" else s for s in scores]
        assert "butterworth-ol" not in main_observers(first, "vibration", "tip")

    def test_without_truth_those_that_predict_best(self, scores: tuple[Score, ...]) -> None:
        told = [replace(s, target=PREDICTION) for s in scores if s.target == "turbulence"]
        assert main_observers(told, "turbulence", "tip") == main_observers(scores, "turbulence", "tip")

    def test_all_where_nothing_can_be_compared(self) -> None:
        assert main_observers([], "vibration", "tip") == observers_of("vibration")

    def test_the_best_of_the_verdict_over_seeds_is_among_them(self, scores: tuple[Score, ...]) -> None:
        leader = others_of(scores, "turbulence")[0]
        better = [replace(s, rms=1e-3 * s.rms) if s.observer == leader else s for s in scores]
        assert leader in main_observers(scores, "turbulence", "tip", gather_evidence([scores, better, better]))

    def test_whatever_can_be_best_has_a_line(self) -> None:
        for target in TARGETS:
            assert {*observers_of(target)} == {o.id for o in OBSERVERS.values() if target in o.targets} - {NO_ESTIMATE}

    def test_what_runs_has_a_card(self, shared: Dashboard) -> None:
        shown = shared.store.run.result
        for target in TARGETS:
            ran = [name for name in observers_of(target) if shown.result.estimate(name, target) is not None]
            assert [card["name"] for card in shared.explore.strips[target].cards.items] == ["truth", *ran]
            assert not {"kf-coupled", "kf-asterism"} & {*ran}, "there is nothing to run them on"


class TestChoice:
    def test_the_others_are_hidden(self, shared: Dashboard, scores: tuple[Score, ...]) -> None:
        for target in TARGETS:
            assert set(hidden(shared, target)) == {*observers_of(target)} - {*main_observers(scores, target, "tip")}

    @pytest.mark.usefixtures("quick")
    def test_a_choice_stays_until_the_main_ones_are_asked_for(self, dashboard: Dashboard, loop: Any) -> None:
        at_first = hidden(dashboard, "vibration")
        dashboard.explore.strips["vibration"].cards.hidden_lines = ["truth", "kf-lgs"]
        dashboard.store.change("turbulence.wind_speed", 30)
        loop.finish(dashboard.store)
        dashboard.display.mode = "tilt"
        assert dashboard.display.hidden_lines["vibration"] == ["truth", "kf-lgs"]
        dashboard.display.mode = "tip"
        dashboard.explore.strips["vibration"].cards._handle_msg({"action": "main"})
        scores = dashboard.store.run.result.result.scores
        assert set(hidden(dashboard, "vibration")) == {*observers_of("vibration")} - {*main_observers(scores, "vibration", "tip")}
        assert at_first

    def test_a_link_that_says_it_of_one_target_leaves_the_main_ones_of_the_other(self, shared: Dashboard) -> None:
        run, display = Run(), Display()
        MainLines(display, run).choices["vibration"].choose(["truth"])  # type: ignore[arg-type]
        run.result = shared.store.run.result
        assert display.hidden_lines["vibration"] == ["truth"]
        assert display.hidden_lines["turbulence"] == others_of(run.result.result.scores, "turbulence")

    def test_the_first_choice_of_a_run_gives_way_to_that_of_all_results(self, shared: Dashboard) -> None:
        run, display = Run(), Display()
        lines = MainLines(display, run)  # type: ignore[arg-type]
        whole = shared.store.run.result
        few = tuple(s for s in whole.result.scores if s.observer in ("kf-lgs", "kf-ngs", "multirate"))
        run.result = replace(whole, result=replace(whole.result, scores=few))
        assert display.hidden_lines["turbulence"] == others_of(few, "turbulence") != others_of(whole.result.scores, "turbulence")
        run.result = whole
        run.state = DONE
        assert not any(choice.is_chosen for choice in lines.choices.values())
        for target in TARGETS:
            assert display.hidden_lines[target] == others_of(whole.result.scores, target)

    def test_a_click_turns_its_line_alone(self, shared: Dashboard) -> None:
        """The browser says what was clicked; a double click is two clicks, which undo each other, and the wish for one alone."""
        cards = shared.explore.strips["vibration"].cards
        told: list[list[str]] = []
        cards.param.watch(lambda event: told.append(event.new), "hidden_lines")
        at_first = cards.hidden_lines
        shown = [card["name"] for card in cards.items if card["name"] not in at_first]
        for _ in range(2):
            cards._handle_msg({"action": "toggle", "name": "kf-lgs"})
        assert told == [[*at_first, "kf-lgs"], at_first]
        cards._handle_msg({"action": "solo", "name": "kf-lgs"})
        lines = shared.explore.traces.traces["vibration"].lines
        assert shared.display.hidden_lines["vibration"] == told[-1]
        assert [name for name, line in lines.items() if line.visible] == ["kf-lgs"]
        assert {card["name"] for card in cards.items} - {*told[-1]} == {"kf-lgs"}
        assert not re.findall(f'folded"[^>]*data-name="(?:{"|".join(shown)})"', cards.html), "a click moves no row"
        cards._handle_msg({"action": "solo", "name": "kf-lgs"})
        assert told[-1] == at_first
        for wrong in ("main", {"action": "toggle", "name": ["truth"]}, {"action": "solo", "name": "none"}, {"action": []}, None):
            cards._handle_msg(wrong)
        assert len(told) == 4
        cards._handle_msg({"action": "lines"})
        assert told[-1] == []

    def test_the_axis_fits_the_lines_that_are_shown(self, shared: Dashboard) -> None:
        view = shared.explore.traces.traces["vibration"]
        shared.explore.strips["vibration"].cards.hidden_lines = [
            n for n in ("truth", *observers_of("vibration")) if n != "kf-multi"
        ]
        counted = np.asarray(view.source.data["kf-multi"])[np.asarray(view.source.data["x"]) >= 0.5]
        low, high = counted.min(), counted.max()
        # 5 % of its height are left on either side of a line
        assert view.figure.y_range.end == pytest.approx(high + 0.05 * (high - low), rel=1e-4)
        spectrum = shared.explore.spectra.spectra["vibration"]
        density = spectrum.sources["kf-multi"].data["y"]
        assert spectrum.figure.y_range.end == pytest.approx(3.0 * density.max()), "half a decade above it"


class TestFirstWindow:
    @pytest.mark.usefixtures("quick")
    def test_two_seconds_in_the_middle_of_what_counts(self, dashboard: Dashboard, loop: Any) -> None:
        assert first_window(dashboard.store.run.result) == (0.0, 2.0), "a record of two seconds"
        dashboard.store.change("run.duration", 4.0)
        loop.finish(dashboard.store)
        assert first_window(dashboard.store.run.result) == (1.25, 3.25)
        assert dashboard.explore.stretches["vibration"].html() == "", "the cards say it of the whole record"

    @pytest.mark.usefixtures("quick")
    def test_around_the_first_event(self, dashboard: Dashboard, loop: Any, short: Scenario) -> None:
        events = [{"kind": "wind", "start": 2.5, "wind_factor": 2.0}]
        dashboard.store.load(short.replace({"run.duration": 4.0, "events": events}))
        loop.finish(dashboard.store)
        assert first_window(dashboard.store.run.result) == (1.5, 3.5)


class TestNamesAndGrey:
    def test_names_stand_at_the_ends_of_the_lines_and_apart(self, shared: Dashboard) -> None:
        for figures in (shared.explore.traces.traces, shared.explore.spectra.spectra):
            for target, view in figures.items():
                source, axis = view.names_at_end.source.data, view.figure.y_range
                shown = [look(name).label for name, line in view.lines.items() if line.visible]
                names = [text.replace("\n", " ") for text in source["text"]]
                assert {*names} <= {*shown} and look("kf-lgs").label in names
                assert set(source["x"]) == {view.figure.x_range.end}, target
                scale = np.log10 if view is shared.explore.spectra.spectra[target] else np.asarray
                low, high = scale(axis.start), scale(axis.end)
                places = (scale(source["y"]) - low) / (high - low)
                assert 0.0 < places.min() and places.max() < 1.0
                sizes = np.array([ROOM_OF_NAME["\n" in text] for text in source["text"]])
                sizes /= max(sizes.sum(), 1.0)
                assert (np.diff(places) >= 0.5 * (sizes[1:] + sizes[:-1]) - 1e-9).all()

    def test_of_many_lines_those_that_the_verdict_does_not_name_recede(self, shared: Dashboard) -> None:
        main = shared.display.named_lines["vibration"]
        other = next(name for name in observers_of("vibration") if name not in main)
        lines = shared.explore.traces.traces["vibration"].lines
        shared.explore.lines.choices["vibration"].choose([])
        assert [name for name, line in lines.items() if not line.recedes] == [TRUTH, *main]
        grey = lines[other].renderer
        assert grey is not None and grey.glyph.line_color == GREY[False] and grey.tags == [look(other).light]
        few = [*main[: MOST_COLOURED - 2], other]
        shared.explore.lines.choices["vibration"].choose([name for name in observers_of("vibration") if name not in few])
        assert not any(line.recedes for line in lines.values()) and grey.glyph.line_color == look(other).light

    @pytest.mark.usefixtures("quick")
    def test_the_effect_of_a_change_stands_below_its_setting(self, dashboard: Dashboard, loop: Any) -> None:
        dashboard.complete()
        before = dashboard.store.run.result.result.scores
        dashboard.store.change("turbulence.wind_speed", 25.0)
        loop.finish(dashboard.store)
        html = dashboard.controls.fields["turbulence.wind_speed"].view[-1].html
        old, new, target = re.search(r">([\d.]+) → ([\d.]+) nm: (\w+), tip, ", html).groups()
        after = dashboard.store.run.result.result.scores
        pairs = {
            (number(1e3 * a.rms), number(1e3 * b.rms))
            for a in before
            for b in after
            if (a.observer, a.target, a.mode) == (b.observer, b.target, b.mode) == (b.observer, target, "tip")
            and a.observer in OBSERVERS
            and prior_knowledge(a.observer) == NOTHING
        }
        assert (old, new) in pairs
        dashboard.store.change("sensors.exposure_ratio", 4)
        loop.finish(dashboard.store)
        assert len(dashboard.controls.fields["turbulence.wind_speed"].view) == 1, "of the last change alone"
        dashboard.store.replace({"turbulence.wind_speed": 20.0, "sensors.exposure_ratio": 5})
        loop.finish(dashboard.store)
        assert len(dashboard.controls.fields["sensors.exposure_ratio"].view) == 1, "several settings at once"
