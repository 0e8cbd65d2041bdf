"""A live loop: changes while it runs, observers that come and go, and what is left when its owner goes."""

import os
import queue
import signal
import subprocess
import sys
import threading
import time
import weakref
from contextlib import suppress
from multiprocessing import Pipe, get_context
from multiprocessing.shared_memory import SharedMemory
from types import SimpleNamespace

import numpy as np
import pytest

import wfsobs
from tests.patience import ENOUGH, is_running, wait
from wfsobs.live import simulated
from wfsobs.live.board import Board, Delivery, read_view, trace_width
from wfsobs.live.crew import Site
from wfsobs.live.loop import TICK, LiveLoop, _keep
from wfsobs.live.processes import made_crew
from wfsobs.live.ring import LiveFrame, Ring, Rows, merged_rows
from wfsobs.live.simulated import FADE, GLANCE, SimulatedFrames, SimulatedLoop
from wfsobs.live.source import Desk, Pace, Worker
from wfsobs.observers.step import StepError
from wfsobs.scenario.presets import paper
from wfsobs.settings.group import SettingError


def put(ready, generation, value, n, count, first=False):
    """Have rows ready of `count` blocks of n frames of one number each, in pieces, with an NGS measurement in every fifth."""
    ngs = np.full((n, 2), np.nan)
    ngs[::5] = value
    for number in range(count):
        block = np.hstack([np.full((n, 2), value), ngs, np.full((n, 4), value)])
        if first and number == 0:
            block[0, 2:4] = np.nan
        for at in range(0, n, 315):  # whole NGS frames, no whole number of them in a block
            ready.put((generation, block[at : at + 315]))


def test_new_settings_fade_in_without_a_seam():
    """Weights of old and new have squares that add up to one, whatever was still in the queue; NGS frames come when due.

    What was ready of the old settings, and of some that were changed at once, does not come back.
    """
    ready, n = queue.Queue(), 9000
    put(ready, 0, 1.0, 2000, 3)
    frames = SimulatedFrames(paper(), ready)
    rows = [frames.next_row(k) for k in range(503)]
    assert "peak" in frames.take({"settings": paper().to_dict(), "is_new": 1, "line": "a peak"})
    frames.take({"settings": paper().to_dict(), "is_new": 1})
    rows += [frames.next_row(k) for k in range(503, 603)]
    put(ready, 1, 7.0, 2000, 1, first=True)
    put(ready, 2, 100.0, 2000, 6, first=True)
    rows = np.array([*rows, *(frames.next_row(k) for k in range(603, n))])
    z, ngs = rows[:, 0], rows[:, 2]
    # Looked for in frames with an NGS measurement, so that those stay in step, a few pieces in each: seven of 7.0 come before.
    start, steps = 605 + 5 * (7 // GLANCE), round(FADE * 1000)
    phase = 0.5 * np.pi * np.arange(steps) / steps
    assert np.all(z[:start] == 1.0) and np.all(z[start + steps :] == 100.0)
    assert z[start : start + steps] == pytest.approx(np.cos(phase) + 100.0 * np.sin(phase), rel=1e-12)
    assert np.array_equal(~np.isnan(ngs), np.arange(n) % 5 == 0)
    assert np.array_equal(ngs[::5], z[::5]) and np.array_equal(rows[:, 6], z)


class Shelf(queue.Queue):
    """A queue that is closed for a maker of blocks by an error."""

    def __init__(self, size):
        super().__init__(size)
        self.was_full, self.closed = threading.Event(), False

    def put(self, item, timeout):
        if self.closed:
            raise EOFError
        try:
            super().put(item, timeout=timeout)
        except queue.Full:
            self.was_full.set()
            raise


def test_first_block_of_new_settings_is_whole(monkeypatch):
    """It must last until that of still newer ones is made; of what follows it, and of settings in between, nothing need come."""
    monkeypatch.setattr("wfsobs.live.simulated.enter_process", lambda niceness: None)
    scenario, ready = paper(), Shelf(90)  # two blocks have 80 pieces
    inbox, outbox = Pipe(duplex=False)

    def make():
        with suppress(EOFError):
            simulated._make(scenario.to_dict(), ready, inbox)

    maker = threading.Thread(target=make)
    maker.start()
    assert ready.was_full.wait(ENOUGH)
    for speed in (11.0, 12.0, 13.0):
        outbox.send({"settings": scenario.replace({"turbulence.wind_speed": speed}).to_dict()})
    taken = [ready.get(timeout=ENOUGH)]
    while taken[-1][0] < 3:
        taken.append(ready.get(timeout=ENOUGH))
    outbox.send({"settings": scenario.to_dict()})
    while taken[-1][0] < 4:
        taken.append(ready.get(timeout=ENOUGH))
    ready.closed = True
    maker.join(ENOUGH)
    assert not maker.is_alive()
    order = [generation for generation, _ in taken]
    lengths = {g: sum(len(rows) for generation, rows in taken if generation == g) for g in set(order)}
    assert order == sorted(order) and {0, 3, 4} <= set(order)  # and some of those in between, if the three did not come at once
    assert all(
        len(rows) % 5 == 0 for _, rows in taken
    )  # else the NGS frames of what follows on a part of a block were out of step
    # Of the blocks of 20 s two are ready, and of the third what there was room for, of new settings one at least.
    assert 40_000 <= lengths[0] < 60_000 and 20_000 <= lengths[3] < 100_000


def test_lost_frames_hold_the_command():
    ready = queue.Queue()
    put(ready, 0, 1.0, 2000, 2)
    frames = SimulatedFrames(paper(), ready)
    before = [frames.next_row(k) for k in range(50)][-1]
    frames.take({"losses": {"lgs": 1.0, "ngs": 0.0}})
    out = np.array([frames.next_row(k) for k in range(50, 60)])
    assert np.isnan(out[:, :2]).all() and np.all(out[:, 4] == before[4]) and not np.isnan(out[:, 6:]).any()
    frames.take({"losses": {"lgs": 0.3, "ngs": 0.3}})
    lost = np.isnan([frames.next_row(k)[0] for k in range(60, 1560)]).mean()
    assert lost == pytest.approx(0.3, abs=5 * np.sqrt(0.3 * 0.7 / 1500))  # 5 standard deviations of 1500 draws


def test_play_pause_steps_and_speed(monkeypatch):
    now = 100.0
    monkeypatch.setattr("wfsobs.live.source.monotonic", lambda: now)
    pace = Pace(0.001, 2.0)
    assert not pace.runs
    pace.take({"step": 2})
    for _ in range(2):
        assert pace.runs
        pace.advance()
    assert not pace.runs
    now = 200.0
    pace.take({"play": True})
    due = []
    for _ in range(4):
        due.append(pace.due())
        pace.advance()
    pace.take({"speed": 0.1})
    pace.advance()
    due.append(pace.due())
    assert np.diff(due) == pytest.approx([0.0005, 0.0005, 0.0005, 0.0105], abs=1e-9)
    now = 300.0  # a machine that slept: what was due meanwhile is not sent in a rush
    assert pace.due() == 300.0
    pace.take({"play": False})
    assert not pace.runs


class Stage:
    """The observers of a live loop in this process, on the frames of a record."""

    def __init__(self, scenario, names):
        record = wfsobs.simulate(scenario)
        self.record, self.said = record, queue.Queue()
        self.ring, self.board = Ring(2), Board(2)
        self.traces = Rows(trace_width(2), 4096)
        settings = scenario.to_dict()
        site = Site(settings, record.sampling, "", "", self.said)
        self.crew, self.number = made_crew(site, self.board, 0, names), 0

    def run(self, n):
        r = self.record
        for k in range(self.number, self.number + n):
            parts = (r.z[k], r.z_ngs[k], r.u[k], r.turbulence[k], r.vibration[k])
            self.ring.write(np.concatenate(([time.monotonic()], *parts)))
            self.traces.write(self.crew.take(LiveFrame(time.monotonic(), *parts), k))
            self.crew.settle()
        self.crew.count()
        self.number += n

    def view(self, seconds=1.0):
        return read_view(self.ring, [self.traces], self.record.sampling, seconds)

    def close(self):
        for part in (self.ring, self.traces, self.board):
            part.release()


@pytest.fixture
def stage():
    made = []

    def make(names, **changes):
        made.append(Stage(paper().replace({"run.duration": 2.0, "run.warm_up": 0.5, **changes}), names))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_counts_and_traces_are_those_of_the_batch_run(stage):
    live = stage(("kf-multi", "multirate-optimal", "kf-ngs"))
    live.run(2000)
    scenario = paper().replace({"run.duration": 2.0, "run.warm_up": 0.5})
    result = wfsobs.observe(live.record, scenario, observers=["kf-multi", "multirate-optimal", "kf-ngs"])
    view = live.view(1.5)
    for score in result.scores:
        if score.observer not in live.board.active():
            continue
        column = ["tip", "tilt"].index(score.mode)
        # frame by frame and at once are one algorithm; the window begins where the warm-up ends
        assert live.board[score.observer].rms(score.target)[column] == pytest.approx(score.rms, rel=1e-9)
        assert view.rms(score.observer, score.target)[column] == pytest.approx(score.rms, rel=1e-9)
    for name in ("kf-multi", "multirate-optimal"):
        total = sum(result.estimate(name, target).values for target in ("turbulence", "vibration"))
        errors = np.array([errors_by_a_frame(live.record, total, k) for k in range(500, 2000, 5)])
        # the warm-up ends with the frame before 500: of the first NGS frame the last step counts alone
        counted = np.concatenate([errors[0, 4:], *errors[1:]])
        assert live.board[name].rms("next") == pytest.approx(np.sqrt(np.mean(counted**2, axis=0)), rel=1e-9)
        # the window begins with 500, and knows no step before
        assert view.rms(name, "next") == pytest.approx(np.sqrt(np.mean(np.concatenate(errors[1:]) ** 2, axis=0)), rel=1e-9)


def errors_by_a_frame(record, total, k):
    """Return z less its prediction in the steps of the NGS frame at k, with their mean from the NGS, (5, 2)."""
    error = record.z[k - 4 : k + 1] - total[k - 5 : k]
    return error - error.mean(axis=0) + record.z_ngs[k] - total[k - 5 : k].mean(axis=0)


@pytest.mark.parametrize("call", ["advance", "predict", "settle"])
def test_the_observer_that_ends_in_an_error_is_named(stage, monkeypatch, call):
    live = stage(("kf-lgs", "kf-multi"))
    monkeypatch.setattr(live.crew._active["kf-multi"].estimator, call, lambda *_: {}["spam"])
    with pytest.raises(StepError, match=r"^kf-multi: KeyError: 'spam'$"):
        live.run(1)
    monkeypatch.setattr(live.crew._active["kf-lgs"].estimator, "predict", lambda *_: (np.zeros(3), np.zeros(3)))
    with pytest.raises(StepError, match=r"^kf-lgs: predict takes the shape \(2,\), one number per mode, not \(3,\)$"):
        live.run(1)


@pytest.mark.slow
def test_a_new_design_goes_on_without_a_bump(stage):
    names = ("kf-multi", "gpr-online")
    live, other = stage(names), stage(names)
    for one in (live, other):
        one.run(1003)
    for name in names:
        live.crew.follow({"id": name, "design": wfsobs.design(name, paper())}, 1003)
    for one in (live, other):
        one.run(500)
    for name in names:
        # the same design and the state carried over: the same estimates
        assert live.view(0.4).estimate(name, "vibration") == pytest.approx(
            other.view(0.4).estimate(name, "vibration"), rel=1e-9, abs=1e-12
        )
    assert live.board["kf-multi"].frames[0] == 1503


def test_observers_come_and_go(stage):
    live = stage(("kf-lgs",))
    live.run(1003)
    live.crew.follow({"id": "multirate", "design": wfsobs.design("multirate", paper())}, 1003)
    live.crew.follow({"id": "kf-lgs", "design": None}, 1003)
    live.run(900)
    assert live.board.active() == ["multirate"] and live.board["multirate"].since[0] == 1005
    view = live.view(2.0)
    assert np.isnan(view.estimate("kf-lgs", "turbulence")[1003:]).all()
    assert np.isnan(view.estimate("multirate", "turbulence")[:1005]).all()
    # as a run that begins there: NGS frames are due in its own fifth frames
    alone = wfsobs.design("multirate", paper())
    for k in range(1005, 1903):
        alone.update(live.record.z[k], live.record.z_ngs[k] if k > 1005 and k % 5 == 0 else None)
    assert view.estimate("multirate", "turbulence")[-1] == pytest.approx(alone.predict(0)[0], rel=1e-12)
    assert [event.line for event in live.said.queue] == ["kf-lgs off", "multirate on"]


@pytest.mark.slow
def test_a_live_loop_from_start_to_stop():
    scenario = paper().replace({"run.warm_up": 0.2, "gpr_online.training_size": 40, "gpr_online.depth": 10})
    loop = LiveLoop(SimulatedLoop(scenario), scenario, ["kf-multi", "gp-both"], speed=0.5)
    try:
        with pytest.raises(SettingError, match="modes and rates cannot change"):
            loop.change({"sensors.exposure_ratio": 10})
        with pytest.raises(SettingError, match="does not run frame by frame"):
            loop.switch("butterworth-ol", True)
        with pytest.raises(SettingError, match="takes a number from"):
            loop.set_speed(50)
        loop.recorder.start()
        loop.step(7)
        wait(lambda: loop.count == 7)
        loop.play()
        wait(lambda: loop.count > 600)
        loop.change({"turbulence.wind_speed": 20.0})
        loop.pause()
        loop.switch("gpr-online", True)
        wait(lambda: len(loop._processes.traces()) == 2)
        loop.play()
        wait(lambda: "gpr-online on" in [e.line for e in loop.events] and loop.board["gpr-online"].frames[0] > 100)
        loop.pause()
        loop.lose()  # nothing; it is said once the pause has been heard
        wait(lambda: loop.count == loop.newest and "all frames arrive" in [e.line for e in loop.events])
        assert "turbulence.wind_speed = 20.0" in [e.line for e in loop.events]
        sent = loop.newest
        check_late_observer(loop, scenario)
        loop.tend()
        assert (loop.delivery.frames, loop.delivery.losses) == (sent, 0) and 0 <= loop.delivery.late_share <= 1
        names = [loop._processes.feed.ring.name, *(rows.name for rows in loop._processes.traces()), loop.board.name]
        assert len(names) == 4, "those that learn have a process of their own"
        record, pids = loop.recorder.stop(scenario), [p.pid for p in loop._processes.processes]
        assert record.n_steps == sent == loop.newest
        for score in wfsobs.observe(record, scenario, observers=["kf-multi", "gp-both"]).scores:
            if score.observer in ("kf-multi", "gp-both"):
                live = loop.board[score.observer].rms(score.target)[["tip", "tilt"].index(score.mode)]
                # measurements of the record are sums in another order
                assert live == pytest.approx(score.rms, rel=1e-6), score
    finally:
        loop.stop()
    assert np.isnan(loop.view(0.1).frames.z).all() and loop.board["gp-both"].frames[0] == sent
    wait(lambda: not any(map(is_running, pids)))
    for name in names:
        with pytest.raises(FileNotFoundError):
            SharedMemory(name=name)


def check_late_observer(loop, scenario):
    """One that was switched on later, in another process, has the estimates of a run that begins there."""
    view, since = loop.view(600.0), int(loop.board["gpr-online"].since[0])
    assert view.first == 0 and since % 5 == 0
    alone, frames = wfsobs.design("gpr-online", scenario), view.frames
    for k in range(since, view.n):
        alone.update(frames.z[k], u=frames.u[k])
        if k > view.n - 10:
            assert view.estimate("gpr-online", "vibration")[k] == pytest.approx(alone.predict(0)[0], rel=1e-9)
    assert np.isnan(view.estimate("gpr-online", "vibration")[:since]).all()
    assert not np.isnan(view.estimate("kf-multi", "vibration")).any()


def test_a_frame_is_taken_once_all_crews_have_it_and_late_by_the_last():
    ring, board, steady, learning = Ring(2), Board(2), Rows(4, 8), Rows(4, 8)
    try:
        now = time.monotonic()
        for due in (now - 0.5, now + 9, now - 0.5, now + 9, now + 9):
            ring.send(np.full(11, due))

        def parts():
            board.progress[:2] = steady.count, learning.count
            return dict(enumerate((steady, learning)))

        delivery = Delivery(ring, board, parts)
        for k, delay in enumerate((0.0001, 0.0002, 0.003, 0.0001, 0.0001)):
            steady.write(np.array([k, delay, 1.0, np.nan]))
        delivery.collect()
        assert (delivery.frames, delivery.late_share, delivery.late_share_sent) == (0, 0.0, 0.4)
        for k, delay in enumerate((0.002, 0.0004)):
            learning.write(np.array([k, delay, np.nan, 2.0]))
        delivery.collect()
        assert (delivery.frames, delivery.late_share) == (2, 0.5), "the first is late by the second crew"
        learning.skip_to(4)
        board.losses[1] = 2
        learning.write(np.array([4, 0.0001, np.nan, 3.0]))
        delivery.collect()
        assert (delivery.count, delivery.losses, delivery.frames) == (5, 2, 3)
        rows = merged_rows([steady, learning], 0, 5)
        np.testing.assert_array_equal(rows[:, 2:], [[1, 2], [1, 2], [1, np.nan], [1, np.nan], [1, 3]])
        assert np.all(rows[:, 1] == [0.002, 0.0004, 0.003, 0.0001, 0.0001])
        for k in range(5, 25):  # more than the rows hold: what nobody has looked at is not known
            for rows in (steady, learning):
                rows.write(np.array([k, 0.0001, 1.0, 1.0]))
        delivery.collect()
        assert delivery.frames == 23 and delivery.late_share == pytest.approx(2 / 12)
    finally:
        for part in (ring, board, steady, learning):
            part.release()


def test_a_crew_is_woken_once_however_many_frames_have_come():
    wakes = [get_context("spawn").BoundedSemaphore() for _ in range(2)]
    desk = Desk("", 2, queue.Queue(), 1.0, None, wakes)
    for _ in range(3):
        desk.wake()
        desk.wake()
        assert all(one.acquire(timeout=ENOUGH) for one in wakes)
    assert not any(one.acquire(timeout=0) for one in wakes)


def interrupt_itself(pipe):
    """Be reached by Ctrl+C before anything else, as what still imports is."""
    os.kill(os.getpid(), signal.SIGINT)
    pipe.send("alive")


@pytest.mark.slow
def test_a_process_does_not_see_ctrl_c_before_it_can_ignore_it():
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    worker = Worker(get_context("spawn"), "a test", interrupt_itself)
    try:
        assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before
        assert worker.pipe.poll(ENOUGH) and worker.pipe.recv() == "alive"
    finally:
        worker.stop()


@pytest.mark.slow
def test_nothing_is_left_of_a_loop_whose_owner_is_killed():
    code = (
        "import time\n"
        "from wfsobs import PRESETS\n"
        "from wfsobs.live.loop import LiveLoop\n"
        "from wfsobs.live.simulated import SimulatedLoop\n"
        "s = PRESETS['paper']()\n"
        "loop = LiveLoop(SimulatedLoop(s), s, ['zero'])\n"
        "p = loop._processes\n"
        "print(*(one.pid for one in p.processes), p.feed.ring.name, p.traces()[0].name, loop.board.name, flush=True)\n"
        "time.sleep(100)\n"
    )
    owner = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    *pids, ring, traces, board = owner.stdout.readline().split()
    owner.send_signal(signal.SIGKILL)
    owner.communicate(timeout=ENOUGH)
    wait(lambda: not any(is_running(int(pid)) for pid in pids))
    wait(lambda: not any(os.path.exists(f"/dev/shm/{name}") for name in (ring, traces, board)))


TURNS = """
import os
from wfsobs.live.source import SOURCE, go_first

def turn():
    return os.sched_getparam(0).sched_priority if hasattr(os, "sched_getparam") else 0

print(SOURCE if go_first(SOURCE) else 0, turn())
go_first(0)
print(0, turn())
"""


@pytest.mark.slow
def test_a_process_goes_first_where_the_system_lets_it():
    """What it says of its turn is what the system says."""
    lines = subprocess.run([sys.executable, "-c", TURNS], capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines) == 2
    for line in lines:
        told, is_so = line.split()
        assert told == is_so


def test_a_fast_loop_is_looked_after_as_often_in_its_own_time():
    """So that no event of its scenario is passed over; a slow one no less often than one in real time."""

    class Paced:
        def __init__(self, speed):
            self.speed = speed

        def tend(self):
            pass

    for speed, expected in ((20.0, TICK / 20.0), (0.1, TICK)):
        loop, waits = Paced(speed), []
        _keep(weakref.ref(loop), SimpleNamespace(wait=lambda pause, waits=waits: waits.append(pause) or len(waits) > 3))
        assert waits == [TICK, *[expected] * 3]
