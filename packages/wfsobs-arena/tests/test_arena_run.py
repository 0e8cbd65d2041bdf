"""A run: entries by registry and by folder, results written once, failures as an estimate of zero, one page."""

from __future__ import annotations

import hashlib
import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from wfsobs_arena import cli, trials
from wfsobs_arena.cases import SimulatedCase, mean_square
from wfsobs_arena.challengers import CHALLENGERS
from wfsobs_arena.definition import Arena, add_records, load_arena
from wfsobs_arena.entries import ArenaEntry, admits, find_entries, load_object
from wfsobs_arena.process import Answer, EntryProcess, solve
from wfsobs_arena.reference import taps_error
from wfsobs_arena.results import needs_of, tables, write_results
from wfsobs_arena.run import run_arena
from wfsobs_arena.tracks import TRACKS
from wfsobs_arena.trials import try_record

from wfsobs.cli import main
from wfsobs.observers import OBSERVERS
from wfsobs.prior import Prior
from wfsobs.record import Record
from wfsobs.settings.values import SettingError
from wfsobs.telemetry.records import save_record

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def arena() -> Arena:
    quick = load_arena(quick=True)
    return Arena(quick.version, tuple(case for case in quick.cases if case.track == "turbulence"), quick.rules)


@pytest.mark.slow
def test_an_entry_runs_once_and_stands_on_the_page(arena: Arena, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entries = find_entries(["persistence"])
    (first,) = run_arena(arena, entries, tmp_path)
    case = arena.cases[0]
    assert isinstance(case, SimulatedCase)
    record = case.record(case.seeds[0])
    after = slice(round(case.scenario.run.warm_up / record.dt), None)
    expected = mean_square((record.z - case.truth(record))[after])
    got = first.trials["turbulence", "paper"][0]
    assert got.squares == pytest.approx([expected], rel=1e-9)  # the process adds in another order at most
    assert got.reference[0] < expected and got.record == case.record_id(case.seeds[0])

    def never(*_: Any) -> None:
        raise AssertionError("runs again")

    monkeypatch.setattr(EntryProcess, "_ask", never)
    (again,) = run_arena(arena, entries, tmp_path)
    assert again.trials == first.trials
    values = tables(arena, [again])
    write_results(values, tmp_path)
    row = json.loads((tmp_path / "results.json").read_text())["tracks"][0]["rows"][0]
    assert row["rank"] == 1 and row["told"] == "none" and row["failures"] == 0
    page = (tmp_path / "index.html").read_text()
    assert "Persistence" in page and f"{row['score']:.3f}" in page
    assert "http" not in page  # self-contained
    of_trials, of_checks = (next(tmp_path.glob(f"results/persistence/{name}*.json")) for name in ("turbulence", "check"))
    known = json.loads(of_trials.read_text())
    for path, damage in (
        (of_trials, {"trials": None}),
        (of_trials, {"trials": [known["trials"][0] | {"extra": 1}]}),
        (of_trials, {"trials": [known["trials"][0] | {"squares": [None]}]}),
        (of_checks, {"refusal": None}),
    ):
        whole = path.read_text()
        path.write_text(json.dumps(json.loads(whole) | damage))
        with pytest.raises(AssertionError, match="runs again"):
            run_arena(arena, entries, tmp_path)
        path.write_text(whole)


def test_tables_of_other_tracks_stay(arena: Arena, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    quick = load_arena(quick=True)
    monkeypatch.setattr(cli, "run_arena", lambda *_, **__: [])

    def page(track: str, label: str, version: int = quick.version) -> str:
        table = {"id": track, "label": label, "help": "", "scenarios": [], "rows": []}
        monkeypatch.setattr(cli, "load_arena", lambda **_: Arena(version, quick.cases, quick.rules))
        monkeypatch.setattr(cli, "tables", lambda *_: tables(arena, []) | {"tracks": [table]})
        chosen = ["--out", str(tmp_path), "--track", track, "--entry", "kf-lgs"]
        assert CliRunner().invoke(main, ["arena", "run", *chosen], catch_exceptions=False).exit_code == 0
        return (tmp_path / "index.html").read_text()

    page("events", "first events")
    page("turbulence", "the turbulence")
    both = page("events", "second events")
    assert both.index("the turbulence") < both.index("second events") and "first events" not in both
    assert "the turbulence" not in page("events", "other events", quick.version + 1)
    whole = json.loads((tmp_path / "results.json").read_text())
    for damaged in ([], whole | {"tracks": None}):
        (tmp_path / "results.json").write_text(json.dumps(damaged))
        assert "the turbulence" in page("turbulence", "the turbulence")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["run", "--track", "closed-loop", "--entry", "kf-lgs"], "arena run: in no track that is chosen: kf-lgs;"),
        (["run", "--track", "next", "--entry", "rls"], "arena run: in no track that is chosen: rls;"),
        (["run", "--track", "next"], "arena run: in no track that is chosen: every entry;"),
        (
            ["run", "--track", "vibration", "--entry", "kf-lgs", "--entry", "integrator", "--entry", "multirate"],
            "arena run: in no track that is chosen: integrator, multirate;",
        ),
        (["records", "--track", "closed-loop", "--track", "next"], "arena records: there are none of closed-loop, next:"),
    ],
)
def test_nothing_is_written_where_nobody_takes_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], reason: str
) -> None:
    monkeypatch.setattr(cli, "run_arena", lambda *_, **__: pytest.fail("runs"))
    done = CliRunner().invoke(main, ["arena", *words, "--out", str(tmp_path / "out")])
    assert done.exit_code == 2 and reason in done.stderr and done.stderr.count("\n") == 1 and not (tmp_path / "out").exists()


def folder_of(place: Path) -> ArenaEntry:
    (entry,) = find_entries([str(place)])
    return entry


def test_a_folder_of_estimates(arena: Arena, tmp_path: Path) -> None:
    case = arena.cases[0]
    record, path = case.record(case.seeds[0]), tmp_path / f"{case.record_id(case.seeds[0])}.npz"
    truth = case.truth(record)

    def trial() -> trials.Trial:
        return try_record(folder_of(tmp_path), case, case.seeds[0], record, [1.0], None, arena.rules)

    zero = [mean_square(truth[part]) for part in case.stretches(record)]
    assert trial().failure == f"{path.name}: there is no such file" and trial().squares == zero
    np.savez(path, estimate=np.full(truth.shape, np.nan))
    assert trial().failure == "no number in 2000 of 2000 steps that are scored" and trial().squares == zero
    np.savez(path, estimate=truth[:5])
    assert trial().failure.startswith(f"estimate takes numbers of shape {truth.shape}") and trial().squares == zero
    np.savez(path, estimate=np.array([{"a": 1}], dtype=object))
    assert "there is no" not in trial().failure and trial().failure and trial().squares == zero
    path.write_bytes(pickle.dumps(truth))
    assert "takes an .npz with estimate" in trial().failure
    np.savez(path, estimate=truth + 0.01, sd=np.full(truth.shape, 0.01))
    good = trial()
    assert not good.failure and good.squares == pytest.approx([2 * 0.01**2], rel=1e-9)
    assert good.calibration["within_95"] == 1.0 and good.microseconds is None


def test_a_folder_enters_the_tracks_that_it_has_files_of(arena: Arena, tmp_path: Path) -> None:
    whole, case = load_arena(quick=True, seeds=1), arena.cases[0]
    (tmp_path / "mine").mkdir()
    np.savez(tmp_path / "mine" / f"{case.record_id(case.seeds[0])}.npz", estimate=case.truth(case.record(case.seeds[0])))
    (outcome,) = run_arena(whole, [folder_of(tmp_path / "mine")], tmp_path / "out")
    assert list(outcome.trials) == [("turbulence", "paper")]
    assert outcome.trials["turbulence", "paper"][0].squares == [0.0]
    assert tables(whole, [outcome])["tracks"][0]["rows"][0]["score"] == 0.0


def test_who_enters_where() -> None:
    def tracks(name: str) -> list[str]:
        return [t.id for t in TRACKS.values() if admits(t, find_entries([name])[0])]

    assert tracks("kf-lgs") == ["vibration", "turbulence", "disturbance", "next", "two-sensors", "events"]
    assert tracks("multirate") == ["two-sensors"]
    assert tracks("integrator") == ["closed-loop"]
    assert tracks("predictive-rls") == ["closed-loop"]
    assert tracks("rls") == ["disturbance", "next", "events"]


def test_what_an_entry_is_told() -> None:
    multi, rls = find_entries(["kf-multi", "rls"])
    assert needs_of(multi, TRACKS["vibration"]) == "model, true peaks"
    assert needs_of(multi, TRACKS["next"]) == "model, identified peaks"
    assert needs_of(rls, TRACKS["next"]) == "none"


@pytest.mark.parametrize("name", ["nobody", "nowhere:ME", "wfsobs.record:DELAY"])
def test_an_entry_that_is_none(name: str) -> None:
    with pytest.raises(SettingError, match="--entry"):
        find_entries([name])


def test_an_id_that_is_no_name_of_a_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    place = "wfsobs_arena.challengers:ELSEWHERE"
    monkeypatch.setattr("wfsobs_arena.challengers.ELSEWHERE", replace(OBSERVERS["zero"], id="../../x"), raising=False)
    with pytest.raises(SettingError, match=rf"^--entry {place}: the id '\.\./\.\./x' takes lower-case letters"):
        find_entries([place])


def test_the_reference_of_thirty_taps_is_least_squares() -> None:
    rng = np.random.default_rng(3)
    z = rng.standard_normal((3000, 1)).cumsum(axis=0) * 0.01
    truth = 0.5 * z + 0.25 * np.vstack([z[:1] * 0, z[:-1]])
    error = taps_error(z, truth, z, truth)
    # a filter of two taps is within reach: what is left is the penalty of 1e-6
    assert np.std(error[100:]) < 1e-3 * np.std(truth)


def test_controllers_answer_with_commands(arena: Arena) -> None:
    case = next(c for c in load_arena(quick=True).cases if c.track == "closed-loop")
    record = case.record(case.seeds[0])

    class Still:
        def run(self, _seconds: float, *_: Any) -> Answer:
            return Answer({"u": np.zeros_like(record.y_lgs)}, 0.0)

    (entry,) = find_entries(["integrator"])
    found = try_record(entry, case, case.seeds[0], record, [1.0], Still(), arena.rules)  # type: ignore[arg-type]
    assert found.squares == pytest.approx([mean_square(case.truth(record)[part]) for part in case.stretches(record)], rel=1e-12)


class Here:
    """The same without a process of its own."""

    def __init__(self, entry: ArenaEntry):
        self.algorithm = load_object(entry)

    def run(self, _seconds: float, *arguments: Any) -> Answer:
        return Answer(solve(self.algorithm, *arguments), 0.0)


def test_telemetry_is_known_by_its_bytes_and_scored_in_parts(arena: Arena, tmp_path: Path) -> None:
    record = arena.cases[0].record(1)
    path = tmp_path / "night.npz"
    save_record(path, Record(record.y_lgs, record.u, record.dt, delay=record.delay))
    case = add_records(arena, [path]).cases[-1]
    assert case.record_id(0) == hashlib.sha256(path.read_bytes()).hexdigest() and (case.track, case.name) == ("next", "night")
    z, n = record.z, record.n_steps
    given = case.record(0)
    references = case.reference_squares(given, 0)
    (rls,) = find_entries(["rls"])
    found = try_record(rls, case, 0, given, references, Here(rls), arena.rules)  # type: ignore[arg-type]
    predicted = CHALLENGERS["rls"].algorithm.estimate(given.measurements(), Prior())["turbulence"]
    squares = np.sum((predicted[:-1] - z[1:]) ** 2, axis=1)[n // 2 : n - 1]
    counts = [part.stop - part.start for part in case.stretches(given)]
    assert len(found.squares) == 8 and sum(counts) == n - 1 - n // 2
    # parts together are all of the second half
    assert np.average(found.squares, weights=counts) == pytest.approx(squares.mean(), rel=1e-9)
    # what is told was identified: a filter of it does not do much worse than thirty taps that were trained on 1.5 s, nor RLS
    (kf,) = find_entries(["kf-lgs"])
    filtered = try_record(kf, case, 0, given, references, Here(kf), arena.rules)  # type: ignore[arg-type]
    assert not filtered.failure and filtered.calibration["within_95"] > 0.8
    for one in (found, filtered):
        assert np.mean(one.squares) < 1.5**2 * np.mean(references)


def test_two_records_of_one_name_are_refused(arena: Arena, tmp_path: Path) -> None:
    record = arena.cases[0].record(1)
    paths = [tmp_path / "a" / "night.npz", tmp_path / "b" / "night.npz"]
    for path in paths:
        path.parent.mkdir()
        save_record(path, Record(record.y_lgs, record.u, record.dt))
    with pytest.raises(SettingError, match="two records have the name night"):
        add_records(arena, paths)
