"""Rows of numbers in shared memory: one writer, any number of readers, none of which can hold the writer up."""

from __future__ import annotations

import os
import select
import warnings
from contextlib import suppress
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory

import numpy as np

from wfsobs.typing import Array

HEAD = 24
"""Bytes before the rows: the count, whether the writer has ended, and how many came late."""


class Rows:
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
        self._memory = SharedMemory(name=name, create=name is None, size=HEAD + 8 * capacity * width if name is None else 0)
        self._head = np.ndarray(3, dtype=np.int64, buffer=self._memory.buf)
        self._rows = np.ndarray((capacity, width), buffer=self._memory.buf, offset=HEAD)
        self.capacity, self._owner = capacity, name is None
        if self._owner:
            self._rows[0] = np.nan  # else it would be the one of number 0 before it is written

    @property
    def name(self) -> str:
        """Name by which another process finds it."""
        return self._memory.name

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
        self._memory.close()
        if self._owner:
            with suppress(FileNotFoundError):  # a resource tracker has done so: that of this process was killed
                self._memory.unlink()


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
