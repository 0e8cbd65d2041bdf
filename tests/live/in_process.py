"""A live loop in the process of the test and without a clock: what the alarms read of one."""

import queue
from types import SimpleNamespace

from wfsobs.live.board import Board, last_frames, read_view, trace_width
from wfsobs.live.crew import Site
from wfsobs.live.processes import made_crew
from wfsobs.live.ring import Recorder, Ring, Rows
from wfsobs.live.source import LiveEvent


def keep_lines(lines):
    """Return what keeps the lines of the events that it receives."""
    return lambda what, **fields: lines.append(LiveEvent(0, what, **fields).line)


class LoopInProcess:
    """Ring, observer `kf-multi`, recorder and workshop; who inherits says what it is told."""

    def __init__(self, scenario, sampling, is_simulated):
        self.scenario, self.sampling, self.news = scenario, sampling, queue.Queue()
        self.ring, self.board, self.traces = Ring(2), Board(2), Rows(trace_width(2), 4096)
        site = Site(scenario.to_dict(), sampling, "", "", self.news)
        self.crew, self.count = made_crew(site, self.board, 0, ("kf-multi",)), 0
        self.recorder = Recorder(self.ring, sampling, self.say, is_simulated)
        self.workshop = SimpleNamespace(do=lambda function, *given, then: then(function(*given)), keep=lambda finding: None)

    def say(self, what, **fields):
        raise NotImplementedError

    @property
    def newest(self):
        return self.ring.count

    def observe(self):
        """Have the observer take what has come."""
        while self.count < self.newest:
            frame = self.ring.read(self.count)
            assert frame is not None
            self.traces.write(self.crew.take(frame, self.count))
            self.count += 1
        self.crew.count()

    def frames(self, seconds):
        first, stop = last_frames(self.newest, self.sampling.dt, seconds)
        return first, self.ring.read_frames(first, stop)

    def views(self, seconds):
        return [(read_view(self.ring, [self.traces], self.sampling, seconds), self.board.active())]

    def release(self):
        for shared in (self.ring, self.traces, self.board):
            shared.release()
