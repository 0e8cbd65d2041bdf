"""Following a stream: every frame is answered, and whatever becomes of the stream, what is sent is safe."""

from __future__ import annotations

import gc
from abc import ABC, abstractmethod
from collections.abc import Callable
from time import monotonic
from typing import Any

import numpy as np

from wfsobs.streams.going_back import GoingBack, StateObserver
from wfsobs.streams.layout import Semaphore, StreamError
from wfsobs.streams.ngs_frames import NgsStream
from wfsobs.streams.stream import SinkStream, SourceStream
from wfsobs.streams.tally import Tally
from wfsobs.streams.wiring import Wiring, check_elements
from wfsobs.typing import Array

TICK = 0.05
"""Longest wait for a frame before a look at the clock and at the wish to stop [s]."""
LONGEST_GAP = 1000
"""Missing frames that an observer is taken through; after more of them it starts anew."""


class StreamFollower(ABC):
    """Follows a stream and writes an answer to each of its frames to another one.

    Parameters
    ----------
    source : SourceStream
        One frame after the other.
    sink : SinkStream or None
        Where the answers go; None writes nothing.
    wiring : Wiring
        Modes, unit, limits.
    observer : StateObserver
        Observer or controller, before its first frame.
    say : callable
        Receives one line about whatever happens.
    ngs : NgsStream, optional
        The frames of an NGS.

    Raises
    ------
    StreamError
        The streams have not the modes of the wiring.
    """

    def __init__(
        self,
        source: SourceStream,
        sink: SinkStream | None,
        wiring: Wiring,
        observer: StateObserver,
        say: Callable[[str], None],
        ngs: NgsStream | None,
    ):
        for stream in (source, sink):
            if stream is not None:
                check_elements(stream, wiring.elements)
        self._source, self._sink, self._wiring, self._say = source, sink, wiring, say
        self._elements, self._missing = np.array(wiring.elements), np.full(len(wiring.elements), np.nan)
        self._semaphore: Semaphore | None = None
        self._semaphore_number: int | None = None
        self._count, self._alive = source.first, 0.0
        self._is_stuck = self._is_overtaken = False
        self._ngs, self._frames = ngs, GoingBack(observer)
        self._restart = observer.reset
        self.tally: Tally = Tally(observer.sampling.dt)

    @property
    @abstractmethod
    def reason(self) -> str:
        """Why a fallback is sent; "" while the answers of the observer or controller are."""

    @property
    @abstractmethod
    def safe(self) -> Array:
        """What is sent where there is no answer, (n_modes,) [um]."""

    @abstractmethod
    def _fall_back(self, reason: str) -> None:
        """Send the safe output for a while, and say why."""

    @abstractmethod
    def _restart_gates(self) -> None:
        """Reset the gates; the observer or controller has been reset."""

    @abstractmethod
    def _answer(self, arrival: float, measurement: Array, missing: int) -> None:
        """Process the measurement of a frame, (n_modes,) [um], after `missing` frames that were lost, and send the answer."""

    def run(
        self, seconds: float, *, report: Callable[[str], None] = lambda _: None, stop: Callable[[], bool] = lambda: False
    ) -> None:
        """Follow the stream for so long [s], or until `stop` says so; at the end, whatever ends it, the safe output is sent.

        Parameters
        ----------
        seconds : float
            Duration.
        report : callable
            Receives a line of statistics each second.
        stop : callable
            Whether to end.
        """
        self._claim()
        gc.collect()
        gc.freeze()
        self._alive = now = monotonic()
        end, spoken = now + seconds, now + 1.0
        try:
            while now < end and not stop():
                if self._source.wait(self._count, min(TICK, self._wiring.stuck, end - now), self._semaphore):
                    self._alive, self._is_stuck = monotonic(), False
                    self._take(self._alive)
                elif monotonic() - self._alive >= self._wiring.stuck:
                    self._stand_still()
                now = monotonic()
                if now >= spoken:
                    report(self._line())
                    if off_rate := self.tally.find_rate_error():
                        self._say(f"{self._source.path}: {off_rate}")
                    spoken += 1.0
        finally:
            gc.unfreeze()
            self._send(self.safe)
            self._release()

    def _claim(self) -> None:
        """Take the semaphore that is wanted, or another one where a process waits for it: two would take each other's frames."""
        if (wanted := self._wiring.semaphore) is None:
            return
        self._semaphore_number = self._source.claim(wanted)
        if self._semaphore_number != wanted:
            self._say(f"{self._source.path}: another process waits for semaphore {wanted}; taking {self._semaphore_number}")
        self._semaphore = self._source.semaphore(self._semaphore_number)
        if self._semaphore is not None:
            self._semaphore.drain()

    def _release(self) -> None:
        if self._semaphore_number is not None:
            self._source.release(self._semaphore_number)
            self._semaphore_number = None

    def _take(self, arrival: float) -> None:
        """Take the newest frame, and answer it."""
        found = self._source.read()
        if found is None:
            self.tally.torn += 1
            self._fall_back("a frame is being written without an end")
            self._send(self.safe)
            return
        count, values = found
        lost = count - self._count - 1
        if lost < 0 or lost > LONGEST_GAP:
            self._start_anew(count, f"the counter went from {self._count} to {count}")
            lost = 0
        self._count = count
        with np.errstate(over="ignore", invalid="ignore"):
            measurement = values[self._elements] * self._wiring.unit
        self._answer(arrival, measurement, lost)

    def _look_for_ngs(self) -> tuple[Array | None, int]:
        """Return the NGS measurement that is new, and how many frames ago it should have been there.

        Where the NGS frames belong to other LGS frames than assumed so far, the observer or controller starts anew.
        """
        if self._ngs is None:
            return None, 0
        write_time = self._source.write_time
        if self._source.count != self._count:  # that of a newer frame: what the NGS has by now waits for it
            return None, 0
        found = self._ngs.look(self._count, write_time)
        phase = self._ngs.phase
        if phase is not None and self._frames.align((self._count - phase) % self._ngs.ratio):
            self._restart_gates()
            self._fall_back("the NGS frames have found their place")
        if found is None:
            return None, 0
        late, ngs = found
        return ngs, late

    def _send_in_time(self, answer: Array) -> bool:
        """Send it, unless a newer frame is there: the next answer follows at once, and who waits for it must not get this one."""
        self._is_overtaken = self._source.count != self._count and not self._is_overtaken
        if not self._is_overtaken:
            self._send(answer)
        return not self._is_overtaken

    def _stand_still(self) -> None:
        """No frame has come: send the safe output once, and look for a new stream at the same place."""
        if not self._is_stuck:
            self._is_stuck = True
            self.tally.stuck += 1
            self._say(f"{self._source.path}: no frame for {self._wiring.stuck:g} s")
            self._fall_back("stuck")
            self._send(self.safe)
        if not self._source.is_current:
            self._follow_new_file()

    def _follow_new_file(self) -> None:
        try:
            new = self._source.reopen()
        except StreamError:
            return
        if new.n != self._source.n:
            raise StreamError(f"{new.path}: made anew with {new.n} numbers a frame, it had {self._source.n}")
        self._release()
        self._source = new
        self._claim()
        self._start_anew(new.count, "the stream was made anew")

    def _start_anew(self, count: int, reason: str) -> None:
        """Begin at a counter that has nothing to do with the one before, and say so."""
        if self._ngs is not None:
            self._ngs.restart()
        self._restart()
        self._frames.forget()
        self._restart_gates()
        self._count = count
        self._say(reason)
        self._fall_back(reason)

    def _send(self, answer: Array) -> None:
        if self._sink is not None:
            self._sink.write(answer / self._wiring.unit, self._elements)

    def _line(self) -> str:
        line = self.tally.line(self.reason)
        return line if self._ngs is None else f"{line}; {self._ngs.line()}"

    def summary(self) -> dict[str, Any]:
        """Return counts, latencies [us] and errors [nm] so far, as JSON takes them."""
        ngs = {} if self._ngs is None else self._ngs.summary()
        return {**self.tally.summary(), **ngs, "output": self.reason or "on"}
