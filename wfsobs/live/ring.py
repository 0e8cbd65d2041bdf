"""Frames in shared memory: one writer, any number of readers, none of which can hold the writer up."""

from __future__ import annotations

from itertools import pairwise
from multiprocessing.shared_memory import SharedMemory
from typing import NamedTuple

import numpy as np

from wfsobs.typing import Array

CAPACITY = 1 << 15
"""Frames in the ring: half a minute at 1 kHz."""


class LiveFrame(NamedTuple):
    """One frame of a loop.

    due : when it was due, on the monotonic clock [s];  z, ngs, u : see `StepObserver.update`, (n_modes,) [um]
    turbulence, vibration : truth, (n_modes,) [um]
    """

    due: float
    z: Array
    ngs: Array
    u: Array
    turbulence: Array
    vibration: Array


class Ring:
    """A ring of frames.

    Parameters
    ----------
    n_modes : int
        Number of modes.
    name : str, optional
        That of a ring that exists.

    Raises
    ------
    OSError
        There is no ring of this name.
    """

    def __init__(self, n_modes: int, name: str | None = None):
        width = 1 + 5 * n_modes
        size = 16 + 8 * CAPACITY * width
        self._memory = SharedMemory(name=name, create=name is None, size=size if name is None else 0)
        self._head = np.ndarray(2, dtype=np.int64, buffer=self._memory.buf)
        self._rows = np.ndarray((CAPACITY, width), buffer=self._memory.buf, offset=16)
        self._owner, self._parts = name is None, [1 + i * n_modes for i in range(6)]

    @property
    def name(self) -> str:
        """Name by which another process finds it."""
        return self._memory.name

    @property
    def count(self) -> int:
        """Number of frames written so far."""
        return int(self._head[0])

    @property
    def is_closed(self) -> bool:
        """Whether the writer has ended."""
        return bool(self._head[1])

    def write(self, row: Array) -> None:
        """Append a frame: the row first, then the count."""
        self._rows[self._head[0] % CAPACITY] = row
        self._head[0] += 1

    def read(self, index: int) -> LiveFrame | None:
        """Return the frame of this number, None where it has been overwritten."""
        row = self._rows[index % CAPACITY].copy()
        if self._head[0] - index > CAPACITY - 1:
            return None
        at = self._parts
        return LiveFrame(float(row[0]), *(row[a:b] for a, b in pairwise(at)))

    def close_writer(self) -> None:
        """Say that no frame follows."""
        self._head[1] = 1

    def release(self) -> None:
        """Give the memory back."""
        del self._head, self._rows
        self._memory.close()
        if self._owner:
            self._memory.unlink()
