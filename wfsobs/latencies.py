"""A histogram of latencies, or of other numbers that span decades: its quantiles take no more room however long a loop runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

EDGES = np.geomspace(1e-7, 10.0, 1601)
"""Edges of the bins [s]: each 1.2 % above the one before, which is how exact a quantile is."""


class Latencies:
    """Histogram of the times that an observer takes for its frames.

    Parameters
    ----------
    counts : array, optional
        Counts of the bins to go on with, (1602,): below the first edge, between edges, above the last one.
    """

    def __init__(self, counts: NDArray[np.int64] | None = None) -> None:
        self.counts: NDArray[np.int64] = np.zeros(len(EDGES) + 1, dtype=np.int64) if counts is None else counts

    def clear(self) -> None:
        """Begin anew."""
        self.counts[:] = 0

    def add(self, latency: float | NDArray[np.float64]) -> None:
        """Count a latency, or several [s]."""
        np.add.at(self.counts, np.searchsorted(EDGES, latency), 1)

    def quantile(self, share: float) -> float:
        """Return a quantile, rounded up to the next edge [s]; NaN without a latency."""
        if not (total := self.counts.sum()):
            return float("nan")
        bin_ = int(np.searchsorted(np.cumsum(self.counts), share * total))
        return float(EDGES[min(bin_, len(EDGES) - 1)])
