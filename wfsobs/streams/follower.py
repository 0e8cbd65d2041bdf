"""Following a stream: every frame is answered, and whatever becomes of the stream, what is sent is safe.

What is counted meanwhile are frames, latencies, and how far off the next measurement was. Histograms hold the latencies, and
other numbers that span decades: their quantiles take no more room however long a loop runs.
"""

from __future__ import annotations

import gc
from abc import ABC, abstractmethod
from collections.abc import Callable
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wfsobs.signal.gate import OutlierGate
from wfsobs.streams.shared_image import Semaphore, StreamError
from wfsobs.streams.wiring import GoingBack, NgsStream, SinkStream, SourceStream, StateObserver, Wiring, check_elements
from wfsobs.typing import Array

EDGES = np.geomspace(1e-7, 10.0, 1601)
"""Edges of the bins [s]: each 1.2 % above the one before, which is how exact a quantile is."""


class Latencies:
    """Histogram of the times that an observer takes for its frames.

    Parameters
    ----------
    counts : array, optional
        Counts of the bins to go on with, (1602,): below the first edge, between edges, above the last one.
    """

    def __init__(self, counts: NDArray[np.int64] | None = None) -> None:
        self.counts: NDArray[np.int64] = np.zeros(len(EDGES) + 1, dtype=np.int64) if counts is None else counts

    def add(self, latency: float | NDArray[np.float64]) -> None:
        """Count a latency, or several [s]."""
        np.add.at(self.counts, np.searchsorted(EDGES, latency), 1)

    def quantile(self, share: float) -> float:
        """Return a quantile, rounded up to the next edge [s]; NaN without a latency."""
        if not (total := self.counts.sum()):
            return float("nan")
        bin_ = int(np.searchsorted(np.cumsum(self.counts), share * total))
        return float(EDGES[min(bin_, len(EDGES) - 1)])


SLOW = 1.5
"""A frame is late if it comes more than so many frame times after the one before."""
RATE_ERROR = 0.05
"""Part of the rate by which a loop may be off the design."""
NANOMETRE = 1e-6
"""What stands for it in a histogram, which then goes from 0.1 nm to 1 cm."""


class _Span:
    """What is counted over a stretch of time."""

    def __init__(self) -> None:
        self.frames = self.missing = self.late = self.out_of_band = 0
        self.latencies, self.errors, self.sizes = Latencies(), Latencies(), Latencies()

    def quantile(self, share: float) -> float | None:
        """Return a quantile of the latencies [us]."""
        return round(self.latencies.quantile(share) * 1e6, 1) if self.frames else None

    def medians(self) -> tuple[float | None, float | None]:
        """Return the medians of the magnitudes of errors and of what was measured [nm]; None where nothing was predicted."""
        found = [one.quantile(0.5) / NANOMETRE for one in (self.errors, self.sizes)]
        return (None, None) if np.isnan(found[0]) else (round(found[0], 3), round(found[1], 3))


class Tally:
    """Statistics.

    Parameters
    ----------
    dt : float
        Time between two frames by the design of the observer [s].

    Attributes
    ----------
    torn, stuck : int
        Frames that were written without an end; times that no frame came.
    """

    def __init__(self, dt: float):
        self.torn = self.stuck = 0
        self._dt, self._last = dt, None
        self._second, self._all = _Span(), _Span()
        self._first: float | None = None
        self._since_first = 0
        self._is_off_rate = False

    def add(self, arrival: float, end: float, missing: int, z: Array, error: Array, is_out: bool = False) -> None:
        """Count a frame.

        Parameters
        ----------
        arrival, end : float
            When it was there and when its estimate was out [s].
        missing : int
            Frames missing before it.
        z, error : Array
            Measurement, and how far off its prediction was, (n_modes,) [um]; NaN where there is none.
        is_out : bool
            Whether a measurement was not taken.
        """
        late = self._last is not None and arrival - self._last > SLOW * self._dt * (1 + missing)
        known = np.isfinite(error)
        errors, sizes = (1e3 * NANOMETRE * np.abs(x[known]) for x in (error, z))
        for span in (self._second, self._all):
            span.frames += 1
            span.missing += missing
            span.late += late
            span.out_of_band += is_out
            span.latencies.add(end - arrival)
            span.errors.add(errors)
            span.sizes.add(sizes)
        if self._first is None:
            self._first = arrival
        else:
            self._since_first += 1 + missing
        self._last = arrival

    @property
    def rate(self) -> float | None:
        """Frames per second that were sent since the first one, missing ones too [Hz]."""
        if self._first is None or self._last is None or self._last <= self._first:
            return None
        return self._since_first / (self._last - self._first)

    def find_rate_error(self) -> str:
        """Return once that the loop runs at another rate than the observer is designed for; "" at other times."""
        rate = self.rate
        if rate is None or self._is_off_rate or abs(rate * self._dt - 1.0) <= RATE_ERROR:
            return ""
        self._is_off_rate = True
        return f"{rate:.0f} frames per second, the observer is designed for {1.0 / self._dt:g}"

    def line(self, reason: str) -> str:
        """Return the line of the last second, and begin the next one."""
        span, self._second = self._second, _Span()
        if not span.frames:
            return f"no frame; output: {reason or 'on'}"
        error, size = span.medians()
        scores = "" if error is None else f"; next measurement: {error:.1f} of {size:.1f} nm (medians)"
        return (
            f"{span.frames} frames, {span.missing} missing, {span.out_of_band} with outliers, {span.late} late; "
            f"{span.quantile(0.5):.0f}, {span.quantile(0.999):.0f} us (p50, p99.9){scores}; output: {reason or 'on'}"
        )

    def summary(self) -> dict[str, Any]:
        """Return the statistics since the start."""
        span = self._all
        error, size = span.medians()
        return {
            "frames": span.frames,
            "missing": span.missing,
            "out_of_band": span.out_of_band,
            "late": span.late,
            "torn": self.torn,
            "stuck": self.stuck,
            "rate_hz": None if self.rate is None else round(self.rate, 2),
            "p50_us": span.quantile(0.5),
            "p99_9_us": span.quantile(0.999),
            "next_median_nm": error,
            "median_nm": size,
        }


TICK = 0.05
"""Longest wait for a frame before a look at the clock and at the wish to stop [s]."""
LONGEST_GAP = 1000
"""Missing frames that an observer is taken through; after more of them it starts anew."""


FAR = 6.0
"""Rms of a measurement by the prior beyond the largest estimate that may be sent: what is farther is never taken."""


class SafeGate:
    """Keeps outliers, and numbers far beyond any estimate that may be sent, from an observer.

    Parameters
    ----------
    wiring : Wiring
        Gate, rms of a measurement, largest estimate.
    recent : int
        Measurements that are kept.

    Attributes
    ----------
    history : Array
        The last measurements as they have passed, the newest first, (recent, n_modes) [um].
    outliers : Array of int
        How many there were, (n_modes,).
    beyond : int
        How many there were in a row in a mode, the last one among them.
    """

    history: Array
    outliers: Array
    beyond: int

    def __init__(self, wiring: Wiring, recent: int = 1):
        n = wiring.spread.size
        self.history = np.full((recent, n), np.nan)
        self._gate = None if wiring.gate is None else OutlierGate(n, wiring.gate)
        self._possible, self.outliers = wiring.largest + FAR * wiring.spread, np.zeros(n, dtype=int)
        self.restart()

    def restart(self) -> None:
        """Begin anew with an observer that does."""
        self._row, self.beyond = np.zeros(self._possible.size, dtype=int), 0
        if self._gate is not None:
            self._gate.reset()

    def accept(self, z: Array, beside: Array | None = None) -> Array:
        """Return a measurement, any numbers (n_modes,) [um], with outliers NaN, or clipped; `settle` has to follow.

        beside : what a faster sensor has measured meanwhile
        """
        taken = np.where(np.abs(z) <= self._possible, z, np.nan)
        if self._gate is not None:
            expected = np.zeros_like(taken) if beside is None else beside
            taken = self._gate.check_beside(taken, expected, settles=False)
        self.history[1:], self.history[0] = self.history[:-1], taken
        is_out = ~np.isnan(z) & (taken != z)
        self.outliers += is_out
        self._row = np.where(is_out, self._row + 1, np.where(np.isnan(z), self._row, 0))
        self.beyond = int(self._row.max())
        return taken

    def settle(self) -> None:
        """Do what can wait until an estimate is out."""
        if self._gate is not None:
            self._gate.settle()


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
        self._gate, self._ngs_gate = SafeGate(wiring, 2 * ngs.ratio if ngs else 1), SafeGate(wiring)
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
        self._count = self._source.catch_up()
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
        if self._source.is_current:
            return
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

    def _restart_gates(self) -> None:
        """Reset the gates; the observer or controller has been reset."""
        self._gate.restart()
        self._ngs_gate.restart()

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
