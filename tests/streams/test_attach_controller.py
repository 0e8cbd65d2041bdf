"""A controller on streams: commands of the supervised controller in the same loop, and the last one whatever the stream does."""

import json
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import ArrayLike

import wfsobs
from tests.patience import ENOUGH
from tests.streams.conftest import LONGEST, started, wait_until
from wfsobs.cli import main
from wfsobs.control.supervisor import SupervisedController, Supervision
from wfsobs.control.true_plant import ActingPlant, TruePlant, drive
from wfsobs.record import Measurements, Sampling
from wfsobs.streams.attach import ControllerAttachment
from wfsobs.streams.shared_image import SharedImage
from wfsobs.streams.wiring import NgsStream, NgsWiring, Wiring

pytestmark = pytest.mark.slow

PAPER = wfsobs.PRESETS["paper"]().replace({"run.duration": 2.5})
MEASURED = wfsobs.simulate(PAPER).measurements()
CALM = 500
NAME = "lqg-kf-multi"


def supervised(stroke: float = 0.0) -> SupervisedController:
    scenario = PAPER.replace({"control.stroke": stroke})
    return SupervisedController(wfsobs.design(NAME, scenario, sampling=Sampling(2, PAPER.dt)), Supervision(0.3, calm=CALM))


class Frames:
    """A stream in memory: frames that the test gives, or those that have been written."""

    path, first, is_current, write_time = "memory", 0, True, 0
    newer = 0  # frames that have come after the one that is read

    def __init__(self, n: int):
        self.count, self.values = 0, np.zeros(n)

    @property
    def n(self) -> int:
        return self.values.size

    def read(self, patience: float = 0.0) -> tuple[int, np.ndarray] | None:
        return self.count - self.newer, self.values.copy()

    def write(self, values: np.ndarray, elements: np.ndarray | slice = slice(None)) -> None:
        self.values[elements] = values
        self.count += 1


class Loop:
    """A loop that is closed through streams in memory, a frame of three numbers, ours the last two; nm, a gain of -2."""

    unit, gain = 1e-3, -2.0

    def __init__(
        self, controller: SupervisedController, plant: TruePlant, start: ArrayLike = (0.0, 0.0), ngs: NgsStream | None = None
    ):
        start = np.asarray(start)
        self.said: list[str] = []
        self.source, self.sink, self.acting = Frames(3), Frames(3), ActingPlant(plant)
        self.correction = np.zeros(2)
        for _ in range(5):
            self.correction = self.acting.take(start)
        wiring = Wiring((1, 2), self.unit, 1.0, np.full(2, 0.5), stuck=ENOUGH)
        source: Any = self.source
        sink: Any = self.sink
        there = start / (self.unit * self.gain)
        self.attachment = ControllerAttachment(source, sink, controller, self.gain, there, wiring, self.said.append, ngs)

    def take(self, z: np.ndarray, seen: np.ndarray | None = None, lost: bool = False) -> np.ndarray:
        """Go on by a frame; a lost one is counted but never there. Returns the command that the mirror then has [um]."""
        y = z + self.correction
        if lost:
            self.source.count += 1
        else:
            self.source.write(np.append(7.0, (y if seen is None else seen) / self.unit))
            self.attachment._take(0.0)
        u = self.sink.values[1:] * self.unit * self.gain
        self.correction = self.acting.take(u)
        return u


def test_the_commands_are_those_of_the_same_loop_without_streams() -> None:
    """Unit, sign and place of the modes aside; the other number of a frame is not touched."""
    plant = TruePlant(np.array([[1.1, 0.1], [-0.1, 1.0]]), 2.3)
    loop = Loop(supervised(), plant)
    got = np.array([loop.take(row) for row in MEASURED.z])
    z = np.vstack([np.full((3, 2), np.nan), MEASURED.z])  # three frames without a measurement: the mirror is at rest
    expected, _ = drive(supervised(), Measurements(z, np.zeros_like(z), MEASURED.dt), plant, np.random.default_rng(0))
    np.testing.assert_allclose(got, expected[3:], rtol=0, atol=1e-9)  # rounding of unit and gain, in a stable loop
    assert loop.sink.values[0] == 0.0 and loop.sink.count == len(got)
    assert loop.said == ["the controller closes the loop"]
    summary = loop.attachment.summary()
    assert summary["output"] == "on" and summary["alarms"] == []
    assert summary["next_median_nm"] < 0.2 * summary["median_nm"], "the residual, of the disturbance"


def test_a_command_that_a_newer_frame_has_overtaken_is_not_sent() -> None:
    """Of two such in a row one goes out; the controller goes on from what was sent."""
    plant, overtaken = TruePlant(np.eye(2), 2.0), {1500, 1700, 1701}
    loop, own, acting, correction, u = Loop(supervised(), plant), supervised(), ActingPlant(plant), np.zeros(2), np.zeros(2)
    for _ in range(3):  # as at rest
        own.update(np.full(2, np.nan))
    for k, row in enumerate(MEASURED.z):
        loop.source.newer = int(k in overtaken)
        loop.source.count += loop.source.newer
        got = loop.take(row)
        loop.source.count -= loop.source.newer
        command = own.update(row + correction)
        u = u if k in (1500, 1700) else command
        own.amend(u)
        np.testing.assert_allclose(got, u, rtol=0, atol=1e-9)
        correction = acting.take(u)
    assert loop.sink.count == len(MEASURED.z) - 2


def test_missing_frames_are_those_in_which_the_command_stays() -> None:
    """As the controller itself, told what was sent in place of its own commands."""
    plant, lost = TruePlant(np.eye(2), 2.0), {1500, 1501, 1502, 2000}
    loop = Loop(supervised(), plant)
    got = np.array([loop.take(row, lost=k in lost) for k, row in enumerate(MEASURED.z)])
    own, acting, correction, u = supervised(), ActingPlant(plant), np.zeros(2), np.zeros(2)
    for _ in range(3):  # as at rest
        own.update(np.full(2, np.nan))
    for k, row in enumerate(MEASURED.z):
        if k in lost:
            own.update(np.full(2, np.nan))
            own.amend(u)
        else:
            u = own.update(row + correction)
        np.testing.assert_allclose(got[k], u, rtol=0, atol=1e-9)
        correction = acting.take(u)
    assert loop.attachment.summary()["missing"] == len(lost)


def test_a_mirror_that_another_loop_has_moved_is_taken_over_without_a_bump() -> None:
    """The first command is the old one, less the integrator's share of the first residual."""
    start = np.array([0.4, -0.3])
    z = MEASURED.z - start
    loop = Loop(supervised(), TruePlant(np.eye(2), 2.0), start)
    first = loop.take(z[0])
    np.testing.assert_allclose(first, start - 0.3 * MEASURED.z[0], rtol=0, atol=1e-12)
    residual = np.array([z[k] + loop.correction for k in range(1, len(z)) if loop.take(z[k]) is not None])
    assert residual[2 * CALM :].std(axis=0).max() < 0.2 * z.std(axis=0).min()


def commands_with(bad: float) -> np.ndarray:
    """The commands of a loop that measures this in two frames, before and after the controller has taken over."""
    loop = Loop(supervised(), TruePlant(np.eye(2), 2.0))
    return np.array([loop.take(row, np.full(2, bad) if k in (400, 1100) else None) for k, row in enumerate(MEASURED.z[:1300])])


@pytest.fixture(scope="module")
def of_missing_ones() -> np.ndarray:
    return commands_with(np.nan)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30, -40.0])
def test_a_measurement_that_cannot_be_is_missing(bad: float, of_missing_ones: np.ndarray) -> None:
    np.testing.assert_array_equal(commands_with(bad), of_missing_ones)


def test_a_mirror_that_turns_the_other_way_leaves_the_loop_to_the_integrator_and_within_its_limits() -> None:
    loop = Loop(supervised(stroke=1.5), TruePlant(np.eye(2), 2.0))
    for row in MEASURED.z[:1500]:
        loop.take(row)
    loop.acting = ActingPlant(TruePlant(-np.eye(2), 2.0))
    got = np.array([loop.take(row) for row in MEASURED.z[1500:2500]])
    assert np.abs(got).max() <= 1.5 + 1e-12
    assert loop.said[1].endswith(": an integrator closes the loop") and loop.attachment.summary()["alarms"]


def test_a_counter_that_jumps_begins_anew_where_the_mirror_is() -> None:
    loop = Loop(supervised(), TruePlant(np.eye(2), 2.0))
    for row in MEASURED.z[:1500]:
        u = loop.take(row)
    loop.source.count = 10
    y = MEASURED.z[1500] + loop.correction
    np.testing.assert_allclose(loop.take(MEASURED.z[1500]), u - 0.3 * y, rtol=0, atol=1e-12)
    assert loop.said[-2:] == ["the counter went from 1500 to 11", "the counter went from 1500 to 11: on from the last command"]


@pytest.mark.parametrize("lag", [0, 1, 3])
@pytest.mark.parametrize("name", ["lqg-multirate-multi", "lqg-multirate-adaptive"])
def test_frames_of_an_ngs_count_from_their_own_frame_on(name: str, lag: int) -> None:
    """As a controller that in each frame takes all frames anew, every NGS frame that is there in its place."""
    ratio, n = PAPER.sensors.exposure_ratio, 500
    sampling = Sampling(2, PAPER.dt, ratio)

    def make() -> SupervisedController:
        return SupervisedController(wfsobs.design(name, PAPER, sampling=sampling), Supervision(0.3, calm=150))

    slow: Any = Frames(2)
    ngs = NgsStream(slow, NgsWiring((0, 1), 1e-3, ratio, lag, ENOUGH), lambda _: None)
    loop, own = Loop(make(), TruePlant(np.eye(2), 2.0), ngs=ngs), make()
    first, there, start, states = 2, dict[int, np.ndarray](), None, dict[int, Any]()  # another place than from the first row on
    corrections, seen, sent = [np.zeros(2)] * first, [np.zeros(2)] * first, [np.zeros(2)] * first
    for k in range(first, n):
        corrections.append(loop.correction)
        seen.append(MEASURED.z[k] + loop.correction)
        if k - lag > 0 and (k - lag) % ratio == 0:
            there[k - lag] = MEASURED.z_ngs[k - lag] + np.mean(corrections[k - lag - ratio + 1 : k - lag + 1], axis=0)
            slow.write(there[k - lag] * 1e3)
        u = loop.take(MEASURED.z[k])
        sent.append(u)
        if start is None and ngs.phase is not None:  # from here on: at rest where the last command has put the mirror
            start = k
            for i in range(-ratio, k % ratio):
                own.update(np.full(2, np.nan), there.get(k - k % ratio + i) if i >= 0 else None)
                own.amend(sent[k - 1])
            states[k - 1] = own.state_dict()
        if start is None:
            continue
        known = max(k - ratio, start - 1)
        own.load_state_dict(states[known])
        for i in range(known + 1, k + 1):
            command = own.update(seen[i], there.get(i))
            own.amend(sent[i])
            if i == known + 1:  # where the next frame goes on from: no NGS frame comes later than that
                states[i] = own.state_dict()
        np.testing.assert_allclose(u, command, rtol=0, atol=1e-9)
    assert start is not None and start < 150 and not own.reason and len(there) > 70
    residual = MEASURED.z[start + 300 : n] + np.array(corrections[start + 300 :])
    assert residual.std(axis=0).max() < 0.2 * MEASURED.z.std(axis=0).min()


def test_a_loop_in_shared_memory_is_closed_from_the_command_line(tmp_path: Path) -> None:
    n, start = 1500, np.array([100.0, -50.0])
    source = SharedImage.create(tmp_path / "y.im.shm", (2,), dtype="float64")
    sink = SharedImage.create(tmp_path / "u.im.shm", (2,), dtype="float64")
    sink.write(start)
    told = ["--controller", "lqg-kf-lgs", "--unit", "nm", "--command-delay", "2", "--stuck", LONGEST]
    acting = ActingPlant(TruePlant(np.eye(2), 2.0))
    for _ in range(5):
        correction = acting.take(start * 1e-3)
    residual = []
    with started(
        sys.executable, "-m", "wfsobs", "attach", "--in", source.path, "--out", sink.path, *told, "--semaphore", "3", "--json"
    ) as ours:
        readers = source._readers
        assert readers is not None
        wait_until(lambda: bool(readers[3]))
        for z in MEASURED.z[:n]:
            residual.append(z + correction)
            before = sink.count
            source.write(1e3 * residual[-1])
            assert sink.wait(before, ENOUGH)
            found = sink.read()
            assert found is not None
            correction = acting.take(1e-3 * found[1])
        ours.send_signal(signal.SIGTERM)
        out, err = ours.communicate(timeout=ENOUGH)
    assert ours.returncode == 0, err
    summary, last = json.loads(out), sink.read()
    assert summary["frames"] == n and summary["alarms"] == [] and "the controller closes the loop" in err
    assert last is not None
    np.testing.assert_array_equal(last[1], found[1], "the last command stays")
    assert np.std(residual[-400:], axis=0).max() < 0.1 * np.std(MEASURED.z, axis=0).min()


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--controller", "lqg"], "controller 'lqg': no such controller"),
        (["--controller", "lqg-multirate"], "takes an NGS"),
        (["--controller", "integrator+gpr-offline"], "learns from a record beforehand"),
        (["--controller", "lqg-kf-lgs", "--shadow"], "--shadow: applies to observers"),
        (["--controller", "lqg-kf-lgs", "--delay", "2"], "--delay: applies to observers"),
        (["--controller", "lqg-kf-lgs", "--command-gain", "0"], "--command-gain 0"),
    ],
)
def test_what_cannot_close_a_loop_is_said_in_one_line(tmp_path: Path, options: list[str], reason: str) -> None:
    source = SharedImage.create(tmp_path / "in.im.shm", (2,))
    sink = [] if "--shadow" in options else ["--out", str(tmp_path / "out.im.shm")]
    done = CliRunner().invoke(main, ["attach", "--in", source.path, "--seconds", "0.1", *sink, *options])
    assert done.exit_code == 2 and reason in done.output and done.output.count("\n") == 1, done.output
