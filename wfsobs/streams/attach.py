"""An observer on a stream of pseudo-open-loop modes: what it expects goes to another stream, frame by frame."""

from __future__ import annotations

import gc
from collections.abc import Callable, Mapping, Sequence
from time import monotonic
from typing import Any, Protocol

import numpy as np

from wfsobs.latencies import Latencies
from wfsobs.observers.base import TARGETS
from wfsobs.observers.step import StepObserver
from wfsobs.record import Sampling
from wfsobs.signal.gate import OutlierGate, frame_mean_of
from wfsobs.streams.layout import Semaphore, StreamError
from wfsobs.streams.ngs_frames import NgsStream
from wfsobs.streams.stream import FrameStream, SinkStream, SourceStream
from wfsobs.streams.watchdog import Watchdog
from wfsobs.streams.wiring import Wiring, check_elements
from wfsobs.typing import Array


class StateObserver(Protocol):
    """What it takes of a `StepObserver`."""

    @property
    def frame(self) -> int: ...  # noqa: D102

    @property
    def sampling(self) -> Sampling: ...  # noqa: D102

    def update(self, z: Array, ngs: Array | None = None, /) -> None: ...  # noqa: D102

    def reset(self) -> None: ...  # noqa: D102

    def state_dict(self) -> dict[str, Array]: ...  # noqa: D102

    def load_state_dict(self, state: Mapping[str, Array], /) -> None: ...  # noqa: D102


class GoingBack:
    """Takes LGS frames as they come, and an NGS frame up to one NGS frame later than it is due.

    The state before the last frame with an NGS measurement is kept, and what has come since; a late NGS frame goes to its place
    and the LGS frames after it are taken again. From then on the observer is where it would be had the frame come in time.

    Parameters
    ----------
    observer : StateObserver
        Of a sampling with a ratio; without one there is nothing to go back for.
    """

    def __init__(self, observer: StateObserver):
        self._observer, self._ratio = observer, observer.sampling.ratio
        self._state: dict[str, Array] | None = None
        self._since: list[Array] = []

    def update(self, z: Array, ngs: Array | None = None, late: int = 0) -> None:
        """Take a frame.

        Parameters
        ----------
        z : Array
            LGS measurement, (n_modes,) [um].
        ngs : Array, optional
            NGS measurement, (n_modes,) [um], of the frame `late` before this one; the first frame of an observer has none.
        late : int
            LGS frames, below the ratio.
        """
        observer = self._observer
        if ngs is not None and late:
            self._take_late(ngs, late)
            ngs = None
        if self._ratio is not None:
            self.keep()
            self._since.append(z)
        observer.update(z, ngs if observer.frame else None)

    def keep(self) -> None:
        """Keep the state where the next frame is one with an NGS measurement; `update` does it otherwise."""
        if self._ratio is not None and self._observer.frame % self._ratio == 0 and (self._since or self._state is None):
            self._state, self._since = self._observer.state_dict(), []

    def align(self, age: int) -> bool:
        """Start the observer anew unless its last frame with an NGS measurement was so many frames before the next one.

        age : 0 to ratio - 1, 0 where the next one has an NGS measurement
        """
        observer = self._observer
        if self._ratio is None or observer.frame % self._ratio == age:
            return False
        observer.reset()
        self.forget()
        for _ in range(age):
            self.update(np.full(observer.sampling.n_modes, np.nan))
        return True

    def forget(self) -> None:
        """Start anew with an observer that does."""
        self._state, self._since = None, []

    def _take_late(self, ngs: Array, late: int) -> None:
        first = self._observer.frame - late
        if self._state is None or late != len(self._since) or first <= 0:
            return
        self._observer.load_state_dict(self._state)
        for k, z in enumerate(self._since):
            self._observer.update(z, ngs if k == 0 else None)


SLOW = 1.5
"""A frame is late if it comes more than so many frame times after the one before."""
RATE_ERROR = 0.05
"""Part of the rate by which a loop may be off the design."""
NANOMETRE = 1e-6
"""What stands for it in a histogram, which then goes from 0.1 nm to 1 cm."""


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


class CommandStream:
    """The commands beside a stream of residual measurements, for their pseudo-open-loop z = y - m.

    One command follows from every measurement. The newest that is there when a measurement comes is that of the one before, in
    most of the first `FIRST` frames; from then on the counters alone say to which a command belongs. Where the newest is older
    than that for `FIRST` frames, commands have been left out, and the counters go on from there.

    Parameters
    ----------
    stream : FrameStream
        Commands, frames with the elements of the measurements.
    elements : sequence of int
        Number in a frame of each mode.
    scale : Array
        Micrometres that the mirror does per unit of a command, with its sign, (n_modes,) or ().
    delay : float
        Frames from a command to the first measurement that sees it, 1 or more: m[k] = (1 - p) u[k-d] + p u[k-d-1].

    Attributes
    ----------
    missing : int
        Measurements whose command was not there.
    """

    def __init__(self, stream: FrameStream, elements: Sequence[int], scale: Array, delay: float):
        check_elements(stream, elements)
        self._stream, self._elements, self._scale = stream, np.array(elements), scale
        self._whole, self._part = int(delay), delay % 1.0
        self._count = stream.first
        self.missing: int = 0
        self.restart()

    def restart(self) -> None:
        """Look anew for which command belongs to which measurement: a counter is another one."""
        self._offset: int | None = None
        self._offsets: list[int] = []
        self._rows: dict[int, Array] = {}

    def open_loop(self, count: int, y: Array) -> Array:
        """Return z of a measurement (n_modes,) [um] with this counter; NaN where its command is not known."""
        if self._stream.count != self._count and (frame := self._stream.read(0.0)) is not None:
            if not 0 < frame[0] - self._count <= LONGEST_GAP:
                self.restart()
            self._count = frame[0]
            self._rows[self._count] = frame[1][self._elements] * self._scale
            self._offsets = [*self._offsets, count - 1 - self._count][-FIRST:]
            if len(self._offsets) == FIRST:
                first = int(np.median(self._offsets)) if self._offset is None else self._offset
                self._offset = max(first, min(self._offsets))
        if self._offset is None:
            return np.full_like(y, np.nan)
        at = count - self._offset
        now, before = (self._rows.get(at - lag, np.full_like(y, np.nan)) for lag in (self._whole, self._whole + 1))
        m = now if self._part == 0.0 else (1.0 - self._part) * now + self._part * before
        for old in [row for row in self._rows if row < at - self._whole]:
            del self._rows[old]
        self.missing += bool(np.isnan(m).any())
        return y - m


FIRST = 9
"""Commands from which their place is found: fewer than the measurements that may be missing."""


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
        self._first, self._last = self._first or arrival, arrival

    @property
    def rate(self) -> float | None:
        """Frames per second that were sent, missing ones too [Hz]."""
        if self._first is None or self._last is None or self._last <= self._first:
            return None
        return (self._all.frames - 1 + self._all.missing) / (self._last - self._first)

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
    commands : CommandStream, optional
        Commands, where the source has residual measurements.

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
        commands: CommandStream | None = None,
    ):
        for stream in (source, sink):
            if stream is not None:
                check_elements(stream, wiring.elements)
        self._source, self._sink, self._observer, self._wiring, self._say = source, sink, observer, wiring, say
        self._elements = np.array(wiring.elements)
        self._watchdog = Watchdog(wiring.largest, wiring.safety, say, wiring.warm_up)
        self._gate, self._ngs_gate = SafeGate(wiring, 2 * ngs.ratio if ngs else 1), SafeGate(wiring)
        self._semaphore: Semaphore | None = None
        self._semaphore_number: int | None = None
        self._missing = self._forecast = np.full(len(wiring.elements), np.nan)
        self._count, self._alive = source.first, 0.0
        self._is_stuck = self._is_overtaken = False
        self._ngs, self._commands, self._frames = ngs, commands, GoingBack(observer)
        self.tally: Tally = Tally(observer.sampling.dt)

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
            self._frames.update(self._gate.accept(self._missing))
            self._gate.settle()
        if lost:
            self._expect()
        with np.errstate(over="ignore", invalid="ignore"):
            measured = values[self._elements] * self._wiring.unit
            if self._commands is not None:
                measured = self._commands.open_loop(count, measured)
        ngs, late = self._look_for_ngs()
        z, error = self._gate.accept(measured), measured - self._forecast
        if ngs is not None and self._ngs is not None:
            ngs = self._ngs_gate.accept(ngs, frame_mean_of(self._gate.history[late : late + self._ngs.ratio]))
            self._ngs_gate.settle()
        beyond = max(self._gate.beyond, self._ngs_gate.beyond)
        output = self._watchdog.output(self._step(z, ngs, late), z, beyond, lost)
        self._is_overtaken = self._source.count != count and not self._is_overtaken
        if not self._is_overtaken:  # else the next answer follows at once, and who waits for it must not get this one
            self._send(output)
        self.tally.add(arrival, monotonic(), lost, measured, error, not np.array_equal(z, measured, equal_nan=True))
        self._observer.settle()
        self._gate.settle()
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
        if found is None:
            return None, 0
        late, ngs = found
        return ngs, late

    def _step(self, z: Array, ngs: Array | None, late: int) -> Array:
        self._frames.update(z, ngs, late)
        return sum(
            (self._observer.predict(self._wiring.ahead - 1, target)[0] for target in self._observer.targets), np.zeros_like(z)
        )

    def _expect(self) -> None:
        """Keep what the next measurement should be, for the statistics."""
        observer = self._observer
        if not observer.estimator.horizon and len(observer.targets) == len(TARGETS):
            self._forecast = sum((observer.predict(0, target)[0] for target in observer.targets), np.zeros_like(self._missing))

    def _restart_gates(self) -> None:
        self._forecast = self._missing
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
        if self._commands is not None:
            self._commands.restart()
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
        ngs = {} if self._ngs is None else {**self._ngs.summary(), "ngs_outliers": self._ngs_gate.outliers.tolist()}
        ngs |= {} if self._commands is None else {"commands_missing": self._commands.missing}
        counts = {"outliers": self._gate.outliers.tolist(), **ngs}
        return {**self.tally.summary(), **counts, "fallbacks": self._watchdog.trips, "output": self._watchdog.reason or "on"}
