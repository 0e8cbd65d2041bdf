"""Two streams, LGS and NGS: the numbers of the run over the record, and the LGS alone where the NGS is not what it should be."""

import json
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import wfsobs
from tests.patience import ENOUGH
from tests.streams.conftest import LONGEST, started
from wfsobs.cli import main
from wfsobs.stepping import design
from wfsobs.streams.attach import Attachment
from wfsobs.streams.shared_image import SharedImage
from wfsobs.streams.wiring import SEARCH, NgsStream, NgsWiring, Safety, Wiring

pytestmark = pytest.mark.slow

RATIO = 5
FIRST = 2
"""Row of the record that is sent first, so that the NGS frames have another place than they have in a record from there on."""
FOUND = RATIO * SEARCH
"""Row of the NGS frame from which their place is known."""


@pytest.fixture(scope="module")
def record() -> wfsobs.Record:
    return wfsobs.simulate(wfsobs.PRESETS["paper"]().replace({"run.duration": 1.6}))


def over_the_record(record: wfsobs.Record, name: str, first: int, n_unknown: int = 0, lost: tuple[int, ...] = ()) -> np.ndarray:
    """What `wfsobs observe` has from a row on, (n - first, 2) [um]: the record begins there, the first measurements unknown."""
    z, ngs = record.z[first:].copy(), record.z_ngs[first:].copy()
    z[:n_unknown], ngs[0], ngs[np.array(lost, dtype=int) - first] = np.nan, np.nan, np.nan
    part = wfsobs.Record(z, np.zeros_like(z), record.dt, y_ngs=ngs, ratio=RATIO)
    estimates = wfsobs.observe(part, wfsobs.PRESETS["paper"](), observers=[name]).estimates
    return np.sum([one.values for one in estimates], axis=0)


class Loop:
    """Two streams and an observer of both that is called frame by frame."""

    def __init__(self, folder: Path, name: str, lag: int = 0, stuck: float = ENOUGH):
        self.lgs = SharedImage.create(folder / "lgs.im.shm", (2,), dtype="float64")
        self.ngs = SharedImage.create(folder / "ngs.im.shm", (3,), dtype="float64")
        self.sink = SharedImage.create(folder / "out.im.shm", (2,), dtype="float64")
        self.said: list[str] = []
        wiring = Wiring((0, 1), 1.0, 1.0, np.full(2, 0.5), Safety(calm=1), 0, ENOUGH)
        ngs_wiring = NgsWiring((2, 0), 1.0, RATIO, lag, stuck)
        ngs = NgsStream(
            SharedImage(self.ngs.path), ngs_wiring, lambda line: self.said.append(line.removeprefix(self.ngs.path + ": "))
        )
        observer = design(name, wfsobs.PRESETS["paper"]())
        self.attachment = Attachment(SharedImage(self.lgs.path), self.sink, observer, wiring, self.said.append, ngs)

    def send_ngs(self, values: np.ndarray) -> None:
        self.ngs.write(np.array([values[1], 7.0, values[0]]))

    def send(self, z: np.ndarray) -> np.ndarray:
        self.lgs.write(z)
        self.attachment._take(time.monotonic())
        found = self.sink.read()
        assert found is not None
        return found[1]

    def run(self, record: wfsobs.Record, arrival: Callable[[int], int | None], rows: range) -> np.ndarray:
        """Send rows of a record; the NGS frame of the row k is there before the LGS frame of the row `arrival(k)`."""
        due: dict[int, list[int]] = {}
        for k in rows[::1]:
            if k % RATIO == 0 and k and (row := arrival(k)) is not None:
                due.setdefault(row, []).append(k)
        out = []
        for row in rows:
            for k in due.get(row, ()):
                self.send_ngs(record.z_ngs[k])
            out.append(self.send(record.z[row]))
        return np.array(out)


def close_to(expected: np.ndarray) -> float:
    """Step and batch are one algorithm: 1e-12 of the size, 1e-9 with a Gaussian process regression."""
    return 1e-9 * float(np.std(expected))


@pytest.mark.parametrize("name", ["multirate-multi", "multirate-optimal", "multirate", "gp-both"])
def test_frames_in_time_give_the_run_over_the_record(tmp_path: Path, record: wfsobs.Record, name: str) -> None:
    loop = Loop(tmp_path, name)
    got = loop.run(record, lambda k: k, range(FIRST, record.n_steps))
    expected = over_the_record(record, name, FOUND)
    np.testing.assert_allclose(got[FOUND - FIRST :], expected, rtol=0, atol=close_to(expected))
    # before their place is known the NGS frames are missing
    before = alone(record, name, FIRST)[: FOUND - FIRST]
    np.testing.assert_allclose(got[: FOUND - FIRST], before, rtol=0, atol=close_to(before))
    assert loop.said == [
        f"one frame in {RATIO} of the LGS",
        "the NGS frames have found their place: output falls back to zero",
        "output on again after 1 good frames",
    ]
    summary = loop.attachment.summary()
    assert summary["ngs_frames"] == (record.n_steps - 1) // RATIO and summary["ngs_missing"] == summary["ngs_late"] == 0


@pytest.mark.parametrize("lag", [1, 3])
def test_a_late_frame_goes_to_its_place(tmp_path: Path, record: wfsobs.Record, lag: int) -> None:
    """From its arrival on all is as if it had been in time, before that as if it were missing; some are one frame later still."""
    name, rng = "multirate-multi", np.random.default_rng(4)
    jitter = {k: int(rng.integers(0, 2)) for k in range(RATIO, record.n_steps, RATIO)}
    loop = Loop(tmp_path, name, lag)
    got = loop.run(record, lambda k: k + lag + jitter[k], range(FIRST, record.n_steps))
    start = FOUND + lag + jitter[FOUND]
    expected = over_the_record(record, name, FOUND, n_unknown=start - FOUND)
    rows = np.arange(start, record.n_steps)
    k = rows // RATIO * RATIO
    is_there = rows >= k + lag + np.array([jitter[int(i)] for i in k])
    assert 0.2 < is_there.mean() < 0.8
    there = rows[is_there]
    np.testing.assert_allclose(got[there - FIRST], expected[there - FOUND], rtol=0, atol=close_to(expected))
    one = RATIO * 200
    without = over_the_record(record, name, FOUND, n_unknown=start - FOUND, lost=(one,))
    before = np.arange(one, one + lag + jitter[one])
    np.testing.assert_allclose(got[before - FIRST], without[before - FOUND], rtol=0, atol=close_to(expected))
    assert np.abs(expected - without)[before - FOUND].max() > 1e3 * close_to(expected), "the frame matters"
    summary = loop.attachment.summary()
    known = [k for k in jitter if k >= FOUND and k + lag + jitter[k] < record.n_steps]
    assert summary["ngs_late"] == sum(jitter[k] for k in known) and summary["ngs_missing"] == 0


def test_frames_that_are_missing_too_late_torn_or_not_finite(tmp_path: Path, record: wfsobs.Record) -> None:
    name, n = "multirate-optimal", 1000
    loop = Loop(tmp_path, name)
    loop.run(record, lambda k: k, range(FIRST, 500))
    got = []
    for row in range(500, n):
        if row == 705:  # two at once: nobody sees the one of row 700
            loop.send_ngs(record.z_ngs[700])
        if row == 600:
            loop.send_ngs(np.array([np.nan, np.inf]))
        elif row % RATIO == 0 and row != 700:
            loop.send_ngs(record.z_ngs[row])
        loop.ngs._writing[0] = row == 800
        got.append(loop.send(record.z[row]))
    expected = over_the_record(record, name, FOUND, lost=(600, 700))[500 - FOUND : n - FOUND]
    torn = 800 - 500  # there one frame later
    same = np.arange(n - 500) != torn
    np.testing.assert_allclose(np.array(got)[same], expected[same], rtol=0, atol=close_to(expected))
    summary = loop.attachment.summary()
    assert len(loop.said) == 3 and summary["ngs_late"] == summary["ngs_missing"] == 1


def alone(record: wfsobs.Record, name: str, first: int) -> np.ndarray:
    """What is expected of the LGS alone from a row on."""
    return over_the_record(record, name, first, lost=tuple(range(first, record.n_steps)))


def test_another_rate_is_told_once_and_the_lgs_go_on_alone(tmp_path: Path, record: wfsobs.Record) -> None:
    """A frame in six, of the numbers of a frame in five."""
    loop, got = Loop(tmp_path, "multirate-multi"), []
    for row in range(record.n_steps):
        if row % 6 == 0:
            loop.send_ngs(record.z_ngs[5])
        got.append(loop.send(record.z[row]))
    expected = alone(record, "multirate-multi", 0)
    np.testing.assert_allclose(got, expected, rtol=0, atol=close_to(expected))
    assert loop.said == [f"one frame in 6.0 of the LGS, the observer is designed for {RATIO}: on with the LGS alone"]


def test_a_stream_that_stops_and_is_made_anew(tmp_path: Path, record: wfsobs.Record) -> None:
    """The LGS alone until the new frames have their place, two rows later than before; then as over the record from there."""
    name, stopped, again = "multirate-multi", 400, 600
    loop = Loop(tmp_path, name, stuck=0.01)
    got = loop.run(record, lambda k: k, range(FIRST, stopped))
    del loop.said[:]
    time.sleep(0.02)
    got = [loop.send(record.z[row]) for row in range(stopped, again)]
    lost = tuple(range(stopped, again, RATIO))
    expected = over_the_record(record, name, FOUND, lost=lost)[stopped - FOUND : again - FOUND]
    np.testing.assert_allclose(got, expected, rtol=0, atol=close_to(expected))
    assert loop.said == ["no frame for 0.01 s: on with the LGS alone"]
    loop.ngs = SharedImage.create(loop.ngs.path, (3,), dtype="float64")
    time.sleep(0.02)
    # the rows are moved against the frames by two: what follows is a record of its own
    moved = [*range(again + 2, record.n_steps)]
    due = [row for row in moved if row % RATIO == 0]
    got = []
    loop.send(record.z[again])
    assert loop.said[1:] == ["made anew: on with the LGS alone until their place is found"]
    ngs = loop.attachment._ngs
    assert ngs is not None
    ngs._wiring = replace(ngs._wiring, stuck=ENOUGH)
    for row in moved:
        if row % RATIO == 0:
            loop.send_ngs(record.z_ngs[row])
        got.append(loop.send(record.z[row]))
    start = due[SEARCH - 1]
    expected = over_the_record(record, name, start)
    np.testing.assert_allclose(got[start - moved[0] :], expected, rtol=0, atol=close_to(expected))
    assert loop.said[2:] == [
        "frames again",
        f"one frame in {RATIO} of the LGS",
        "the NGS frames have found their place: output falls back to zero",
        "output on again after 1 good frames",
    ]


def test_a_frame_that_came_after_the_lgs_frame_waits_for_the_next(tmp_path: Path, record: wfsobs.Record) -> None:
    """An observer that is late to look: the NGS frame of the next LGS frame is there already. It is neither early nor lost."""
    name, n = "multirate-multi", 900
    loop, got = Loop(tmp_path, name), []
    for row in range(FIRST, n):
        is_late = row % RATIO == RATIO - 1 and row > 20
        if row % RATIO == 0 and not (row - 1) > 20:
            loop.send_ngs(record.z_ngs[row])
        loop.lgs.write(record.z[row])
        if is_late and row + 1 < n:
            loop.send_ngs(record.z_ngs[row + 1])
        loop.attachment._take(time.monotonic())
        found = loop.sink.read()
        assert found is not None
        got.append(found[1])
    expected = over_the_record(record, name, FOUND)[: n - FOUND]
    np.testing.assert_allclose(got[FOUND - FIRST :], expected, rtol=0, atol=close_to(expected))
    assert len(loop.said) == 3 and loop.attachment.summary()["ngs_late"] == 0


def test_an_early_frame_and_a_counter_that_jumps_have_the_place_looked_for_anew(tmp_path: Path, record: wfsobs.Record) -> None:
    loop = Loop(tmp_path, "multirate-optimal")
    loop.run(record, lambda k: k, range(FIRST, 301))
    del loop.said[:]
    for row in (301, 302, 303):
        loop.send(record.z[row])
    loop.send_ngs(record.z_ngs[305])
    loop.send(record.z[304])  # written after the NGS frame
    loop.ngs._count[0] += np.uint64(10**6)
    loop.send(record.z[305])
    assert loop.said == ["a frame is 1 LGS frames early: on with the LGS alone until their place is found"]
    for row in range(306, 306 + 3 * RATIO * SEARCH):
        if row % RATIO == 0:
            loop.send_ngs(record.z_ngs[row])
        loop.send(record.z[row])
    assert loop.said[1:] == [f"one frame in {RATIO} of the LGS", *loop.said[2:]] and len(loop.said) in (2, 4)
    loop.ngs._count[0] += np.uint64(10**6)
    loop.send(record.z[-1])
    assert loop.said[-1] == "the counter has jumped: on with the LGS alone until their place is found"


def test_the_command_gives_the_run_over_the_record(tmp_path: Path, record: wfsobs.Record) -> None:
    """`wfsobs attach` in a process of its own, in step with two streams that are sent from here, in nm, other elements first."""
    lgs = SharedImage.create(tmp_path / "lgs.im.shm", (2,))
    ngs = SharedImage.create(tmp_path / "ngs.im.shm", (3,))
    sink = SharedImage.create(tmp_path / "out.im.shm", (2,))
    more = ["--preset", "paper", "--set", "run.warm_up=0.001", "--observer", "multirate-multi", "--unit", "nm", "--json"]
    streams = ["--in", lgs.path, "--ngs", ngs.path, "--ngs-modes", "2,0", "--out", sink.path]
    got = []
    with started(sys.executable, "-m", "wfsobs", "attach", *streams, *more, "--stuck", LONGEST) as ours:
        assert ours.stderr is not None
        assert ours.stderr.readline(), "its first report: it waits for frames"
        for row in range(FIRST, 800):
            if row % RATIO == 0:
                ngs.write(1e3 * np.array([record.z_ngs[row, 1], 7.0, record.z_ngs[row, 0]]))
            before = sink.count
            lgs.write(1e3 * record.z[row])
            assert sink.wait(before, ENOUGH)
            found = sink.read()
            assert found is not None
            got.append(found[1])
        ours.send_signal(signal.SIGTERM)
        out, err = ours.communicate(timeout=ENOUGH)
    assert ours.returncode == 0, err
    expected = 1e3 * over_the_record(record, "multirate-multi", FOUND)[: 800 - FOUND]
    # rounding of float32 in the measurements, three times over
    np.testing.assert_allclose(got[FOUND - FIRST :], expected, rtol=0, atol=2e-7 * np.abs(expected).max())
    summary = json.loads(out)
    assert summary["ngs_frames"] == 159 and summary["missing"] == summary["ngs_missing"] == summary["ngs_late"] == 0


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--observer", "kf-multi", "--ngs", "NGS"], "kf-multi: takes no NGS; leave --ngs out"),
        (["--observer", "multirate-multi"], "multirate-multi: takes an NGS; name its stream by --ngs"),
        (["--observer", "multirate-multi", "--ngs", "NGS", "--ngs-lag", "5"], "--ngs-lag 5: takes 0 to 4"),
        (["--observer", "multirate-multi", "--ngs", "NGS", "--ngs-modes", "1"], "takes 2 elements, one for each mode of the LGS"),
        (["--observer", "multirate-multi", "--ngs", "NGS", "--ngs-modes", "0,9"], "mode 9: a frame has 2 numbers"),
        (["--observer", "multirate-multi", "--ngs", "NGS", "--modes", "0", "--ngs-modes", "0,1"], "the prior has 1 modes"),
    ],
)
def test_what_cannot_be_attached_is_said_in_one_line(tmp_path: Path, options: list[str], reason: str) -> None:
    lgs, ngs = (SharedImage.create(tmp_path / name, (2,)) for name in ("lgs.im.shm", "ngs.im.shm"))
    options = [ngs.path if option == "NGS" else option for option in options]
    done = CliRunner().invoke(main, ["attach", "--in", lgs.path, "--shadow", "--seconds", "0.1", *options])
    assert done.exit_code == 2 and reason in done.output and done.output.count("\n") == 1, done.output
