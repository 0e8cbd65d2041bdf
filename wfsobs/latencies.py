"""A histogram of latencies, whose quantiles take no more room however long a loop runs."""

from __future__ import annotations

import numpy as np

EDGES = np.geomspace(1e-7, 10.0, 1601)
"""Edges of the bins [s]: each 1.2 % above the one before, which is how exact a quantile is."""


class Latencies:
    """Histogram of the times that an observer takes for its frames."""

    def __init__(self) -> None:
        self._counts = np.zeros(len(EDGES) + 1, dtype=np.int64)

    def add(self, latency: float) -> None:
        """Count one latency [s]."""
        self._counts[np.searchsorted(EDGES, latency)] += 1

    def quantile(self, share: float) -> float:
        """Return a quantile, rounded up to the next edge [s]; NaN without a latency."""
        if not (total := self._counts.sum()):
            return float("nan")
        bin_ = int(np.searchsorted(np.cumsum(self._counts), share * total))
        return float(EDGES[min(bin_, len(EDGES) - 1)])
