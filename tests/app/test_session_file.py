"""A session as a file: there and back, and what is refused of files that are none."""

from __future__ import annotations

import io
import json
import random
import zipfile
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.app import session_file as module
from wfsobs.app.service import run_key
from wfsobs.app.session_file import MOST, HistoryEntry, SessionContent, SessionError, make_entry, read_session, write_session
from wfsobs.app.sources import LoadedRecord, SimulatedRecord, record_key
from wfsobs.evaluation.scores import Calibration, Score
from wfsobs.record import Record, Training
from wfsobs.scenario.presets import PRESETS
from wfsobs.telemetry.intake import DeclaredFormat

PAPER = PRESETS["paper"]()
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
SCORES = st.builds(
    Score,
    st.sampled_from(["kf-lgs", "bound"]),
    st.just("turbulence"),
    st.just("tip"),
    st.floats(0.0, allow_infinity=False),
    NUMBERS,
    st.none() | NUMBERS,
    st.none() | NUMBERS,
    NUMBERS,
    st.none() | NUMBERS,
    st.none() | NUMBERS,
    st.booleans(),
    st.none() | st.tuples(NUMBERS, NUMBERS),
    st.none() | st.lists(NUMBERS).map(tuple),
    st.none() | st.builds(Calibration, NUMBERS, NUMBERS, NUMBERS, NUMBERS),
)
NAMES = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), min_size=1, max_size=200)


def some_record() -> Record:
    """A record with frames of the NGS, missing samples, a training record and an origin."""
    y, u, ngs, truth = np.random.default_rng(3).standard_normal((4, 60, 2))
    y[7] = np.nan
    ngs[np.arange(60) % 5 != 0] = np.nan
    ngs[0] = np.nan
    return Record(y, u, 1e-3, ngs, 5, None, 3, truth, None, Training(y[20:], u[20:], truth[20:]), "unit nm")


def loaded() -> LoadedRecord:
    record, said = some_record(), DeclaredFormat("nm", -1, 3, 500.0, {"u/tip": "column 3"})
    return LoadedRecord(record, "night.npz", record_key(record), "a line on it", said, "ab" * 32)


def session() -> SessionContent:
    """Of three results: a simulation, one that was kept, a record."""
    windy = PAPER.replace({"turbulence.wind_speed": 22.5})
    steps = [(windy, "paper", None), (PRESETS["ut4"](), "ut4", SimulatedRecord(PAPER)), (PAPER, "paper", loaded())]
    entries = [make_entry(step, f"entry {i}") for i, step in enumerate(steps)]
    entries[0].star = entries[1].own_name = True
    entries[2].view = "view.mode=tilt"
    entries[0].scores = (Score("kf-lgs", "turbulence", "tip", 0.1, 0.2, 0.5, None, 1e-6),)
    return SessionContent(entries, steps[2], "view.page=model", [entries[1].key])


def fields(entry: HistoryEntry) -> dict[str, Any]:
    return {name: value for name, value in vars(entry).items() if name != "source"}


def same(one: SessionContent, other: SessionContent) -> None:
    assert [fields(entry) for entry in one.entries] == [fields(entry) for entry in other.entries]
    assert (one.view, [*one.compared_keys]) == (other.view, [*other.compared_keys])
    assert one.step[:2] == other.step[:2]
    sources = [[content.step[2], *(entry.source for entry in content.entries)] for content in (one, other)]
    for mine, theirs in zip(*sources, strict=True):
        assert type(mine) is type(theirs) and (mine is None or mine.key == theirs.key)
        if isinstance(mine, LoadedRecord):
            own = {"training": mine.record.training, "gate": mine.record.gate}  # of the settings, not of the file
            np.testing.assert_equal(vars(mine.record), vars(theirs.record) | own)
            np.testing.assert_equal(vars(mine.record.training), vars(theirs.record.training))
            names = ("name", "what", "declaration", "sha256")
            assert [getattr(mine, name) for name in names] == [getattr(theirs, name) for name in names]


def test_there_and_back() -> None:
    content = session()
    same(content, read_session(write_session(content)))


@settings(max_examples=60, deadline=None)
@given(st.lists(SCORES, max_size=4), NAMES, st.booleans(), st.floats(0.1, 100), NUMBERS)
def test_any_session_comes_back(scores: list[Score], name: str, star: bool, wind: float, time: float) -> None:
    step = PAPER.replace({"turbulence.wind_speed": wind}), "paper", None
    entry = replace(make_entry(step, name), scores=tuple(scores), star=star, time=time)
    content = SessionContent([entry], step)
    same(content, read_session(write_session(content)))


def test_a_record_that_is_no_longer_held() -> None:
    entry = make_entry((PAPER, "paper", loaded()), "lost")
    entry.source = None
    (back,) = read_session(write_session(SessionContent([entry], (PAPER, "paper", None)))).entries
    assert (back.key, back.record, back.source) == (entry.key, "night.npz", None) and not back.is_restorable


def test_the_key_is_that_of_the_content() -> None:
    """A file that says otherwise cannot put its results in the place of those of another record."""
    content = session()
    content.entries[2].source = replace(loaded(), key="that of somebody else")  # type: ignore[type-var]
    content = SessionContent(content.entries, (PAPER, "paper", None))
    back = read_session(write_session(content)).entries[2]
    assert back.key == run_key(PAPER, loaded())


def one_line(content: bytes) -> str:
    with pytest.raises(SessionError) as error:
        read_session(content)
    line = str(error.value)
    assert line and "\n" not in line and len(line) <= 400
    return line


def test_bytes_changed_and_cut_give_one_line_or_the_same() -> None:
    content = SessionContent(session().entries[:1], session().entries[0].step)
    file = write_session(content)
    rng = random.Random(5)
    for at in [*range(50), *rng.sample(range(50, len(file)), 150), *range(len(file) - 100, len(file))]:
        damaged = file[:at] + bytes([file[at] ^ rng.randrange(1, 256)]) + file[at + 1 :]
        try:
            back = read_session(damaged)
        except SessionError:
            one_line(damaged)
        else:  # a date, say
            same(content, back)
    for end in rng.sample(range(len(file)), 100):
        one_line(file[:end])


def changed(change: Callable[[dict[str, Any]], Any]) -> bytes:
    """A session whose values were changed by hand."""
    with zipfile.ZipFile(io.BytesIO(write_session(session()))) as archive:
        values = json.loads(archive.read(module.JSON))
        records = archive.read("records/0.npz")
    change(values)
    return packed(json.dumps(values), records)


def packed(text: str, records: bytes = b"") -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(module.JSON, text)
        archive.writestr("records/0.npz", records)
    return file.getvalue()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda v: v.update(version=2), "is of version 2; version 1 is read here"),
        (lambda v: v.update(format="other"), "no session of wfsobs"),
        (lambda v: v.pop("entries"), "entries is missing"),
        (lambda v: v["entries"].extend(v["entries"] * MOST), "holds 603 results, at most 200 are read here"),
        (lambda v: v["entries"][0]["scenario"]["turbulence"].update(wind_speed=-1), "result 1: turbulence.wind_speed = -1"),
        (lambda v: v["entries"][0]["scenario"].update(moon=1), "result 1: moon: no such setting"),
        (lambda v: v["entries"][0].update(preset="moon"), "result 1: there is no preset 'moon'"),
        (lambda v: v["entries"][0].update(time="now"), "result 1: time is missing or of the wrong kind"),
        (lambda v: v["entries"][0].update(time=float("nan")), "result 1: time = nan: takes a finite number"),
        (lambda v: v["entries"][0]["scores"][0].update(rms=float("inf")), "result 1: rms = inf: takes a finite number from 0"),
        (lambda v: v["entries"][0]["scores"][0].update(rms=-1.0), "result 1: rms = -1: takes a finite number from 0"),
        (lambda v: v["entries"][0].update(star=1), "result 1: star is missing or of the wrong kind"),
        (lambda v: v["entries"][0]["scores"][0].update(rms=None), "result 1: rms is missing or of the wrong kind"),
        (lambda v: v["entries"][0]["scores"][0].pop("lag"), "result 1: lag is missing"),
        (lambda v: v["entries"][0]["scores"][0].update(rms=10**400), "result 1: rms is missing or of the wrong kind"),
        (lambda v: v["entries"][0].update(name="\ud800"), "result 1: name is missing or of the wrong kind"),
        (lambda v: v["entries"][0]["scores"][0].update(interval=[1]), "result 1: interval is missing or of the wrong kind"),
        (lambda v: v["entries"][2]["source"].update(number=1), "result 3: one of its records is missing"),
        (lambda v: v["entries"][2]["source"].update(sha256="zz"), "result 3: a SHA-256 takes 64"),
        (lambda v: v["entries"][2]["source"]["declaration"].update(unit="moons"), "what is said of a record makes no sense"),
        (lambda v: v["entries"].append(3), "result 4: damaged"),
        (lambda v: v["shown"].update(scenario=[]), "scenario is missing or of the wrong kind"),
    ],
)
def test_values_that_make_no_sense(change: Callable[[dict[str, Any]], Any], reason: str) -> None:
    assert reason in one_line(changed(change))


def test_scores_of_observers_that_are_not_here_are_left_out() -> None:
    file = changed(lambda v: v["entries"][0]["scores"].append(v["entries"][0]["scores"][0] | {"observer": "moon"}))
    assert read_session(file).entries[0].scores == session().entries[0].scores


@pytest.mark.parametrize(
    "content",
    [b"", b"PK", packed("[" * 100_000), packed("{}"), packed("no JSON"), packed('{"version":' + "9" * 10_000 + "}")],
    ids=["empty", "start", "deep", "nothing", "text", "digits"],
)
def test_no_session_at_all(content: bytes) -> None:
    one_line(content)


def test_bombs_are_not_unpacked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_TEXT", 10_000)
    assert "holds more than 0.01 MB" in one_line(packed(" " * 20_000))
    monkeypatch.undo()
    monkeypatch.setattr(module, "MOST_RECORD_BYTES", 1000)
    assert "which is the most that is read here" in one_line(write_session(session()))


def test_no_pickle_is_read() -> None:
    arrays = io.BytesIO()
    np.savez(arrays, y_lgs=np.array([{}], dtype=object), u=np.zeros((2, 2)))
    with zipfile.ZipFile(io.BytesIO(write_session(session()))) as archive:
        text = archive.read(module.JSON).decode()
    assert "damaged, or holds more than plain arrays" in one_line(packed(text, arrays.getvalue()))
