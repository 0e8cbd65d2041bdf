"""Sources of a live loop beside the simulation: a record, and a stream of another program."""

import itertools
import json
import queue
import threading
from multiprocessing import get_context
from multiprocessing.synchronize import BoundedSemaphore
from time import monotonic

import numpy as np
import pytest
import zmq

import wfsobs
from tests.patience import ENOUGH
from wfsobs.live import source as live_source
from wfsobs.live.attached import SPELL, StreamFrames, StreamSource
from wfsobs.live.board import LONG_STEPS
from wfsobs.live.checks import observers_on
from wfsobs.live.ring import LiveFrame, Ring, open_loop_record
from wfsobs.live.source import Desk, Replay, frame_rows
from wfsobs.scenario.presets import paper
from wfsobs.streams.shared_image import SharedImage
from wfsobs.streams.wiring import NgsWiring


class Inbox:
    """Commands that are there."""

    def __init__(self):
        self.waiting = []

    def poll(self, *_):
        return bool(self.waiting)

    def recv(self):
        return self.waiting.pop(0)


def test_frames_of_a_record_are_those_of_the_record():
    record = wfsobs.simulate(paper().replace({"run.duration": 1.5}))
    parts = np.split(frame_rows(record), 5, axis=1)
    for part, expected in zip(parts, (record.z, record.z_ngs, record.u, record.turbulence, record.vibration), strict=True):
        np.testing.assert_array_equal(part, expected)
    source = Replay(record)
    assert source.has_truth and source.sampling == record.sampling
    again = open_loop_record(LiveFrame(np.zeros(record.n_steps), *parts), record.sampling)
    np.testing.assert_array_equal(again.z, record.z)
    np.testing.assert_array_equal(again.z_ngs[1:], record.z_ngs[1:])


def spent_semaphore() -> BoundedSemaphore:
    """Return a semaphore of a crew that waits for a frame."""
    semaphore = get_context("spawn").BoundedSemaphore()
    semaphore.acquire()
    return semaphore


@pytest.mark.parametrize(("n_frames", "count", "last"), [(None, 7, [(7, "the record has ended")]), (3, 3, [])])
def test_a_record_is_sent_until_its_end_or_what_was_asked_for(monkeypatch, n_frames, count, last):
    ring, inbox, news, opened = Ring(2), Inbox(), queue.Queue(), []
    monkeypatch.setattr(live_source, "enter_process", lambda **_: None)
    monkeypatch.setattr(live_source, "Ring", lambda *of: opened.append(Ring(*of)) or opened[-1])
    rows, wake = np.arange(70.0).reshape(7, 10), spent_semaphore()
    inbox.waiting.append({"play": True, "line": "a setting"})
    try:
        live_source._send(rows, 1e-4, Desk(ring.name, 2, news, 1.0, n_frames, (wake,)), inbox)
        assert ring.is_closed and ring.count == count
        assert wake.acquire(timeout=0)
        np.testing.assert_array_equal(np.hstack(ring.read_frames(0, count)[1:]), rows[:count])
    finally:
        for one in (*opened, ring):
            one.release()
    assert [(event.frame, event.what) for event in news.queue] == [(0, "a record cannot be changed"), *last]


@pytest.fixture
def stream(tmp_path):
    path = tmp_path / "modes.im.shm"
    image = SharedImage.create(path, (4,), dtype="float64")
    ring, inbox, news = Ring(2), Inbox(), queue.Queue()
    source = StreamSource(str(path), (2, 0), 1e-3, 1e-3)
    frames = StreamFrames(source, Desk(ring.name, 2, news, 1.0, None), inbox)
    frames._look()
    yield path, image, ring, inbox, news, frames
    frames._ring.release()
    ring.release()


@pytest.mark.slow
def test_a_stream_is_followed_through_whatever_happens_to_it(stream, monkeypatch):
    path, image, ring, inbox, news, frames = stream

    def send(*values):
        image.write(np.array(values, dtype=float))
        frames.take()

    def lines():
        out = [(event.frame, event.what) for event in list(news.queue)]
        news.queue.clear()
        return out

    send(1, 2, 3, 4)
    assert ring.count == 0, "nothing before it plays"
    inbox.waiting.append({"play": True})
    frames._follow_commands()
    send(1, 2, 3, 4)
    frame = ring.read(0)
    assert frame.z == pytest.approx([3e-3, 1e-3]) and np.all(frame.u == 0) and np.isnan(frame.ngs).all()
    assert np.isnan(frame.turbulence).all()
    image.write(np.zeros(4))  # two frames that nobody has seen
    image.write(np.zeros(4))
    send(5, 0, 7, 0)
    assert ring.count == 4 and np.isnan(ring.read_frames(1, 3).z).all() and ring.read(3).z[0] == pytest.approx(7e-3)
    send(np.nan, 0, np.inf, 0)
    send(np.nan, 0, 1, 0)
    send(1, 0, 1, 0)
    send(np.nan, 0, 1, 0)  # an element that fails again and again is one story
    assert np.isnan(ring.read(4).z).all() and lines() == [(4, "numbers that are not finite")]
    now = monotonic()
    monkeypatch.setattr("wfsobs.live.attached.monotonic", lambda: now + SPELL + 1.0)
    send(np.nan, 0, 1, 0)
    assert lines() == [(8, "numbers that are not finite")]
    monkeypatch.undo()
    frames._stand_still()
    frames._stand_still()
    assert lines() == [(9, "no frame for 0.1 s")]
    path.unlink()
    frames._stand_still()
    frames._look()
    frames._look()
    assert frames._stream is None and lines() == []
    image = SharedImage.create(path, (4,), dtype="float64")
    frames._look()
    image.write(np.arange(4.0))
    frames.take()
    assert ring.count == 10 and lines() == [(9, "frames again")]
    np.testing.assert_array_equal(image._values, np.arange(4.0))  # nothing is written to it


def test_a_stream_by_network_is_followed_and_its_next_program_too():
    """Frame k holds (k, 0, -k): rows follow each other by one, frames missing as NaN, and a counter that begins anew is told."""
    socket = zmq.Context().socket(zmq.PUB)
    port, is_over, counters = socket.bind_to_random_port("tcp://127.0.0.1"), threading.Event(), [itertools.count(10**6)]
    ring, news = Ring(2), queue.Queue()
    source = StreamSource(f"tcp://127.0.0.1:{port}", (2, 0), 1.0, 1e-3)

    def publish():
        while not is_over.wait(1e-3):
            k = next(counters[0])
            header = {"frame": k, "dtype": "float64", "n": 3}
            socket.send_multipart([json.dumps(header).encode(), np.array([k, 0.0, -k]).tobytes()])

    publisher = threading.Thread(target=publish)
    publisher.start()
    inbox = Inbox()
    frames = StreamFrames(source, Desk(ring.name, 2, news, 1.0, None), inbox)
    inbox.waiting.append({"play": True})
    while frames._stream is None:
        frames._look()
    frames._follow_commands()

    def take_until(n_rows):
        while ring.count < n_rows:
            if frames._stream.wait(frames._count, 1.0):
                frames.take()

    take_until(100)
    k = ring.read_frames(0, 100).z[:, 1]
    known = np.flatnonzero(~np.isnan(k))
    np.testing.assert_array_equal(np.diff(k[known]), np.diff(known))
    assert len(known) > 10 and k[known[0]] > 10**6 and news.empty()
    np.testing.assert_array_equal(ring.read_frames(0, 100).z[:, 0], -k)
    counters[0] = itertools.count(1)  # a program that starts anew
    while news.empty():
        take_until(ring.count + 1)
    event = news.get()
    assert (event.origin, event.what) == (source.path, "the counter has jumped") and news.empty()
    is_over.set()
    publisher.join()
    frames._stream.close()
    socket.context.destroy(linger=0)
    frames._ring.release()
    ring.release()


class Publisher:
    """One sensor's program on a network, written here with zmq alone, and the subscription that has heard its first frame."""

    def __init__(self, context):
        self._socket = context.socket(zmq.PUB)
        self.address = f"tcp://127.0.0.1:{self._socket.bind_to_random_port('tcp://127.0.0.1')}"
        self._is_heard = threading.Event()
        self._first = threading.Thread(target=self._begin)
        self._first.start()

    def _begin(self):
        while not self._is_heard.wait(1e-2):
            self.send(1, np.full(2, np.nan), 0)

    def send(self, count, values, when):
        header = {"frame": count, "dtype": "float64", "n": 2} | ({"time_ns": when} if when else {})
        self._socket.send_multipart([json.dumps(header).encode(), values.tobytes()])

    def heard_by(self, stream):
        self._is_heard.set()
        self._first.join()
        self._stream = stream

    def wait_until_there(self, count):
        while self._stream.count != count:
            assert self._stream.wait(0, 10.0)


@pytest.mark.parametrize("is_late_to_look", [False, True])
def test_two_streams_by_network_are_the_rows_of_the_record(is_late_to_look):
    """Who looks at an LGS frame once the next NGS frame has come goes by the times that both programs say."""
    record, context = wfsobs.simulate(paper().replace({"run.duration": 0.4, "run.warm_up": 0.1})), zmq.Context()
    lgs, ngs = Publisher(context), Publisher(context)
    ring, inbox, news = Ring(2), Inbox(), queue.Queue()
    source = StreamSource(lgs.address, (0, 1), 1.0, 1e-3, ngs.address, NgsWiring((0, 1), 1.0, 5, 0, stuck=ENOUGH))
    frames = StreamFrames(source, Desk(ring.name, 2, news, 1.0, None), inbox)
    while frames._stream is None:
        frames._look()
    lgs.heard_by(frames._stream)
    ngs.heard_by(frames._pairs._ngs._stream)
    inbox.waiting.append({"play": True})
    frames._follow_commands()

    def send_ngs(row):
        if row and row % 5 == 0:
            ngs.send(1 + row // 5, record.z_ngs[row], 10**6 * row - 1)
            ngs.wait_until_there(1 + row // 5)

    for row in range(2, 399):
        if not is_late_to_look:
            send_ngs(row)
        lgs.send(row, record.z[row], is_late_to_look * 10**6 * row)
        lgs.wait_until_there(row)
        if is_late_to_look:
            send_ngs(row + 1)
        frames.take()
    sent = ring.read_frames(0, ring.count)
    start = np.flatnonzero((sent.z == record.z[200]).all(axis=1))[0]
    n = ring.count - start
    assert start % 5 == 0 and n > 190
    np.testing.assert_array_equal(sent.z[start:], record.z[200 : 200 + n])
    np.testing.assert_array_equal(sent.ngs[start:], record.z_ngs[200 : 200 + n])
    for stream in (frames._stream, frames._pairs._ngs._stream):
        stream.close()
    context.destroy(linger=0)
    frames._ring.release()
    ring.release()


@pytest.mark.slow
@pytest.mark.parametrize(("lag", "jitter"), [(0, 0), (0, 1), (2, 1)])
def test_two_streams_are_the_rows_of_the_record(tmp_path, lag, jitter):
    """Once the NGS frames have found their place each is in its row, a multiple of the ratio; frames that are missing as well."""
    record, rng = wfsobs.simulate(paper().replace({"run.duration": 1.5})), np.random.default_rng(3)
    lgs, ngs = (SharedImage.create(tmp_path / name, (2,), dtype="float64") for name in ("lgs.im.shm", "ngs.im.shm"))
    ring, inbox, news = Ring(2), Inbox(), queue.Queue()
    source = StreamSource(lgs.path, (0, 1), 1.0, 1e-3, ngs.path, NgsWiring((0, 1), 1.0, 5, lag, stuck=ENOUGH))
    assert source.sampling.ratio == 5 and "multirate-multi" in observers_on(source, paper())
    frames = StreamFrames(source, Desk(ring.name, 2, news, 1.0, None), inbox)
    frames._look()
    inbox.waiting.append({"play": True})
    frames._follow_commands()
    arrival = {k: k + lag + int(rng.integers(0, jitter + 1)) for k in range(5, 1400, 5)}
    arrival[700] = arrival[705]  # nobody sees it
    for row in range(2, 1400):
        for k in arrival:
            if arrival[k] == row:
                ngs.write(record.z_ngs[k])
        lgs.write(record.z[row])
        if not 810 <= row < 813:  # nobody looks
            frames.take()
    end = ring.count - ring.count % 5
    sent = ring.read_frames(0, end)
    start = 5 * (np.flatnonzero((sent.z[:, None] == record.z[200]).all(axis=2))[0] // 5)
    assert start % 5 == 0
    rows = np.arange(200, 200 + end - start)
    z, expected = record.z[rows].copy(), record.z_ngs[rows].copy()
    z[810 - 200 : 813 - 200], expected[700 - 200] = np.nan, np.nan
    np.testing.assert_array_equal(sent.z[start:], z)
    np.testing.assert_array_equal(sent.ngs[start:], expected)
    assert [event.line for event in news.queue] == [f"{ngs.path}: one frame in 5 of the LGS"]
    frames._ring.release()
    ring.release()


def test_a_gap_ends_with_the_last_frame_that_was_asked_for(tmp_path):
    """Else more would have been delivered than that, and fewer than none lost."""
    stream = SharedImage.create(tmp_path / "lgs.im.shm", (2,), dtype="float64")
    ring, inbox, wake = Ring(2), Inbox(), spent_semaphore()
    desk = Desk(ring.name, 2, queue.Queue(), 1.0, 5, (wake,))
    frames = StreamFrames(StreamSource(stream.path, (0, 1), 1.0, 1e-3), desk, inbox)
    frames._look()
    inbox.waiting.append({"play": True})
    frames._follow_commands()
    for number in range(3):
        stream.write(np.full(2, number))
        frames.take()
        assert wake.acquire(timeout=0)
    for number in range(3, 10):  # nobody looks
        stream.write(np.full(2, number))
    frames.run()
    assert ring.is_closed
    np.testing.assert_array_equal(ring.read_frames(0, ring.count).z[:, 0], [0.0, 1.0, 2.0, np.nan, np.nan])
    frames._ring.release()
    ring.release()


def test_observers_that_a_stream_can_have():
    names = observers_on(StreamSource("nowhere", (0, 1), 1.0, 1e-3), paper())
    assert {"kf-multi", "gp-lgs", "persistence"} <= set(names)
    assert not {"multirate", "kf-ngs", "multirate-multi", "ridge", "ridge-30"} & set(names)
    assert not set(LONG_STEPS) & set(names)  # they would be late on their own account: they run if they are named
