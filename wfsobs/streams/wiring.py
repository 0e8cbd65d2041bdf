"""How streams are read and written: what a stream can do, which number is which mode, and when an estimate is sent.

A stream is shared memory (`SharedImage`) or a network (`Subscription`, `Publication`); estimates go out while all is well.

The frames of a second, slower sensor go each with the LGS frame that it belongs to: their exposures end together. One that comes
after its LGS frame goes to its place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, Literal, Protocol, Self

import numpy as np

from wfsobs.record import Sampling
from wfsobs.signal.gate import RUN, GateSettings
from wfsobs.streams.shared_image import Semaphore, StreamError
from wfsobs.typing import Array

# Each is described where it is written, in SharedImage.
# ruff: noqa: D102


class AnyStream(Protocol):
    """Frames of `n` numbers."""

    path: str

    @property
    def n(self) -> int: ...


class FrameStream(AnyStream, Protocol):
    """A stream that is read."""

    first: int

    @property
    def count(self) -> int: ...

    @property
    def write_time(self) -> int: ...

    @property
    def is_current(self) -> bool: ...

    def read(self, patience: float = ..., /) -> tuple[int, Array] | None: ...

    def reopen(self) -> Self: ...


class SourceStream(FrameStream, Protocol):
    """A stream that is read and waited for."""

    def catch_up(self) -> int: ...

    def wait(self, after: int, seconds: float, semaphore: Semaphore | None = ..., /) -> bool: ...

    def claim(self, number: int, /) -> int: ...

    def semaphore(self, number: int, /) -> Semaphore | None: ...

    def release(self, number: int, /) -> None: ...


class SinkStream(AnyStream, Protocol):
    """A stream that is written."""

    def write(self, values: Array, elements: Array, /) -> None: ...


Fallback = Literal["zero", "hold"]

LIMIT = 10.0
"""Magnitude that no estimate may have unless told, over the rms of a measurement by the prior."""


@dataclass(frozen=True)
class Safety:
    """When an estimate is not sent.

    fallback : what is sent in its place
    largest  : magnitude that no estimate may have [um]; None is `LIMIT` times the rms of a measurement of that mode by the prior
    missing  : frames in a row that may be missing
    calm     : frames in a row, all well, after which the estimate is sent again
    """

    fallback: Fallback = "zero"
    largest: float | None = None
    missing: int = 10
    calm: int = 1000


class Watchdog:
    """Decides in every frame what is sent.

    Parameters
    ----------
    largest : Array
        Magnitude that no estimate may have, (n_modes,) [um].
    safety : Safety
        When an estimate is not sent.
    say : callable
        Receives one line whenever that changes.
    warm_up : int
        Frames before the first estimate is sent.

    Attributes
    ----------
    reason : str
        Why the estimate is not sent; "" while it is.
    trips : int
        Times that it fell back.
    """

    trips: int

    def __init__(self, largest: Array, safety: Safety, say: Callable[[str], None], warm_up: int = 0):
        self.reason, self.trips = ("the observer starts" if warm_up else ""), 0
        self._largest, self._safety, self._say = largest, safety, say
        self._good, self._left, self._missing = np.zeros(largest.size), warm_up, 0

    def output(self, estimate: Array, z: Array, beyond: int, missing: int) -> Array:
        """Return what is sent after a frame.

        Parameters
        ----------
        estimate : Array
            Of the observer, (n_modes,) [um].
        z : Array
            The measurement that it has taken, (n_modes,) [um].
        beyond : int
            Outliers in a row, this one among them.
        missing : int
            Frames missing in a row before this one.
        """
        is_missing = bool(np.isnan(z).all())
        missing += self._missing + is_missing
        self._missing = missing if is_missing else 0
        if found := self._fault(estimate, beyond, missing):
            self.fall_back(found)
        elif self._left:
            self._left -= 1
            if not self._left:
                self._return()
        if self.reason:
            return self.safe
        if not beyond:
            self._good[:] = estimate
        return estimate

    @property
    def safe(self) -> Array:
        """What is sent in place of an estimate, (n_modes,) [um]."""
        return self._good if self._safety.fallback == "hold" else np.zeros_like(self._good)

    def fall_back(self, reason: str) -> None:
        """Send no estimate until all has been well for a while."""
        if not self.reason:
            self.trips += 1
            self._say(f"{reason}: output falls back to {self._safety.fallback}")
        self.reason, self._left = reason, self._safety.calm

    def _return(self) -> None:
        limits = ", ".join(f"{x:.4g}" for x in self._largest)
        again = f"output on again after {self._safety.calm} good frames"
        self._say(again if self.trips else f"output on, of estimates up to {limits} um")
        self.reason = ""

    def _fault(self, estimate: Array, beyond: int, missing: int) -> str:
        if not np.isfinite(estimate).all():
            return "the estimate is not finite"
        if (too_large := ~(np.abs(estimate) <= self._largest)).any():
            return f"the estimate exceeds {self._largest[too_large][0]:.4g} um"
        if missing > self._safety.missing:
            return f"{missing} frames in a row are missing"
        if beyond >= RUN:
            return f"{RUN} measurements in a row are outliers"
        return ""


STUCK = 0.1
"""Time without a frame after which a stream is stuck [s]."""


@dataclass(frozen=True)
class Wiring:
    """How an observer is attached.

    elements : number in a frame of the stream of each mode of the observer
    unit     : micrometres per unit of the streams
    ahead    : frames from the newest measurement to the one that is to be met
    spread   : rms of a measurement by the prior, (n_modes,) [um]
    stuck    : time without a frame after which the stream is stuck [s]
    semaphore : number of the semaphore that is waited for, where no other process does; None looks at the counter
    gate     : how outliers are kept from the observer; by default not at all
    """

    elements: tuple[int, ...]
    unit: float
    ahead: float
    spread: Array
    safety: Safety = field(default_factory=Safety)
    warm_up: int = 0
    stuck: float = STUCK
    semaphore: int | None = None
    gate: GateSettings | None = None

    @property
    def largest(self) -> Array:
        """Magnitude that no estimate may have, (n_modes,) [um]."""
        told = self.safety.largest
        return LIMIT * self.spread if told is None else np.full(self.spread.size, told)


@dataclass(frozen=True)
class NgsWiring:
    """How the frames of an NGS are read.

    elements : number in a frame of the stream of each mode of the observer
    unit     : micrometres per unit of the stream
    ratio    : LGS frames per NGS frame, by the design
    lag      : LGS frames that come after the one that an NGS frame belongs to, before the NGS frame is there; below `ratio`
    stuck    : time without a frame after which the stream is stuck [s]
    """

    elements: tuple[int, ...]
    unit: float
    ratio: int
    lag: int = 0
    stuck: float = STUCK


def check_elements(stream: AnyStream, elements: Sequence[int]) -> None:
    """Raise StreamError where a frame has not all of these numbers."""
    if max(elements) >= stream.n:
        raise StreamError(f"{stream.path}: mode {max(elements)}: a frame has {stream.n} numbers, 0 to {stream.n - 1}")


SEARCH = 20
"""NGS frames from which their place among the LGS frames is found."""
LONGEST_SEARCH = 200
"""NGS frames that it is found from at most: the search is twice as long each time that a place has not held."""
LONGEST_GAP = 1000
"""NGS frames that may be missing in a row; after more of them the counter is taken for another one."""
TOO_LATE = 10
"""NGS frames in a row that come too late before their place is looked for anew."""


class NgsStream:
    """The stream of an NGS beside that of the LGS, which keeps the time.

    An NGS frame that is there when the LGS frame of the counter c is taken, and was not when c - 1 was, belongs to c - lag if it
    came without delay. Of `SEARCH` frames the earliest is taken to have done so; from then on the counters alone say where a
    frame belongs, `ratio` LGS frames after the one before.

    Parameters
    ----------
    stream : FrameStream
        Pseudo-open-loop modes of the NGS.
    wiring : NgsWiring
        Modes, unit, ratio and lag.
    say : callable
        Receives one line about whatever happens.

    Raises
    ------
    StreamError
        The stream has not the modes of the wiring.

    Attributes
    ----------
    ratio : int
        LGS frames per NGS frame.
    phase : int or None
        Counter of an LGS frame to which an NGS frame belongs; the others are multiples of the ratio away. None unless found.
    """

    def __init__(self, stream: FrameStream, wiring: NgsWiring, say: Callable[[str], None]):
        check_elements(stream, wiring.elements)
        self._stream, self._wiring, self._say = stream, wiring, say
        self._elements, self._count, self._alive = np.array(wiring.elements), stream.first, monotonic()
        self.ratio: int = wiring.ratio
        self.phase: int | None = None
        self._write_time = 0
        self._first = 0  # counter of the NGS frame that belongs to the LGS frame `phase`
        self._search, self._pairs = SEARCH, list[tuple[int, int]]()
        self._is_stuck = self._is_off_rate = False
        self._n_frames = self._n_late = self._n_missing = self._too_late = 0

    def look(self, count: int, write_time: int = 0) -> tuple[int, Array] | None:
        """Return the NGS frame that has come since the last call.

        Who is late to take an LGS frame may find an NGS frame that has come after it: that waits for the next call. The times
        at which both were written tell, where both writers say them.

        Parameters
        ----------
        count : int
            Counter of the LGS frame that is being taken.
        write_time : int
            When that was written [ns]; 0 where it is not known.

        Returns
        -------
        (int, Array) or None
            How many LGS frames ago the one was that it belongs to, 0 to ratio - 1, and its measurement, (n_modes,) [um], NaN
            where it is not finite. None where there is none, or where its place is not known.
        """
        says_when, self._write_time = write_time > self._write_time > 0, write_time
        if self._stream.count == self._count:
            self._check_alive()
            return None
        if says_when and self._stream.write_time > write_time:
            return None
        if (frame := self._stream.read(0.0)) is None:  # it is being written: the next LGS frame finds it
            self._check_alive()
            return None
        number, values = frame
        skipped, self._count = number - self._count - 1, number
        self._note_alive()
        if not 0 <= skipped <= LONGEST_GAP:
            self._lose_phase("the counter has jumped")
        self._n_frames += 1
        late = self._lateness(number, count - self._wiring.lag)
        if late is None:
            return None
        self._n_missing += max(skipped, 0) + (late >= self.ratio)
        self._n_late += late > self._wiring.lag
        if late >= self.ratio:
            return None
        z = values[self._elements] * self._wiring.unit
        return late, np.where(np.isfinite(z), z, np.nan)

    def restart(self) -> None:
        """Look for the place of the frames anew: the counter of the LGS is another one."""
        self.phase, self._pairs = None, []

    def line(self) -> str:
        """Return the counts so far, as they stand in a line of statistics."""
        return f"NGS: {self._n_frames} frames, {self._n_missing} missing, {self._n_late} late"

    def summary(self) -> dict[str, Any]:
        """Return the counts so far."""
        return {"ngs_frames": self._n_frames, "ngs_missing": self._n_missing, "ngs_late": self._n_late}

    def _lateness(self, number: int, on_time: int) -> int | None:
        """Return how many LGS frames ago the place of a frame was; None where it is not known.

        on_time : the place that it has if it came without delay
        """
        if self.phase is None:
            self._pairs.append((number, on_time))
            self._find_phase()
        if self.phase is None:
            return None
        delay = on_time - self.phase - self.ratio * (number - self._first)
        self._too_late = self._too_late + 1 if delay + self._wiring.lag >= self.ratio else 0
        if delay < 0 or self._too_late >= TOO_LATE:
            self._search = min(2 * self._search, LONGEST_SEARCH)
            self._lose_phase(f"a frame is {-delay} LGS frames early" if delay < 0 else f"{TOO_LATE} frames in a row are too late")
            return None
        return delay + self._wiring.lag

    def _find_phase(self) -> None:
        """Take the earliest of the frames seen as one that came without delay; they must come at the rate of the design."""
        (n0, c0), (n1, c1) = self._pairs[0], self._pairs[-1]
        if n1 - n0 < self._search - 1:
            return
        ratio = self.ratio
        offsets = [place - ratio * number for number, place in self._pairs]
        self._pairs = []
        half = len(offsets) // 2
        if abs(min(offsets[:half]) - min(offsets[half:])) >= 0.5 * ratio:
            if not self._is_off_rate:
                self._is_off_rate = True
                rate = (c1 - c0) / (n1 - n0)
                self._tell(f"one frame in {rate:.1f} of the LGS, the observer is designed for {ratio}: on with the LGS alone")
            return
        self._is_off_rate, self._too_late = False, 0
        self._first, self.phase = n1, min(offsets) + ratio * n1
        self._tell(f"one frame in {ratio} of the LGS")

    def _lose_phase(self, reason: str) -> None:
        if self.phase is not None:
            self._tell(f"{reason}: on with the LGS alone until their place is found")
        self.restart()

    def _note_alive(self) -> None:
        self._alive = monotonic()
        if self._is_stuck:
            self._is_stuck = False
            self._tell("frames again")

    def _check_alive(self) -> None:
        """Say once that no frame comes; follow the new file of a program that has started anew."""
        if monotonic() - self._alive < self._wiring.stuck:
            return
        if not self._is_stuck:
            self._is_stuck = True
            self._tell(f"no frame for {self._wiring.stuck:g} s: on with the LGS alone")
        self._alive = monotonic()
        if self._stream.is_current:
            return
        try:
            new = self._stream.reopen()
            check_elements(new, self._wiring.elements)
        except StreamError:  # not yet, or not what it was: the LGS go on
            return
        self._stream, self._count = new, new.count
        self._lose_phase("made anew")

    def _tell(self, line: str) -> None:
        self._say(f"{self._stream.path}: {line}")


class StateObserver(Protocol):
    """What it takes of a `StepObserver`."""

    @property
    def frame(self) -> int: ...

    @property
    def sampling(self) -> Sampling: ...

    def update(self, z: Array, ngs: Array | None = None, /) -> None: ...

    def reset(self) -> None: ...

    def state_dict(self) -> dict[str, Array]: ...

    def load_state_dict(self, state: Mapping[str, Array], /) -> None: ...


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
