"""A stream in which a peak appears, noise rises and frames are lost: each is told once in the log, and once when it is over.

Stream, source, observers, alarms and identification are those of `wfsobs live --in STREAM`, in this process and without a clock.
"""

from concurrent.futures import Future

import numpy as np
import pytest

import wfsobs
from tests.live.in_process import LoopInProcess
from tests.live.test_sources import Inbox
from wfsobs.live.attached import StreamFrames, StreamSource
from wfsobs.live.loop import Shadow, append_line
from wfsobs.live.source import Desk, LiveEvent
from wfsobs.scenario.presets import paper
from wfsobs.streams.shared_image import SharedImage

pytestmark = pytest.mark.slow

SPAN = 8
"""Length of what is identified [s], in place of a minute."""


class Loop(LoopInProcess):
    """A live loop on a stream, in steps of a frame."""

    def __init__(self, folder):
        self.image, self.log = SharedImage.create(folder / "modes.im.shm", (2,), dtype="float64"), folder / "night.log"
        source = StreamSource(self.image.path, (0, 1), 1.0, 1e-3)
        super().__init__(paper(), source.sampling, False)
        inbox = Inbox()
        self.stream = StreamFrames(source, Desk(self.ring.name, 2, self.news, 1.0, None), inbox)
        self.stream._look()
        inbox.waiting.append({"play": True})
        self.stream._follow_commands()
        self.shadow = Shadow(self.say, self)

    def say(self, what, **fields):
        append_line(str(self.log), self.newest * self.sampling.dt, LiveEvent(self.newest, what, **fields).line)

    def send(self, z, is_lost):
        self.image.write(z)
        if is_lost:
            return
        self.stream.take()
        self.observe()
        if self.count % 200 == 0:
            self.shadow(self)

    def release(self):
        self.stream._ring.release()
        super().release()


@pytest.fixture
def loop(tmp_path, monkeypatch):
    monkeypatch.setattr("wfsobs.live.loop.MINUTE", float(SPAN))
    loop = Loop(tmp_path)
    yield loop
    loop.release()


def test_a_night_with_a_peak_noise_and_lost_frames(loop):
    n, rng = 39_000, np.random.default_rng(5)
    z = wfsobs.simulate(paper().replace({"run.duration": n / 1000})).z
    t = 1e-3 * np.arange(n)
    peak, loud, lossy = (16, 24), (33, 35), (36.5, 37.5)

    def between(span):
        return (t >= span[0]) & (t < span[1])

    z += 0.1 * (np.sin(2 * np.pi * 73.0 * t) * between(peak))[:, None]
    z += 0.1 * rng.normal(size=z.shape) * between(loud)[:, None]
    lost = between(lossy) & (rng.random(n) < 0.1)
    for row, is_lost in zip(z, lost, strict=True):
        loop.send(row, is_lost)
    told = [line.split(" ", 2)[1:] for line in loop.log.read_text(encoding="utf-8").splitlines()]
    lines = [(float(seconds), line) for seconds, line in told]

    def when(start):
        return [seconds for seconds, line in lines if line.startswith(start)]

    # alarms of a second come at its end, and are over in the first one that is quiet; peaks are those of the last span
    assert when("ALARM new peak at 73.0") == pytest.approx([24.0], abs=0.5)
    assert when("peak at 73.0") == [] and when("ALARM peak at 73.0") == pytest.approx([32.0], abs=0.5)
    assert when("ALARM noise up") == pytest.approx([34.0], abs=1.1) and when("over: noise") == pytest.approx([36.0], abs=1.1)
    assert [s for s, line in lines if "frames missing" in line] == pytest.approx([37.5, 39.0], abs=1.1)
    (share,) = [float(line.split()[1].rstrip("%")) for _, line in lines if line.startswith("ALARM") and "missing" in line]
    assert 1.0 < share < 14.0  # of 1000 frames a part, or all, lose a tenth; 4 standard deviations above
    assert when("ALARM error of kf-multi up")[-1] > 32 and when("over: error of kf-multi")[-1] > 33
    assert "kf-multi" in loop.board.active()


def test_what_takes_longer_than_a_minute_to_identify_is_waited_for(loop, monkeypatch):
    monkeypatch.setattr("wfsobs.live.loop.MINUTE", 1.0)
    loop.shadow, begun = Shadow(loop.say, loop), []

    def begin(*_, then):
        begun.append(Future())
        return begun[-1]

    loop.workshop.do = begin
    for _ in range(3500):
        loop.send(np.zeros(2), False)
    assert len(begun) == 1
    begun[0].set_result(None)
    for _ in range(1500):
        loop.send(np.zeros(2), False)
    assert len(begun) == 2
