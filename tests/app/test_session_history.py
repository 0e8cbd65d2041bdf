"""The history of a session: what it keeps and what it calls it, comparisons, and the way back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from wfsobs.app import history as module
from wfsobs.app.cache import size_of
from wfsobs.app.compared import LETTERS, ComparedRun, find_score, name_of_change
from wfsobs.app.display import Display
from wfsobs.app.history import History
from wfsobs.app.limits import NONE, Limits
from wfsobs.app.service import Service
from wfsobs.app.session_file import HistoryEntry
from wfsobs.app.sources import LoadedRecord, SimulatedRecord, Source
from wfsobs.app.store import Store
from wfsobs.app.work import RunResults
from wfsobs.evaluation.result import Result
from wfsobs.evaluation.scores import Score
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS

WIND = "turbulence.wind_speed"
OF_ONE = 3 * 1000 * 2 * 8
"""Bytes of a result of `quick`."""


def quick(scenario: Scenario, _watch: Any, _tell: Any, source: Source | None = None) -> RunResults:
    """A result at once: one score, which is the wind, and a record of some size."""
    record = source.record if isinstance(source, LoadedRecord) else some_record(scenario.run.seed)
    score = Score("kf-lgs", "turbulence", "tip", scenario.turbulence.wind_speed, 1.0, None, None, 1e-6)
    return RunResults(Result(scenario, record, (), (score,)), source=source)


def some_record(seed: int) -> Record:
    y, u, truth = np.random.default_rng(seed).standard_normal((3, 1000, 2))
    return Record(y_lgs=y, u=u, dt=1e-3, turbulence=truth)


def loaded(seed: int = 1, name: str = "night.npz") -> LoadedRecord:
    return LoadedRecord(some_record(seed), name, f"key {seed}")


@pytest.fixture
def store(make_store: Any) -> Store:
    return make_store(quick)


@pytest.fixture
def history(store: Store, loop: Any) -> History:
    """Three results: the preset, more wind, a higher gain."""
    history = History(store, Display())
    history.most_bytes = 10 * OF_ONE
    store.start()
    loop.finish(store)
    for path, value in ((WIND, 20), ("loop.gain", 0.2)):
        change(history, loop, path, value)
    return history


def change(history: History, loop: Any, path: str, value: Any) -> None:
    assert history.store.change(path, value)
    loop.finish(history.store)


def names(history: History) -> list[str]:
    return [entry.name for entry in history.entries]


def key_of(history: History, name: str) -> str:
    return next(entry.key for entry in history.entries if name in entry.name)


class TestEntries:
    def test_newest_first_and_named_by_the_change(self, history: History) -> None:
        assert names(history)[:2] == ["Integrator gain g 0.3 → 0.2", "Wind speed V₀ 15 → 20 m/s"]
        assert names(history)[2].startswith("Preset Paper, ") and len(names(history)) == 3
        assert history.current == history.entries[0].key
        assert [entry.scores[0].rms for entry in history.entries] == [20.0, 20.0, 15.0]

    def test_the_same_settings_move_to_the_top(self, history: History, loop: Any) -> None:
        first = history.entries[2]
        history.star(first.key)
        history.rename(first.key, "  as it\n was ")
        history.store.load(first.scenario)
        loop.finish(history.store)
        assert len(history.entries) == 3 and history.entries[0] is first
        assert (first.name, first.star) == ("as it was", True)
        change(history, loop, WIND, 16)
        assert names(history)[0] == "Wind speed V₀ 15 → 16 m/s", "named by the change from what was shown"

    def test_what_did_not_finish_is_no_result(self, history: History) -> None:
        history.store.change(WIND, 40)
        history.store.run.cancel()
        assert len(history.entries) == 3

    def test_a_record_and_a_preset(self, history: History, loop: Any) -> None:
        history.store.run_on(loaded(), history.store.scenario)
        loop.finish(history.store)
        assert names(history)[0] == "Record night.npz" and history.entries[0].record == "night.npz"
        history.store.run_on(None, history.store.scenario)
        loop.finish(history.store)
        assert names(history)[0] == "Integrator gain g 0.3 → 0.2", "the same as before the record"
        history.store.choose("ut4")
        history.store.run.cancel()
        assert name_of_change(history.entries[0].step, history.store.step) == "Preset UT4"

    def test_names(self) -> None:
        paper = PRESETS["paper"]()
        other = paper.replace({WIND: 20, "loop.gain": 0.2, "run.seed": 3, "loop.closed": False})
        assert name_of_change(None, (paper, "paper", None)) == "Preset Paper"
        assert name_of_change((paper, "paper", None), (other, "paper", None)).endswith(" and 1 more")
        kept = (paper, "paper", SimulatedRecord(paper))
        assert name_of_change((paper, "paper", None), kept) == "Simulation kept"
        assert name_of_change(kept, (paper, "paper", None)) == "Simulation of the settings"
        assert name_of_change(None, (paper, "paper", loaded())) == "Preset Paper, Record night.npz"


class TestLimits:
    def test_traces_go_the_oldest_first_and_starred_ones_last(self, history: History, loop: Any) -> None:
        oldest = history.entries[2]
        assert size_of(oldest.results) == OF_ONE
        history.star(oldest.key)
        history.most_bytes = 2 * OF_ONE
        for wind in (30, 31):
            change(history, loop, WIND, wind)
            change(history, loop, "run.seed", wind)
        held = [entry for entry in history.entries if entry.results is not None]
        assert oldest in held and history.entries[0] in held
        assert size_of([entry.results for entry in held]) <= 2 * OF_ONE
        assert all(entry.scores for entry in history.entries), "the scores of all are there"

    def test_lines_of_compared_runs_count(self, history: History) -> None:
        history.most_bytes = 3 * OF_ONE
        oldest = history.entries[2]
        history.compare(oldest.key)
        (run,) = history.display.compared_runs
        assert 0 < size_of(run.lines) < OF_ONE
        assert [entry.results is None for entry in history.entries] == [False, False, True], "its lines take the place of one"
        assert run.lines is not None, "and stay"

    def test_the_oldest_entries_go(self, history: History, loop: Any, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(module, "MOST", 4)
        oldest, second, _ = reversed(history.entries)
        history.star(oldest.key)
        for wind in (30, 31, 32):
            change(history, loop, WIND, wind)
        assert len(history.entries) == 4 and oldest in history.entries and second not in history.entries

    def test_records_are_limited(self, history: History, loop: Any) -> None:
        history.most_record_bytes = OF_ONE
        for seed in (1, 2):
            history.store.run_on(loaded(seed, f"night{seed}.npz"), history.store.scenario)
            loop.finish(history.store)
        second, first = history.entries[:2]
        assert second.source is not None and first.source is None and not first.is_restorable
        before = history.store.step
        history.restore(first.key)
        assert history.store.step == before and history.note.endswith("night1.npz is no longer held, load it again")

    def test_a_server_with_many_visitors_gives_each_less(self) -> None:
        alone, many = (Service(limits, 1, 4000, quick) for limits in (NONE, Limits(sessions=40)))
        assert (alone.session_share(4000), many.session_share(4000)) == (1000, 100)


class TestRestore:
    def test_settings_record_and_view(self, history: History, loop: Any) -> None:
        opened: list[str] = []
        history.open_view = opened.append
        history.follow_view("view.mode=tilt&theme=dark")
        record = loaded()
        history.store.run_on(record, history.store.scenario)
        loop.finish(history.store)
        history.follow_view("view.page=model")
        change(history, loop, WIND, 33)
        history.follow_view("")
        history.restore(key_of(history, "night"))
        loop.finish(history.store)
        assert history.store.source is record and history.store.scenario.turbulence.wind_speed == 20.0
        assert opened == ["view.page=model"]
        history.restore(key_of(history, "gain"))
        loop.finish(history.store)
        assert history.store.source is None and opened[-1] == "view.mode=tilt"
        assert len(history.entries) == 5, "nothing is lost"

    def test_settings_that_have_not_run_are_kept(self, history: History, loop: Any) -> None:
        history.store.change(WIND, 44)
        history.store.run.cancel()
        history.restore(history.entries[2].key)
        loop.finish(history.store)
        waiting = history.find(key_of(history, "20 → 44"))
        assert waiting is not None and waiting.scores == () and waiting.scenario.turbulence.wind_speed == 44.0
        history.store.undo()
        assert history.store.value(WIND) == 44.0, "and it is a step that can be undone"

    def test_what_the_server_refuses(self, history: History, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(_step: object) -> None:
            raise module.SettingError("run.duration = 300: at most 60 on this server")

        monkeypatch.setattr(history.store, "restore", refuse)
        before = history.store.step
        history.restore(history.entries[2].key)
        assert history.note.endswith("at most 60 on this server") and history.store.step == before


class TestDelete:
    def test_and_back(self, history: History) -> None:
        order, second = names(history), history.entries[1]
        history.compare(second.key)
        history.delete(second.key)
        assert second not in history.entries and history.display.compared_runs == [] and history.can_undelete
        history.undelete()
        assert names(history) == order and not history.can_undelete
        history.undelete()
        history.delete("nobody")
        assert names(history) == order


class TestCompare:
    def test_up_to_five_by_letters(self, history: History, loop: Any) -> None:
        for wind in range(21, 25):
            change(history, loop, WIND, wind)
        for entry in history.entries:
            history.compare(entry.key)
        runs = history.display.compared_runs
        assert "".join(run.letter for run in runs) == LETTERS
        assert [run.key for run in runs] == [entry.key for entry in history.entries[:5]]
        assert history.note.startswith("5 are compared already")
        history.compare(runs[1].key, False)
        history.compare(history.entries[6].key)
        assert [run.key for run in history.display.compared_runs][1] == history.entries[6].key, "it takes the free letter"
        history.rename(history.entries[6].key, "mine")
        assert history.display.compared_runs[1].name == "mine"
        history.compare_none()
        assert history.display.compared_runs == []

    def test_traces_are_made_again(self, history: History, loop: Any) -> None:
        for entry in history.entries[1:]:
            entry.results = None
            history.compare(entry.key)
        assert [run.lines for run in history.display.compared_runs] == [None, None]
        assert [run.scores[0].rms for run in history.display.compared_runs] == [20.0, 15.0], "scores are there at once"
        loop.until(lambda: all(run.lines for run in history.display.compared_runs))
        lines = history.display.compared_runs[1].lines
        expected = some_record(history.entries[2].scenario.run.seed).turbulence
        assert lines is not None and expected is not None
        np.testing.assert_allclose(lines.signals["truth", "turbulence"], expected, rtol=1e-6)  # of single precision
        assert history.current == history.entries[0].key, "what is shown stays"

    def test_what_cannot_be_made_again_is_passed_over(self, history: History, loop: Any) -> None:
        lost, other = history.entries[1:]
        for entry in (lost, other):
            entry.results = None
        lost.record = "night.npz"
        history.compare(lost.key)
        history.compare(other.key)
        loop.until(lambda: history.display.compared_runs[1].lines is not None)
        assert history.display.compared_runs[0].lines is None


def test_entries_of_another_session(history: History) -> None:
    known, spare = history.entries[1], PRESETS["ut4"]()
    same = HistoryEntry(known.key, "theirs", 0.0, known.scenario, "paper", star=True)
    other = HistoryEntry("other", "older", 1.0, spare, "ut4")
    history.add([other, same])
    assert known.star and known.name == "Wind speed V₀ 15 → 20 m/s", "what is here stays as it is called"
    assert history.entries[-1] is other and len(history.entries) == 4


def test_a_run_has_the_score_of_its_kind() -> None:
    score = Score("kf-lgs", "turbulence", "tip", 1.0, 1.0, None, None, 1e-6)
    run = ComparedRun("key", "A", "name", Scenario(), (score,))
    assert find_score(run.scores, "kf-lgs", "turbulence", "tip") is score
    assert find_score(run.scores, "kf-lgs", "turbulence", "tilt") is None
