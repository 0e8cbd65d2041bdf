"""How many frames every observer has taken, how many were lost, and how many came late."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import numpy as np

from wfsobs.live.board import Board
from wfsobs.live.ring import LATE, Ring
from wfsobs.live.rows import Rows
from wfsobs.typing import Array


class Delivery:
    """Counts the frames of a loop.

    A frame is taken once every observer has an estimate of it that is counted, and late where it has it more than 1 ms after the
    frame was due.

    Parameters
    ----------
    ring : Ring
        The frames.
    board : Board
        Where the crews count what they lose.
    traces : callable
        Returns the rows of the crews that take part.
    count : callable
        Returns the number of the first frame that one of them has not counted.
    """

    def __init__(self, ring: Ring, board: Board, traces: Callable[[], list[Rows]], count: Callable[[], int]):
        self._ring, self._board, self._traces, self._count, self._lock = ring, board, traces, count, Lock()
        self._next = self._n_delays = self._n_late = 0

    @property
    def count(self) -> int:
        """Frames that every observer has taken, or lost."""
        return self._count()

    @property
    def losses(self) -> int:
        """Frames that an observer has lost."""
        return int(self._board.losses.max())

    @property
    def frames(self) -> int:
        """Frames that every observer has taken."""
        return self.count - self.losses

    @property
    def late_share(self) -> float:
        """Share of the frames of which an estimate came more than 1 ms after they were due."""
        return self._n_late / max(self._n_delays, 1)

    @property
    def late_share_sent(self) -> float:
        """Share of the frames that the source sent more than 1 ms after they were due."""
        return self._ring.late / max(self._ring.count, 1)

    def collect(self) -> None:
        """Count what has come since the last call; rows that have been overwritten meanwhile are not known."""
        with self._lock:
            stop = self.count
            delays = merged_rows(self._traces(), self._next, stop, 2)[:, 1]
            self._next = stop
            self._n_delays += int((~np.isnan(delays)).sum())
            self._n_late += int((delays > LATE).sum())


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
