"""An observer on a stream of pseudo-open-loop modes: what it expects goes to another stream, frame by frame."""

from __future__ import annotations

import gc
from collections.abc import Callable
from time import monotonic
from typing import Any

import numpy as np

from wfsobs.observers.base import TARGETS
from wfsobs.observers.step import StepObserver
from wfsobs.streams.going_back import GoingBack
from wfsobs.streams.layout import StreamError
from wfsobs.streams.ngs_frames import NgsStream
from wfsobs.streams.semaphores import Semaphore
from wfsobs.streams.stream import SinkStream, SourceStream
from wfsobs.streams.tally import Tally
from wfsobs.streams.watchdog import Gate, Watchdog
from wfsobs.streams.wiring import Wiring, check_elements
from wfsobs.typing import Array

TICK = 0.05
"""Longest wait for a frame before a look at the clock and at the wish to stop [s]."""
LONGEST_GAP = 1000
"""Missing frames that an observer is taken through; after more of them it starts anew."""


class Attachment:
    """An observer between two streams.

    Parameters
    ----------
    source : SourceStream
        Pseudo-open-loop modes, one frame after the other.
    sink : SinkStream or None
        Where the estimates go, frames as long as those of the source; None writes nothing.
    observer : StepObserver
        Before its first frame.
    wiring : Wiring
        Modes, unit, horizon, limits.
    say : callable
        Receives one line about whatever happens.
    ngs : NgsStream, optional
        The frames of an NGS, for an observer that takes them.

    Raises
    ------
    StreamError
        The streams have not the modes of the wiring.
    """

    def __init__(
        self,
        source: SourceStream,
        sink: SinkStream | None,
        observer: StepObserver,
        wiring: Wiring,
        say: Callable[[str], None],
        ngs: NgsStream | None = None,
    ):
        for stream in (source, sink):
            if stream is not None:
                check_elements(stream, wiring.elements)
        self._source, self._sink, self._observer, self._wiring, self._say = source, sink, observer, wiring, say
        self._elements = np.array(wiring.elements)
        self._watchdog = Watchdog(wiring.largest, wiring.safety, say, wiring.warm_up)
        self._gate, self._ngs_gate = Gate(wiring.spread, wiring.largest), Gate(wiring.spread, wiring.largest)
        self._semaphore: Semaphore | None = None
        self._semaphore_number: int | None = None
        self._missing = np.full(len(wiring.elements), np.nan)
        self._count, self._alive = source.first, 0.0
        self._is_stuck = self._is_overtaken = False
        self._ngs, self._frames = ngs, GoingBack(observer)
        self.tally = Tally(observer.sampling.dt)

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
            self._send(self._watchdog.safe)
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
        """Take the newest frame, and send what is expected of a later one."""
        found = self._source.read()
        if found is None:
            self.tally.torn += 1
            self._watchdog.fall_back("a frame is being written without an end")
            self._send(self._watchdog.safe)
            return
        count, values = found
        lost = count - self._count - 1
        if lost < 0 or lost > LONGEST_GAP:
            self._start_anew(count, f"the counter went from {self._count} to {count}")
            lost = 0
        self._count = count
        for _ in range(lost):
            self._frames.update(self._missing)
        if lost:
            self._expect()
        with np.errstate(over="ignore", invalid="ignore"):
            measured = values[self._elements] * self._wiring.unit
        found_ngs = self._look_for_ngs()
        z, error = self._gate.accept(measured), measured - self._gate.mean
        beyond = max(self._gate.beyond.max(), self._ngs_gate.beyond.max())
        output = self._watchdog.output(self._step(z, *found_ngs), z, beyond, lost)
        self._is_overtaken = self._source.count != count and not self._is_overtaken
        if not self._is_overtaken:  # else the next answer follows at once, and who waits for it must not get this one
            self._send(output)
        self.tally.add(arrival, monotonic(), lost, measured, error, not np.array_equal(z, measured, equal_nan=True))
        self._observer.settle()
        self._frames.keep()
        self._expect()

    def _look_for_ngs(self) -> tuple[Array | None, int]:
        """Return the NGS measurement that is new, and how many frames ago it should have been there.

        Where NGS frames have another place than the observer has been given them in, it starts anew.
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
            self._watchdog.fall_back("the NGS frames have found their place")
        return (None, 0) if found is None else (self._ngs_gate.accept(found[1]), found[0])

    def _step(self, z: Array, ngs: Array | None, late: int) -> Array:
        self._frames.update(z, ngs, late)
        return sum(
            (self._observer.predict(self._wiring.ahead - 1, target)[0] for target in self._observer.targets), np.zeros_like(z)
        )

    def _expect(self) -> None:
        """Keep what the next measurement should be, and how sure that is: the deviations of the parts added up.

        Observers of both sensors predict no errors of the LGS, so that they state no deviation of its measurement.
        """
        observer = self._observer
        if observer.estimator.horizon or len(observer.targets) < len(TARGETS):
            return
        parts = [observer.predict(0, target) for target in observer.targets]
        self._gate.mean = self._ngs_gate.mean = sum((mean for mean, _ in parts), np.zeros_like(self._missing))
        if self._ngs is None:
            self._gate.sd = sum((sd for _, sd in parts), self._wiring.noise)

    def _restart_gates(self) -> None:
        self._gate.restart()
        self._ngs_gate.restart()

    def _stand_still(self) -> None:
        """No frame has come: send the safe output once, and look for a new stream at the same place."""
        if not self._is_stuck:
            self._is_stuck = True
            self.tally.stuck += 1
            self._say(f"{self._source.path}: no frame for {self._wiring.stuck:g} s")
            self._watchdog.fall_back("stuck")
            self._send(self._watchdog.safe)
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
        """Begin at a counter that has nothing to do with the one before."""
        if self._ngs is not None:
            self._ngs.restart()
        self._observer.reset()
        self._frames.forget()
        self._restart_gates()
        self._count = count
        self._say(reason)
        self._watchdog.fall_back(reason)

    def _send(self, estimate: Array) -> None:
        if self._sink is not None:
            self._sink.write(estimate / self._wiring.unit, self._elements)

    def _line(self) -> str:
        line = self.tally.line(self._watchdog.reason)
        return line if self._ngs is None else f"{line}; {self._ngs.line()}"

    def summary(self) -> dict[str, Any]:
        """Return counts, latencies [us] and errors [nm] so far, as JSON takes them."""
        ngs = {} if self._ngs is None else self._ngs.summary()
        return {**self.tally.summary(), **ngs, "fallbacks": self._watchdog.trips, "output": self._watchdog.reason or "on"}
