"""A stream of a running loop as a source, in shared memory or by ZeroMQ: its frames when they come; nothing is written to it."""

from __future__ import annotations

import gc
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import inf
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from time import monotonic, sleep

import numpy as np

from wfsobs.live.ring import Ring
from wfsobs.live.source import SOURCE, STREAM, Desk, Worker, enter_process, receive
from wfsobs.record import Sampling
from wfsobs.signal.gate import GateSettings, OutlierGate, frame_mean_of
from wfsobs.streams.follower import LONGEST_GAP
from wfsobs.streams.network import Subscription, is_address
from wfsobs.streams.shared_image import POLL, SharedImage, StreamError
from wfsobs.streams.wiring import STUCK, NgsStream, NgsWiring, check_elements
from wfsobs.typing import Array


class PairedFrames:
    """Holds LGS frames back until the NGS frame has come that belongs to the first of them.

    Parameters
    ----------
    ngs : NgsStream
        The other stream.
    n_modes : int
        Number of modes.
    lag : int
        LGS frames between an NGS frame and the one that it belongs to; one that is due is waited for for one more.
    """

    def __init__(self, ngs: NgsStream, n_modes: int, lag: int):
        self._ngs, self._patience = ngs, min(lag + 1, ngs.ratio - 1)
        self._nothing = np.full(n_modes, np.nan)
        self._rows: deque[tuple[int, Array, Array]] = deque()

    def add(
        self, count: int, z: Array, n_sent: int, is_missing: bool = False, write_time: int = 0
    ) -> Iterator[tuple[Array, Array]]:
        """Take an LGS frame, and yield measurements of both sensors that can go out, each (n_modes,) [um].

        Parameters
        ----------
        count : int
            Counter of the frame.
        z : Array
            Its measurement, (n_modes,) [um].
        n_sent : int
            Rows that have gone out. The number of a row with an NGS measurement is a multiple of the ratio: where NGS frames have
            another place than before, rows without any measurement go out.
        is_missing : bool
            Whether it is not there, or not the newest any more: it waits for the next one that is, as nothing can be told of when
            an NGS frame has come.
        write_time : int
            When it was written [ns]; 0 where it is not known.
        """
        found = None if is_missing else self._ngs.look(count, write_time)
        if self._ngs.phase is not None:
            n_more = (count - self._ngs.phase - n_sent - len(self._rows)) % self._ngs.ratio
            if n_more:
                yield from self.flush()
                for _ in range(n_more):
                    yield self._nothing, self._nothing
        self._rows.append((count, z, self._nothing))
        if found is not None:
            place = count - found[0]
            self._rows = deque((k, row, found[1] if k == place else ngs) for k, row, ngs in self._rows)
        while self._rows and not is_missing and not self._waits(count):
            yield self._rows.popleft()[1:]

    def flush(self) -> Iterator[tuple[Array, Array]]:
        """Yield what is held back."""
        while self._rows:
            yield self._rows.popleft()[1:]

    def restart(self) -> Iterator[tuple[Array, Array]]:
        """Yield what is held back: the counter of the LGS is another one from now on."""
        yield from self.flush()
        self._ngs.restart()

    def _waits(self, count: int) -> bool:
        """Whether the first row waits for its NGS frame still."""
        first, _, ngs = self._rows[0]
        phase = self._ngs.phase
        is_due = phase is not None and (first - phase) % self._ngs.ratio == 0
        return is_due and bool(np.isnan(ngs).all()) and count - first < self._patience


TICK = 0.05
"""Longest wait for a frame before a look at the commands [s]."""
SPELL = 10.0
"""Time after which something that had ceased is told anew [s]."""
BETWEEN_LOOKS = 0.1
"""Pause between two looks at a stream, in frames: more looks would take time from what follows."""
RETRY = 0.5
"""Pause before a stream that cannot be read is looked for again [s]."""


@dataclass(frozen=True)
class StreamSource:
    """A stream as a source: pseudo-open-loop modes of one sensor, or two streams of two sensors.

    Attributes
    ----------
    path : str
        File of the stream, or its address, such as tcp://host:5555.
    elements : tuple of int
        Number in a frame of each mode.
    unit : float
        Micrometres per unit of the stream.
    dt : float
        Time between two frames by the design of the observers [s].
    ngs_path : str
        File or address of the stream of the NGS, "" for none.
    ngs : NgsWiring, optional
        How that is read.
    gate : GateSettings, optional
        How outliers are kept from observers; by default not at all.
    """

    path: str
    elements: tuple[int, ...]
    unit: float
    dt: float
    ngs_path: str = ""
    ngs: NgsWiring | None = None
    gate: GateSettings | None = None
    name = STREAM
    has_truth = False

    @property
    def sampling(self) -> Sampling:
        """Modes and step, and NGS ratio where there is one."""
        return Sampling(len(self.elements), self.dt, None if self.ngs is None else self.ngs.ratio)

    def staff(self, context: SpawnContext, desk: Desk) -> list[Worker]:
        """Begin its process."""
        return [Worker(context, "the source", _send, self, desk)]


def _send(source: StreamSource, desk: Desk, inbox: Connection) -> None:
    enter_process(turn=SOURCE)
    gc.freeze()
    StreamFrames(source, desk, inbox).run()


class StreamFrames:
    """Writes what a stream brings to a ring; a stream that dies, stalls or sends garbage is told in one line, and followed again.

    Parameters
    ----------
    source : StreamSource
        The stream.
    desk : Desk
        Where the ring is.
    inbox : Connection
        Commands.
    """

    def __init__(self, source: StreamSource, desk: Desk, inbox: Connection):
        self._source, self._desk, self._inbox, self._elements = source, desk, inbox, np.array(source.elements)
        self._ring = Ring(desk.n_modes, desk.ring_name)
        self._nothing = np.full(desk.n_modes, np.nan)
        self._row = np.full(1 + 5 * desk.n_modes, np.nan)
        self._row[1 + 2 * desk.n_modes : 1 + 3 * desk.n_modes] = 0.0  # of commands nothing is known: z is all there is
        self._stream: SharedImage | Subscription | None = None
        self._pairs: PairedFrames | None = None
        self._count, self._alive, self._steps = 0, monotonic(), 0
        self._is_playing = self._is_stuck = False
        self._spells: dict[str, float] = {}
        self._gates = source.gate and tuple(OutlierGate(desk.n_modes, source.gate) for _ in range(2))
        self._lgs_history = np.full((source.sampling.ratio or 1, desk.n_modes), np.nan)  # newest last

    def run(self) -> None:
        """Follow the stream until the process is ended, or all frames have been sent."""
        while self._ring.count != self._desk.n_frames:
            self._follow_commands()
            if self._stream is None:
                self._look()
            elif self._stream.wait(self._count, TICK):
                self.take()
            elif monotonic() - self._alive > STUCK:
                self._stand_still()
        self._ring.close_writer()

    def take(self) -> None:
        """Write the newest frame of the stream, and NaN for those missing before it."""
        assert self._stream is not None
        found = self._stream.read()
        if found is None:
            self._say_once("a frame is being written without an end")
            sleep(TICK)
            return
        count, values = found
        missing = count - self._count - 1
        if self._is_stuck:
            self._say("frames again")
        self._count, self._alive, self._is_stuck = count, monotonic(), False
        if not self._is_playing and not self._steps:
            return
        self._steps = max(0, self._steps - 1)
        if missing < 0 or missing > LONGEST_GAP:
            self._say("the counter has jumped")
            self._begin_at()
        else:
            for k in range(missing, 0, -1):
                self._send(count - k, self._nothing, is_missing=True)
        z = values[self._elements] * self._source.unit
        if not np.isfinite(z).all():
            self._say_once("numbers that are not finite")
        self._send(count, np.where(np.isfinite(z), z, np.nan))

    def _send(self, count: int, z: Array, is_missing: bool = False) -> None:
        """Write a frame, or those that have waited with it for an NGS frame."""
        if self._pairs is None:
            self._write(z, self._nothing)
            return
        assert self._stream is not None
        write_time = self._stream.write_time
        is_newest = self._stream.count == count
        for row in self._pairs.add(count, z, self._ring.count, is_missing or not is_newest, write_time):
            self._write(*row)

    def _write(self, z: Array, ngs: Array) -> None:
        if self._ring.count == self._desk.n_frames:  # of a gap, what is beyond the last frame that was asked for
            return
        if self._gates:
            z, ngs = self._pass(z, ngs)
        n = self._desk.n_modes
        self._row[0], self._row[1 : 1 + n], self._row[1 + n : 1 + 2 * n] = self._alive, z, ngs
        self._ring.write(self._row)
        self._desk.wake()

    def _pass(self, z: Array, ngs: Array) -> tuple[Array, Array]:
        """Return the measurements of a frame without outliers."""
        assert self._gates
        ratio = self._source.sampling.ratio
        is_due = ratio is not None and self._ring.count > 0 and self._ring.count % ratio == 0
        lgs = self._gates[0].check(z)
        self._lgs_history[:-1], self._lgs_history[-1] = self._lgs_history[1:], lgs
        tested = lgs, self._gates[1].check_beside(ngs, frame_mean_of(self._lgs_history)) if is_due else ngs
        if any(not np.array_equal(new, old, equal_nan=True) for new, old in zip(tested, (z, ngs), strict=True)):
            counts = [", ".join(map(str, gate.outliers)) for gate in self._gates]
            done = "clipped" if self._gates[0].settings.action == "clip" else "taken for missing"
            self._say_once(
                f"outliers are {done}", f": {counts[0]} so far, mode by mode" + f"; NGS {counts[1]}" * (ratio is not None)
            )
        return tested

    def _begin_at(self) -> None:
        """Write what is held back: the counter of the stream is another one from now on."""
        for row in () if self._pairs is None else self._pairs.restart():
            self._write(*row)
        for gate in self._gates or ():
            gate.reset()

    def _follow_commands(self) -> None:
        while self._inbox.poll():
            command = receive(self._inbox)
            was_playing = self._is_playing
            self._is_playing = command.get("play", self._is_playing)
            self._steps += command.get("step", 0)
            if self._is_playing and not was_playing and isinstance(self._stream, SharedImage):
                self._count = self._stream.count  # what came meanwhile is not missing

    def _look(self) -> None:
        """Open the stream; say once why it cannot be opened."""
        try:
            if self._source.ngs is not None and self._pairs is None:
                self._pairs = self._pair(self._source.ngs)
            stream = self._open(self._source.path, self._source.elements)
        except StreamError as error:
            if not self._is_stuck:
                self._is_stuck = True
                self._desk.say(self._ring.count, str(error))
            sleep(RETRY)
            return
        self._stream, self._count = stream, stream.count
        self._begin_at()

    def _open(self, path: str, elements: Sequence[int]) -> SharedImage | Subscription:
        """Open a stream that has these elements. Raises StreamError."""
        if not is_address(path):
            stream = SharedImage(path, max(POLL, BETWEEN_LOOKS * self._source.dt))
            check_elements(stream, elements)
            return stream
        stream = Subscription(path, lambda line: self._desk.say(self._ring.count, line), patience=RETRY)
        try:
            check_elements(stream, elements)
        except StreamError:
            stream.close()
            raise
        return stream

    def _pair(self, wiring: NgsWiring) -> PairedFrames:
        """Open the stream of the NGS. Raises StreamError."""
        stream = self._open(self._source.ngs_path, wiring.elements)
        ngs = NgsStream(stream, wiring, lambda line: self._desk.say(self._ring.count, line))
        return PairedFrames(ngs, self._desk.n_modes, wiring.lag)

    def _stand_still(self) -> None:
        assert self._stream is not None
        if not self._is_stuck:
            self._is_stuck = True
            self._say(f"no frame for {STUCK:g} s")
        if not self._stream.is_current:
            self._stream = None

    def _say_once(self, line: str, more: str = "") -> None:
        """Say what may be so at every other frame, and more of it: the first time, and again after SPELL without it."""
        now = monotonic()
        if now - self._spells.get(line, -inf) > SPELL:
            self._say(line + more)
        self._spells[line] = now

    def _say(self, line: str) -> None:
        self._desk.say(self._ring.count, line, self._source.path)
