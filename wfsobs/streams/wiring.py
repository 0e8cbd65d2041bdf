"""How streams are read and written: what a stream can do, which number is which mode, and when an estimate is sent.

A stream is shared memory (`SharedImage`) or a network (`Subscription`, `Publication`); estimates go out while all is well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, Self

import numpy as np

from wfsobs.signal.gate import RUN, GateSettings
from wfsobs.streams.layout import Semaphore, StreamError
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
