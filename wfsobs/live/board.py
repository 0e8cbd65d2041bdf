"""What is counted of every observer, in shared memory: errors since the start, latencies, frames."""

from __future__ import annotations

from multiprocessing.shared_memory import SharedMemory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wfsobs.latencies import EDGES, Latencies
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.typing import Array

NEXT = "next"
"""The next measurement: what an observer of turbulence and vibration expects of it is their sum."""
SCORED = (*TARGETS, NEXT)
"""What errors are counted of."""
SLOTS = tuple(o.id for o in OBSERVERS.values() if o.step is not None)
"""Observers that run frame by frame; each has its place."""

Integers = NDArray[np.int64]


class Counts(NamedTuple):
    """What is counted of one observer; all are counted up in place.

    squares, samples : sums of squared errors [um^2] and their numbers, (3, n_modes) for turbulence, vibration and the next
        measurement
    latencies : histogram of its steps
    late, frames, since : steps longer than a frame, steps, first frame, (1,); `since` is -1 while it is off
    """

    squares: Array
    samples: Integers
    latencies: Latencies
    late: Integers
    frames: Integers
    since: Integers

    @classmethod
    def empty(cls, n_modes: int) -> Counts:
        """Make counts of an observer that nobody else reads."""
        shape = (len(SCORED), n_modes)
        return cls(np.zeros(shape), np.zeros(shape, dtype=np.int64), Latencies(), *np.zeros((3, 1), dtype=np.int64))

    def copy(self) -> Counts:
        """Return a copy in memory of its own."""
        latencies = Latencies(self.latencies.counts.copy())
        return Counts(self.squares.copy(), self.samples.copy(), latencies, *(part.copy() for part in self[3:]))

    def clear(self) -> None:
        """Begin anew."""
        self.latencies.clear()
        for part in (self.squares, self.samples, self.late, self.frames):
            part[:] = 0

    def rms(self, quantity: str) -> Array:
        """Return the rms error, (n_modes,) [um]; NaN without a sample."""
        at = SCORED.index(quantity)
        samples = self.samples[at].copy()
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(self.squares[at] / samples)


class Board:
    """The counts of all observers.

    Parameters
    ----------
    n_modes : int
        Number of modes.
    name : str, optional
        That of a board that exists.

    Attributes
    ----------
    totals : Integers
        Frames that all have taken, frames lost, frames that came late, whether the observers are ready, (4,).
    """

    def __init__(self, n_modes: int, name: str | None = None):
        n, scored, bins = len(SLOTS), len(SCORED) * n_modes, len(EDGES) + 1
        size = 4 + n * (2 * scored + bins + 3)
        self._memory = SharedMemory(name=name, create=name is None, size=8 * size if name is None else 0)
        self._owner = name is None
        whole = np.ndarray(size, dtype=np.int64, buffer=self._memory.buf)
        self.totals, slots = whole[:4], whole[4:].reshape(n, -1)
        shape = (len(SCORED), n_modes)
        self._counts = {
            slot: Counts(
                row[:scored].view(np.float64).reshape(shape),
                row[scored : 2 * scored].reshape(shape),
                Latencies(row[2 * scored : -3]),
                *row[-3:].reshape(3, 1),
            )
            for slot, row in zip(SLOTS, slots, strict=True)
        }
        if self._owner:
            for counts in self._counts.values():
                counts.since[0] = -1

    @property
    def name(self) -> str:
        """Name by which another process finds it."""
        return self._memory.name

    def __getitem__(self, observer: str) -> Counts:
        return self._counts[observer]

    def active(self) -> list[str]:
        """Return the ids of the observers that run."""
        return [name for name, counts in self._counts.items() if counts.since[0] >= 0]

    def release(self) -> None:
        """Give the memory back; the counts stay as they are."""
        self._counts = {name: counts.copy() for name, counts in self._counts.items()}
        self.totals = self.totals.copy()
        self._memory.close()
        if self._owner:
            self._memory.unlink()
