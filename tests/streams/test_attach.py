"""An observer on streams: the numbers of its run over the record, and a safe output whatever the stream does."""

import json
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from subprocess import Popen
from threading import Thread

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

import wfsobs
from tests.patience import ENOUGH
from tests.streams.conftest import LONGEST, started, wait_until
from wfsobs.cli import main
from wfsobs.observers.step import StepObserver
from wfsobs.signal.gate import RUN, GateSettings
from wfsobs.stepping import design
from wfsobs.streams.attach import Attachment, CommandStream
from wfsobs.streams.follower import Tally
from wfsobs.streams.shared_image import SharedImage
from wfsobs.streams.wiring import Fallback, NgsStream, NgsWiring, Safety, Wiring

pytestmark = pytest.mark.slow

SINGLE = 2e-7
"""Rounding of float32 over the size of a number, three times over: measurement, estimate, comparison."""


def measurements(n: int) -> np.ndarray:
    return QUIET.z[:n].copy()


def stepped(z: np.ndarray, name: str, ahead: float) -> np.ndarray:
    """What an observer gives frame by frame, (n, n_modes)."""
    observer = design(name, wfsobs.PRESETS["paper"]())
    out = []
    for row in z:
        observer.update(row)
        out.append(np.sum([observer.predict(ahead - 1, target)[0] for target in observer.targets], axis=0))
    return np.array(out)


def test_a_modal_filter_in_c_gets_the_numbers_of_the_run_over_the_record(tmp_path: Path, peer: Path) -> None:
    """Modes 3 and 1 of five are ours; nm; two frames ahead; one block per frame; the others' numbers are not touched."""
    n = 800
    z = measurements(n)
    frames = np.random.default_rng(2).normal(size=(n, 5)).astype("<f4")
    frames[:, [3, 1]] = 1e3 * z
    frames.tofile(tmp_path / "values")
    given, taken = tmp_path / "aol1_modevalOL.im.shm", tmp_path / "aol1_modevalPF.im.shm"
    command = [peer, "loop", given, taken, n, 5, tmp_path / "values", tmp_path / "result", int(ENOUGH * 1e6), 1]
    with started(*command) as loop:
        wait_until(given.exists)
        options = ["--preset", "paper", "--set", "run.warm_up=0.5", "--observer", "kf-lgs", "--modes", "3,1", "--unit", "nm"]
        more = ["--delay", "2", "--stuck", LONGEST, "--semaphore", "9", "--json"]
        attach = [sys.executable, "-m", "wfsobs", "attach", "--in", str(given), "--out", str(taken), *options, *more]
        with started(*attach) as ours:
            told, _ = loop.communicate(timeout=2 * ENOUGH)
            ours.send_signal(signal.SIGTERM)
            out, err = ours.communicate(timeout=ENOUGH)
    assert ours.returncode == 0, err
    assert loop.returncode == 0 and int(told) == 0, "frames that were not answered"
    result = np.fromfile(tmp_path / "result", "<f4").reshape(n, 5)
    expected = 1e3 * stepped(frames[:, [3, 1]].astype(float) * 1e-3, "kf-lgs", 2)
    assert not result[:, [0, 2, 4]].any() and not result[:499].any()
    np.testing.assert_allclose(result[500:, [3, 1]], expected[500:], rtol=0, atol=SINGLE * np.abs(expected).max())
    summary = json.loads(out)
    assert summary["frames"] == n and summary["missing"] == summary["torn"] == summary["fallbacks"] == 0
    last = SharedImage(taken).read()
    assert last is not None and last[0] == n + 1 and not last[1].any(), "the last thing sent is safe"


@contextmanager
def attached(given: Path, taken: Path) -> Iterator[Popen[str]]:
    options = ["--preset", "paper", "--set", "run.warm_up=0.5", "--observer", "kf-lgs", "--modes", "3,1", "--json"]
    streams = ["--in", str(given), "--out", str(taken), "--stuck", LONGEST, "--semaphore", "9"]
    with started(sys.executable, "-m", "wfsobs", "attach", *streams, *options) as ours:
        yield ours


def frames_of(z: np.ndarray, folder: Path) -> np.ndarray:
    """Write frames of five numbers for the peer, modes 3 and 1 the measurements; return them."""
    frames = np.zeros((len(z), 5), "<f4")
    frames[:, [3, 1]] = z
    frames.tofile(folder / "values")
    return frames


def test_a_modal_filter_that_waits_for_two_blocks_gets_both(tmp_path: Path, peer: Path) -> None:
    """Ours are modes 3 and 1; another program writes 0 and 4 after us. Neither touches what the other has written."""
    n = 700
    frames = frames_of(measurements(n), tmp_path)
    given, taken = tmp_path / "aol1_modevalOL.im.shm", tmp_path / "aol1_modevalPF.im.shm"
    command = [peer, "loop", given, taken, n, 5, tmp_path / "values", tmp_path / "result", int(ENOUGH * 1e6), 2]
    with started(*command) as loop:
        wait_until(given.exists)
        with attached(given, taken) as ours:
            wait_until(taken.exists)
            other = SharedImage(taken)
            for k in range(n):
                assert other.wait(2 * k, ENOUGH), "ours first, so that the two do not raise the counter at once"
                other.write(np.array([k + 1.0, -k - 1.0]), np.array([0, 4]))
            told, _ = loop.communicate(timeout=2 * ENOUGH)
            ours.send_signal(signal.SIGTERM)
            _, err = ours.communicate(timeout=ENOUGH)
    assert ours.returncode == 0, err
    assert loop.returncode == 0 and int(told) == 0, "frames that were not answered by both"
    result = np.fromfile(tmp_path / "result", "<f4").reshape(n, 5)
    expected = stepped(frames[:, [3, 1]].astype(float), "kf-lgs", 1)
    np.testing.assert_allclose(result[500:, [3, 1]], expected[500:], rtol=0, atol=SINGLE * np.abs(expected).max())
    np.testing.assert_array_equal(result[:, 0], np.arange(1, n + 1))
    np.testing.assert_array_equal(result[:, 4], -np.arange(1, n + 1))


def test_a_modal_filter_goes_on_without_a_block_that_does_not_come(tmp_path: Path, peer: Path) -> None:
    """It waits for two, 2 ms at most, and there is ours alone: it ends; few frames count (two late answers at once), or none."""
    n = 200
    frames_of(measurements(n), tmp_path)
    given, taken = tmp_path / "aol1_modevalOL.im.shm", tmp_path / "aol1_modevalPF.im.shm"
    with started(peer, "loop", given, taken, n, 5, tmp_path / "values", tmp_path / "result", 2000, 2) as loop:
        wait_until(given.exists)
        with attached(given, taken) as ours:
            told, _ = loop.communicate(timeout=ENOUGH)
            ours.send_signal(signal.SIGTERM)
            out, err = ours.communicate(timeout=ENOUGH)
    assert ours.returncode == 0, err
    assert loop.returncode == 0 and n // 2 < int(told) <= n
    summary = json.loads(out)
    assert 0 < summary["frames"] + summary["missing"] <= n


def test_an_answer_that_a_newer_frame_has_overtaken_is_not_sent(tmp_path: Path) -> None:
    """Who waits for that of the newer frame gets it; but of two in a row one is sent, so that a slow observer is heard at all."""
    z = measurements(10)
    said: list[str] = []
    streams = Streams(tmp_path, said)
    expected = stepped(z, "kf-lgs", 1)
    one, sink = streams.attachment, streams.sink
    read = one._source.read
    more = {3, 7, 8}  # the next frame comes while this one is being answered

    def overtaken() -> tuple[int, np.ndarray] | None:
        found = read()
        if found is not None and found[0] - 1 in more:
            streams.source.write(z[found[0]])
        return found

    one._source.read = overtaken  # pyright: ignore[reportAttributeAccessIssue]
    counts, values = [], []
    for k in range(10):
        if k - 1 not in more:
            streams.source.write(z[k])
        one._take(0.0)
        found = sink.read()
        assert found is not None
        counts.append(found[0])
        values.append(found[1])
    assert np.diff([0, *counts]).tolist() == [1, 1, 1, 0, 1, 1, 1, 0, 1, 1]
    is_sent = np.diff([0, *counts]) == 1
    np.testing.assert_allclose(np.array(values)[is_sent], expected[is_sent], rtol=0, atol=1e-12)


class Streams:
    """Two streams with an observer between them that runs in a thread, in step with the test."""

    def __init__(self, folder: Path, said: list[str], name: str = "kf-lgs", **wiring):
        self.source = SharedImage.create(folder / "in.im.shm", (2,), dtype="float64")
        self.sink = SharedImage.create(folder / "out.im.shm", (2,), dtype="float64")
        settings = {"stuck": ENOUGH, **wiring}
        self.attachment = Attachment(
            SharedImage(folder / "in.im.shm"),
            SharedImage(folder / "out.im.shm"),
            design(name, wfsobs.PRESETS["paper"]()),
            Wiring((0, 1), 1.0, 1.0, np.full(2, 0.5), **settings),
            said.append,
        )

    @contextmanager
    def running(self) -> Iterator[None]:
        ends: list[bool] = []
        thread = Thread(target=self.attachment.run, args=(ENOUGH,), kwargs={"stop": lambda: bool(ends)})
        thread.start()
        try:
            yield
        finally:
            ends.append(True)
            self.source.write(np.zeros(2))
            thread.join(ENOUGH)
            assert not thread.is_alive()

    def answer(self, z: np.ndarray) -> np.ndarray:
        """Send a frame and return what comes back."""
        before = self.sink.count
        self.source.write(z)
        return self.next(before)

    def next(self, before: int) -> np.ndarray:
        assert self.sink.wait(before, ENOUGH)
        found = self.sink.read()
        assert found is not None
        return found[1]


def test_what_comes_while_the_observer_is_designed_is_not_missing(tmp_path: Path) -> None:
    """The newest frame is answered first, as the loop may wait for that; the next one that is left out is missing."""
    said: list[str] = []
    z = measurements(60)
    streams = Streams(tmp_path, said)
    for row in z[:50]:
        streams.source.write(row)
    streams.attachment.run(ENOUGH, stop=lambda: streams.sink.count > 0)
    assert streams.attachment.summary()["missing"] == 0 and streams.attachment.summary()["frames"] == 1
    for row in z[50:52]:
        streams.source.write(row)
    streams.attachment._take(0.0)
    assert streams.attachment.summary()["missing"] == 1 and not said


def test_the_rate_counts_from_the_first_frame_on() -> None:
    """A gap before it is of no known length of time; missing frames after it were sent."""
    tally = Tally(1 / 500)
    for k in (0, *range(5, 501)):
        tally.add(100 + k / 500, 100 + k / 500, {0: 400, 5: 4}.get(k, 0), np.zeros(1), np.zeros(1))
    assert tally.rate == pytest.approx(500) and not tally.find_rate_error()
    assert tally.summary()["missing"] == 404


def test_missing_and_unreadable_measurements_are_missing(tmp_path: Path) -> None:
    said: list[str] = []
    z = measurements(200)
    gone = z.copy()
    gone[50:53], gone[100, 0], gone[120] = np.nan, np.nan, np.nan
    sent = gone.copy()
    sent[120] = [np.inf, -np.inf]
    streams = Streams(tmp_path, said, safety=Safety(largest=5.0))
    got = []
    with streams.running():
        for k, row in enumerate(sent):
            if 50 <= k < 53:
                streams.source._count[0] += np.uint64(1) if k > 50 else np.uint64(0)
                continue
            if k == 53:
                streams.source._count[0] += np.uint64(1)
            got.append(streams.answer(row))
    expected = np.delete(stepped(gone, "kf-lgs", 1), [50, 51, 52], axis=0)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert streams.attachment.summary()["missing"] == 3 and not said


def test_a_stream_that_stops_and_comes_back(tmp_path: Path) -> None:
    """The output is zero as soon as it is stuck, is told once, and follows the new file that a program makes anew."""
    said: list[str] = []
    streams = Streams(tmp_path, said, stuck=0.05, safety=Safety(calm=20))
    z = measurements(300)
    with streams.running():
        first = streams.answer(z[0])
        assert first.any() or streams.answer(z[1]).any()
        before = streams.sink.count
        while streams.next(before).any():
            before = streams.sink.count
        assert any("no frame for" in line for line in said)
        streams.source = SharedImage.create(tmp_path / "in.im.shm", (2,), dtype="float64")
        wait_until(lambda: "the stream was made anew" in said)
        streams.attachment._wiring = replace(streams.attachment._wiring, stuck=ENOUGH)
        answers = [streams.answer(row) for row in z]
    assert not np.any(answers[:19]) and np.any(answers[25])
    assert not streams.next(streams.sink.count - 1).any()


def test_garbage_gives_no_stale_and_no_wild_output(tmp_path: Path) -> None:
    said: list[str] = []
    streams = Streams(tmp_path, said, safety=Safety(largest=5.0, calm=50))
    z = measurements(100)
    with streams.running():
        for row in z[:50]:
            streams.answer(row)
        wild = [streams.answer(np.array([1e12, -1e12])) for _ in range(RUN)]
        assert np.abs(wild).max() < 2.0 * np.abs(z).max() and not np.any(wild[-1])
        torn = streams.sink.count
        streams.source._writing[0] = 1
        streams.source._count[0] += np.uint64(1)
        assert not streams.next(torn).any()
        streams.source._writing[0] = 0
    assert said[0].startswith("5 measurements in a row are outliers") and streams.attachment.tally.torn == 1


class Frames:
    """A stream in memory: frames that the test gives, or those that have been written."""

    path, first, is_current, write_time = "memory", 0, True, 0

    def __init__(self, n: int, dtype: str = "float64"):
        self.count, self.values = 0, np.zeros(n, dtype)

    @property
    def n(self) -> int:
        return self.values.size

    def read(self, patience: float = 0.0) -> tuple[int, np.ndarray] | None:
        return self.count, self.values.astype(float)

    def write(self, values: np.ndarray, elements: np.ndarray | slice = slice(None)) -> None:
        self.values[elements] = values
        self.count += 1


class Way:
    """The whole way of a frame, without a thread: `send` gives what goes out."""

    def __init__(self, observer: StepObserver, safety: Safety, dtype: str = "float64", ngs: bool = False):
        observer.reset()
        self.said: list[str] = []
        self.source, self.sink, self.ngs = Frames(2), Frames(2, dtype), Frames(2)
        wiring = Wiring((0, 1), 1.0, 1.0, np.full(2, 0.5), safety, 0, ENOUGH, gate=GateSettings())
        second = NgsStream(self.ngs, NgsWiring((0, 1), 1.0, 5, 0, ENOUGH), self.said.append) if ngs else None  # pyright: ignore[reportArgumentType]
        self.attachment = Attachment(self.source, self.sink, observer, wiring, self.said.append, second)  # pyright: ignore[reportArgumentType]

    def send(self, z: np.ndarray, lost: int = 0) -> np.ndarray:
        self.source.count += lost
        self.source.write(z)
        self.attachment._take(0.0)
        return self.sink.values.copy()


OBSERVED = {name: design(name, wfsobs.PRESETS["paper"]()) for name in ("kf-lgs", "multirate-multi")}
QUIET = wfsobs.simulate(wfsobs.PRESETS["paper"]().replace({"run.duration": 3.0}))
ANY = st.floats(allow_nan=True, allow_infinity=True, width=64)


@pytest.mark.parametrize("fallback", ["zero", "hold"])
@pytest.mark.parametrize("size", [2.0, 20.0, 1e30])
def test_one_frame_that_cannot_be_changes_nothing_that_goes_out(fallback: Fallback, size: float) -> None:
    """It is missing: what goes out is what the observer gives without it, to the last digit."""
    way = Way(OBSERVED["kf-lgs"], Safety(fallback))
    z = QUIET.z[:1200].copy()
    z[1000] += size
    got = [way.send(row) for row in z]
    z[1000] = np.nan
    np.testing.assert_array_equal(got, stepped(z, "kf-lgs", 1))
    summary = way.attachment.summary()
    assert summary["out_of_band"] == 1 and summary["outliers"] == [1, 1] and summary["fallbacks"] == 0 and not way.said


@pytest.mark.parametrize("fallback", ["zero", "hold"])
def test_a_level_that_moves_for_good_is_followed(fallback: Fallback) -> None:
    """Four measurements are refused, then the output falls back to what was before, and comes back at the new level."""
    way = Way(OBSERVED["kf-lgs"], Safety(fallback, calm=300))
    z = QUIET.z[:2500].copy()
    z[1000:] += 2.0
    got = np.array([way.send(row) for row in z])
    before = got[999] if fallback == "hold" else np.zeros(2)
    np.testing.assert_array_equal(got[1004:1304], np.tile(before, (300, 1)))
    assert RUN <= way.attachment.summary()["out_of_band"] < 3 * RUN
    assert way.said[1:] == ["output on again after 300 good frames"]
    assert np.abs(got[-500:] - z[-500:]).max() < 0.3  # the vibration and the noise of a frame


@pytest.mark.parametrize("delay", [2.0, 1.5])
def test_commands_beside_residuals_give_the_pseudo_open_loop(delay: float) -> None:
    """As z itself, once the place of the commands is known; other counters, a command that comes early, and one that is lost."""
    rng = np.random.default_rng(1)
    z, u = QUIET.z[:400], 0.2 * rng.standard_normal((400, 2)).cumsum(axis=0) / 10.0
    whole, part = int(delay), delay % 1.0
    m = np.zeros_like(u)
    for k in range(3, len(u)):
        m[k] = (1.0 - part) * u[k - whole] + part * u[k - whole - 1]
    y, way, stream = z + m, Way(OBSERVED["kf-lgs"], Safety()), Frames(2)
    stream.count = stream.first = 700
    commands = CommandStream(stream, (0, 1), np.array(1.0), delay)  # pyright: ignore[reportArgumentType]
    way.attachment._commands = commands
    got, lost = [], 300
    for k, row in enumerate(y):
        if k == 100:  # before its measurement is taken
            stream.write(u[k])
        got.append(way.send(row))
        for row in (u[lost], u[k]) if k == lost + 1 else () if k in (lost, 100) else (u[k],):
            stream.write(row)
    seen = z.copy()
    seen[:9] = np.nan
    hidden = [k for k in range(9, len(z)) if {k - whole, k - whole - 1 * (part > 0)} & {lost, 99}]
    seen[hidden] = np.nan
    np.testing.assert_allclose(got, stepped(seen, "kf-lgs", 1), rtol=0, atol=1e-9)
    assert commands.missing == len(hidden) == way.attachment.summary()["commands_missing"]


@pytest.mark.parametrize("left_out", [[50], [50, 51, 52]])
@pytest.mark.parametrize("delay", [2.0, 1.5])
def test_commands_that_a_loop_leaves_out_do_not_shift_those_after_them(delay: float, left_out: list[int]) -> None:
    """Their counter says nothing of that; nine commands later, at most, each is that of its measurement again."""
    u, y = np.random.default_rng(1).standard_normal((2, 100, 2)).cumsum(axis=1)
    stream, whole, part = Frames(2), int(delay), delay % 1.0
    commands, got = CommandStream(stream, (0, 1), np.array(1.0), delay), []  # pyright: ignore[reportArgumentType]
    for k, row in enumerate(u):
        got.append(commands.open_loop(k, y[k]))
        if k not in left_out:
            stream.write(row)
    again = np.arange(left_out[-1] + 9 + whole + 1, 100)
    for k in (np.arange(13, 50), again):
        np.testing.assert_allclose(np.array(got)[k], y[k] - (1.0 - part) * u[k - whole] - part * u[k - whole - 1], atol=1e-12)


def test_measurements_that_are_never_there_are_frames_that_are_missing() -> None:
    way = Way(OBSERVED["kf-lgs"], Safety("zero"))
    got = np.array([way.send(row) for row in [*QUIET.z[:500], *np.full((11, 2), np.nan)]])
    assert got[509].any() and not got[510].any()
    assert way.said == ["11 frames in a row are missing: output falls back to zero"]


def test_a_frame_after_a_gap_is_held_against_what_is_expected_there() -> None:
    way = Way(OBSERVED["kf-lgs"], Safety())
    for row in QUIET.z[:1000]:
        way.send(row)
    way.send(QUIET.z[1003] + 2.0, lost=3)
    assert way.attachment.summary()["out_of_band"] == 1


def test_one_frame_of_the_ngs_that_cannot_be_is_missing() -> None:
    out = []
    for bad in (np.nan, 20.0, 1e300):
        way, got = Way(OBSERVED["multirate-multi"], Safety(calm=1), ngs=True), []
        for k in range(1, 1000):
            if k % 5 == 0:
                way.ngs.write(QUIET.z_ngs[k] if k != 800 else np.full(2, bad))
            got.append(way.send(QUIET.z[k]))
        out.append(got)
        assert way.attachment.summary()["fallbacks"] == 1  # the NGS frames have found their place
    np.testing.assert_array_equal(out[0], out[1])
    np.testing.assert_array_equal(out[0], out[2])


@cache
def on_the_way(fallback: Fallback, largest: float | None, ngs: bool) -> tuple[Way, list[np.ndarray]]:
    """A way on which 105 frames as they should be have gone, and what went out."""
    way, sent = Way(OBSERVED["multirate-multi" if ngs else "kf-lgs"], Safety(fallback, largest, calm=3), "float32", ngs), []
    for k in range(105):
        if k % 5 == 0:
            way.ngs.write(QUIET.z_ngs[k or 5])
        sent.append(way.send(QUIET.z[k]))
    return way, sent


@given(
    frames=st.lists(st.tuples(st.tuples(ANY, ANY), st.integers(0, 12), st.integers(0, 7)), min_size=1, max_size=12),
    fallback=st.sampled_from(["zero", "hold"]),
    largest=st.sampled_from([None, 0.3, 40.0]),
    ngs=st.booleans(),
)
@settings(max_examples=150, deadline=None)
def test_nothing_above_the_limit_goes_out_whatever_comes_in(frames, fallback: Fallback, largest: float | None, ngs: bool) -> None:
    """Any doubles in both streams, gaps of any length, as often as wanted in a row, between frames as they should be."""
    way, before = deepcopy(on_the_way(fallback, largest, ngs))
    limit, sent = 5.0 if largest is None else largest, [*before]
    for k, (values, lost, times) in enumerate(frames):
        for i in range(times):
            way.ngs.write(np.array(values[::-1]))
            sent.append(way.send(np.array(values), lost if i == 0 else 0))
        sent += [way.send(QUIET.z[(105 + 7 * k + i) % 2900]) for i in range(4)]
    assert (np.abs(sent) <= np.float32(limit)).all()
    assert (np.abs(way.attachment._watchdog.safe) <= limit).all()
    json.dumps(way.attachment.summary(), allow_nan=False)
    way.attachment._line()


def test_shadow_writes_nothing(tmp_path: Path) -> None:
    source = SharedImage.create(tmp_path / "in.im.shm", (2,))
    done = CliRunner().invoke(
        main, ["attach", "--in", source.path, "--shadow", "--observer", "kf-lgs", "--seconds", "0.3", "--stuck", "0.05", "--json"]
    )
    assert done.exit_code == 0, done.output
    assert [path.name for path in tmp_path.iterdir()] == ["in.im.shm"]
    summary = json.loads(done.output.strip().splitlines()[-1])
    assert summary["frames"] == 0 and summary["stuck"] == 1 and source.count == 0


def test_a_semaphore_that_another_process_waits_for_is_left_to_it(tmp_path: Path) -> None:
    source = SharedImage.create(tmp_path / "in.im.shm", (2,))
    assert source._readers is not None
    source._readers[:4] = 1  # a process of long standing
    options = ["--shadow", "--observer", "kf-lgs", "--semaphore", "3", "--seconds", "0.1"]
    done = CliRunner().invoke(main, ["attach", "--in", source.path, *options])
    assert done.exit_code == 0, done.output
    assert f"{source.path}: another process waits for semaphore 3; taking 4\n" in done.stderr
    assert source._readers.tolist() == [1] * 4 + [0] * 6, "it is given back"


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ([], "takes --out STREAM, or --shadow"),
        (["--out", "OUT", "--modes", "0,5"], "mode 5: a frame has 2 numbers, 0 to 1"),
        (["--out", "OUT", "--observer", "ridge"], "learns from a record beforehand"),
        (["--out", "OUT", "--controller", "lqg-kf-multi", "--command-gain", "0"], "the mirror does nothing"),
        (["--out", "OUT", "--semaphore", "10"], "it has 0 to 9"),
        (["--out", "IN"], "is a stream that is read"),
        (["--shadow", "--modes", "0,0"], "different whole numbers"),
        (["--shadow", "--modes", "0,5"], "mode 5: a frame has 2 numbers, 0 to 1"),
        (["--shadow", "--modes", "0,1,2"], "the prior has 2 modes"),
        (["--shadow", "--observer", "kf"], "no such observer"),
        (["--shadow", "--observer", "multirate"], "takes an NGS"),
        (["--shadow", "--observer", "gpr-offline"], "learns from a record beforehand"),
        (["--shadow", "--observer", "gpr-online"], "its windows hold commands"),
        (["--shadow", "--delay", "1.5", "--observer", "ridge"], "learns from a record beforehand"),
        (["--shadow", "--semaphore", "10"], "it has 0 to 9"),
    ],
)
def test_what_cannot_be_attached_is_said_in_one_line(tmp_path: Path, options: list[str], reason: str) -> None:
    source = SharedImage.create(tmp_path / "in.im.shm", (2,))
    places = {"IN": source.path, "OUT": str(tmp_path / "out.im.shm")}
    options = [places.get(option, option) for option in options]
    done = CliRunner().invoke(main, ["attach", "--in", source.path, "--seconds", "0.1", *options])
    assert done.exit_code == 2 and reason in done.output and done.output.count("\n") == 1, done.output
    assert [path.name for path in tmp_path.iterdir()] == ["in.im.shm"], "no stream is made"


def test_no_stream_is_said_in_one_line(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["attach", "--in", str(tmp_path / "none.im.shm"), "--shadow"])
    assert done.exit_code == 2 and "no stream: No such file or directory" in done.output and done.output.count("\n") == 1
