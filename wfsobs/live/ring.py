"""Frames of a loop, and rows of numbers, in shared memory: one writer, any number of readers, none of which holds it up."""

from __future__ import annotations

import os
import select
import warnings
from contextlib import suppress
from itertools import pairwise
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory
from time import monotonic
from typing import NamedTuple

import numpy as np

from wfsobs.typing import Array

HEAD = 24
"""Bytes before the rows: the count, whether the writer has ended, and how many came late."""


class SharedNumbers:
    """Numbers in memory that processes share.

    Parameters
    ----------
    size : int
        Bytes.
    name : str or None
        That of memory that exists; None to own a new one.
    """

    def __init__(self, size: int, name: str | None):
        self._memory = SharedMemory(name=name, create=name is None, size=size if name is None else 0)
        self._owner = name is None

    @property
    def name(self) -> str:
        """Name by which another process finds it."""
        return self._memory.name

    def release(self) -> None:
        """Give the memory back."""
        self._memory.close()
        if self._owner:
            with suppress(FileNotFoundError):  # a resource tracker has done so: that of this process was killed
                self._memory.unlink()


class Rows(SharedNumbers):
    """A ring of rows.

    Parameters
    ----------
    width : int
        Numbers in a row.
    capacity : int
        Rows that it holds.
    name : str, optional
        That of a ring that exists.

    Raises
    ------
    OSError
        There is no ring of this name.
    """

    capacity: int

    def __init__(self, width: int, capacity: int, name: str | None = None):
        super().__init__(HEAD + 8 * capacity * width, name)
        self._head = np.ndarray(3, dtype=np.int64, buffer=self._memory.buf)
        self._rows = np.ndarray((capacity, width), buffer=self._memory.buf, offset=HEAD)
        self.capacity = capacity
        if self._owner:
            self._rows[0] = np.nan  # else it would be the one of number 0 before it is written

    @property
    def count(self) -> int:
        """Number of rows written so far."""
        return int(self._head[0])

    @property
    def is_closed(self) -> bool:
        """Whether the writer has ended."""
        return bool(self._head[1])

    def write(self, row: Array) -> None:
        """Append a row: the numbers first, then the count."""
        self._rows[self._head[0] % self.capacity] = row
        self._head[0] += 1

    def skip_to(self, index: int) -> None:
        """Go on with the row of this number; those between are not written, and hold what was there."""
        self._head[0] = index

    def read_row(self, index: int) -> Array | None:
        """Return a copy of a row, (width,); None where it has been overwritten."""
        row = self._rows[index % self.capacity].copy()
        return None if self._head[0] - index > self.capacity - 1 else row

    def read_rows(self, first: int, stop: int, width: int | None = None) -> Array:
        """Return copies of the rows first ... stop - 1, (n, width); NaN where they have been overwritten or are yet to come."""
        first, at = max(first, 0), np.arange(max(first, 0), max(stop, first, 0))
        rows = self._rows[:, :width][at % self.capacity]
        head = int(self._head[0])
        rows[(head - at > self.capacity - 1) | (at >= head)] = np.nan
        return rows

    def close_writer(self) -> None:
        """Say that no row follows."""
        self._head[1] = 1

    def release(self) -> None:
        """Give the memory back; what is read from then on is NaN."""
        self._head, self._rows = self._head.copy(), np.broadcast_to(np.nan, self._rows.shape)
        super().release()


class Tracker:
    """The process of Python that gives shared memory back where its owner was killed."""

    def __init__(self) -> None:
        pipe = resource_tracker.getfd() if os.name == "posix" else None
        self._pipe = None if pipe is None else os.dup(pipe)

    @property
    def is_gone(self) -> bool:
        """Whether it has been killed: nobody reads from its pipe."""
        if self._pipe is None:
            return False
        (look := select.poll()).register(self._pipe, 0)
        return bool(look.poll(0))

    def release(self) -> None:
        """Have another one in place of one that is gone; what it says of memory that it has never heard of is not shown."""
        is_gone, pipe, self._pipe = self.is_gone, self._pipe, None
        if pipe is not None:
            os.close(pipe)
        if is_gone:
            shown = os.dup(2)
            with open(os.devnull, "w") as nothing, warnings.catch_warnings():
                warnings.simplefilter("ignore")
                os.dup2(nothing.fileno(), 2)
                resource_tracker.ensure_running()
                os.dup2(shown, 2)
            os.close(shown)


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


def merged_rows(traces: list[Rows], first: int, stop: int, width: int | None = None) -> Array:
    """Return what the crews together have in the rows first ... stop - 1, (n, width): the longest delay, every estimate.

    A row that is not that of its frame holds what was there before: it is NaN, but for its number.
    """
    numbers, out = np.arange(max(first, 0), max(stop, first, 0)), None
    for rows in traces:
        own = rows.read_rows(first, stop, width)
        own[own[:, 0] != numbers] = np.nan
        out = own if out is None else np.fmax(out, own)
    assert out is not None
    out[:, 0] = numbers
    return out
