"""Frames of a loop in shared memory."""

from __future__ import annotations

from itertools import pairwise
from time import monotonic
from typing import NamedTuple

from wfsobs.live.rows import Rows
from wfsobs.typing import Array

CAPACITY = 1 << 17
"""Frames in the ring: two minutes at 1 kHz."""


LATE = 1e-3
"""From which delay a frame counts as late [s]."""


class LiveFrame(NamedTuple):
    """One frame of a loop, or several, with one row each.

    due : when it was due, on the monotonic clock [s];  z, ngs, u : see `StepObserver.update`, (n_modes,) [um]
    turbulence, vibration : truth, (n_modes,) [um]; NaN where there is none
    """

    due: Array | float
    z: Array
    ngs: Array
    u: Array
    turbulence: Array
    vibration: Array


class Ring(Rows):
    """A ring of frames.

    Parameters
    ----------
    n_modes : int
        Number of modes.
    name : str, optional
        That of a ring that exists.
    """

    def __init__(self, n_modes: int, name: str | None = None):
        super().__init__(1 + 5 * n_modes, CAPACITY, name)
        self._parts = [1 + i * n_modes for i in range(6)]

    @property
    def late(self) -> int:
        """Number of frames that were sent more than LATE after they were due."""
        return int(self._head[2])

    def send(self, row: Array) -> None:
        """Append a frame, the time first at which it was due."""
        self.write(row)
        self._head[2] += monotonic() - row[0] > LATE

    def read(self, index: int) -> LiveFrame | None:
        """Return the frame of this number, None where it has been overwritten."""
        row = self.read_row(index)
        return None if row is None else LiveFrame(float(row[0]), *(row[a:b] for a, b in pairwise(self._parts)))

    def read_frames(self, first: int, stop: int) -> LiveFrame:
        """Return the frames first ... stop - 1, each part (n, n_modes), the times (n,); NaN where there is none any more."""
        rows = self.read_rows(first, stop)
        return LiveFrame(rows[:, 0], *(rows[:, a:b] for a, b in pairwise(self._parts)))
