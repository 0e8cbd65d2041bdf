"""Points of a line that a report keeps: the extremes of bins, and every sample of a stretch in the middle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wfsobs.app.views.plots import envelope, envelope_times

Array = NDArray[np.float64]

Floats = NDArray[np.float32]

WINDOW_S = 0.5
"""A stretch in the middle of the record that keeps every sample [s]."""


@dataclass(frozen=True)
class Grid:
    """Which points of a line are kept.

    They are the extremes of bins, but every sample between `first` and `last`, and where bins save nothing.
    """

    n: int
    dt: float
    bins: int

    @property
    def whole(self) -> bool:
        """Whether every sample of the record is kept."""
        return self.n <= 2 * self.bins + self.width

    @property
    def width(self) -> int:
        """Samples in the window."""
        return min(round(WINDOW_S / self.dt), self.n)

    @property
    def first(self) -> int:
        """The window's first sample."""
        return 0 if self.whole else (self.n - self.width) // 2

    @property
    def last(self) -> int:
        """One past the window's last sample."""
        return self.n if self.whole else self.first + self.width

    def _parts(self) -> list[tuple[int, int, int]]:
        """(start, stop, bins) of the pieces, all samples where the bins are 0."""
        left, right = self.first, self.n - self.last
        share = round(self.bins * left / max(left + right, 1))
        parts = [(0, left, share), (self.first, self.last, 0), (self.last, self.n, self.bins - share)]
        return [part for part in parts if part[1] > part[0]]

    def times(self) -> Array:
        """Return the times [s] of the points kept."""
        return np.concatenate([envelope_times(a, b, bins or b - a, self.dt) for a, b, bins in self._parts()])

    def thin(self, x: Array) -> Floats:
        """Select the points kept of a signal (n,)."""
        return np.concatenate([envelope(x[a:b], bins or b - a) for a, b, bins in self._parts()]).astype(np.float32)
