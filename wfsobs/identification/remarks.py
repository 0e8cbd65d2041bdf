"""What is wrong with a model whose residual is not white: where the spectrum differs, and whether the record is stationary."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.stats import chi2

from wfsobs.typing import Array

PARTS = 10
"""Parts of a record whose innovations should have the same variance."""
LEVEL = 1e-3
"""Probability that noise would be called not stationary."""
BANDS = (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, np.inf)
"""Edges of the bands in which the spectrum is compared [Hz]."""
LAGS = 100
"""Maximum lag of a correlation."""
CLEAR, MATTERS = 4.0, 0.05
"""Minimum standard deviations of a mean over a band, and minimum difference from one, of a remark."""


def remarks(f: Array, ratio: Array, e: Array, dt: float) -> tuple[str, ...]:
    """Return remarks on a residual that is not white, one clause each.

    f, ratio (bins,) : frequencies [Hz] and I / S; e (n,) : innovations of the Kalman filter of S, every dt [s]
    """
    found = [*_bands(f, ratio), *in_time(e, dt), *_memory(e, dt)]
    return tuple(found or ["no band, lag or time stands out: it is a little of everything"])


def _bands(f: Array, ratio: Array) -> list[str]:
    out = []
    for low, high in pairwise(BANDS):
        inside = ratio[(f >= low) & (f < high)]
        if not len(inside):
            continue
        mean = float(inside.mean())
        if abs(mean - 1.0) > max(CLEAR / np.sqrt(len(inside)), MATTERS):
            upper = f"{min(high, f[-1]):.3g} Hz"
            out.append(f"from {low:g} to {upper} the record has {mean:.2g} times what the model has")
    return out


def _memory(e: Array, dt: float) -> list[str]:
    """Return the lag of the largest correlation, if noise has none as large."""
    e = e - e.mean()
    rho = np.array([e[lag:] @ e[:-lag] for lag in range(1, LAGS + 1)]) / (e @ e)
    lag = int(np.argmax(np.abs(rho)))
    if abs(rho[lag]) * np.sqrt(len(e)) < CLEAR:
        return []
    return [f"what is left correlates most with itself {1e3 * (lag + 1) * dt:.3g} ms before, {rho[lag]:+.3f}"]


def in_time(e: Array, dt: float) -> list[str]:
    """Check innovations for changes of their variance, which no test of whiteness sees."""
    parts = np.array([np.var(part) for part in np.array_split(e, PARTS)])
    statistic = 0.5 * len(e) / PARTS * np.sum((parts / parts.mean() - 1.0) ** 2)
    if chi2.sf(statistic, PARTS - 1) >= LEVEL:
        return []
    low, high = np.sqrt(np.array([parts.min(), parts.max()]) / parts.mean())
    return [f"it is not stationary: over tenths of the record the rms of the noise is {low:.2f} to {high:.2f} of its mean"]
