"""Few points of a long signal: the extremes of every bin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wfsobs.typing import Array


def envelope_times(start: int, stop: int, bins: int, dt: float) -> Array:
    """Compute the times [s] that belong to `envelope` of samples start ... stop - 1."""
    n = stop - start
    if n <= 2 * bins:
        return dt * np.arange(start, stop, dtype=np.float64)
    edges = _edges(n, bins)
    width = np.diff(edges)
    left = start + edges[:-1] + 0.25 * (width - 1)
    return np.column_stack([left, left + 0.5 * (width - 1)]).ravel() * dt


def envelope(x: Array, bins: int) -> Array:
    """At most 2 * bins values of x (n,): the extremes of every bin, in the order in which the signal rises or falls.

    Every sample is in a bin, the last ragged one included. NaN is left out; a bin of NaN alone is NaN.
    """
    n = x.size
    if n <= 2 * bins:
        return x
    edges = _edges(n, bins)
    low, high = np.fmin.reduceat(x, edges[:-1]), np.fmax.reduceat(x, edges[:-1])
    falling = x[edges[1:] - 1] < x[edges[:-1]]
    return np.column_stack([np.where(falling, high, low), np.where(falling, low, high)]).ravel()


def band_envelope(low: Array, high: Array, bins: int) -> tuple[Array, Array]:
    """Return the lowest and the highest of a band in every bin, at the times of `envelope_times`."""
    n = low.size
    if n <= 2 * bins:
        return low, high
    starts = _edges(n, bins)[:-1]
    return np.repeat(np.fmin.reduceat(low, starts), 2), np.repeat(np.fmax.reduceat(high, starts), 2)


def _edges(n: int, bins: int) -> NDArray[np.int64]:
    return np.linspace(0, n, bins + 1).astype(np.int64)
