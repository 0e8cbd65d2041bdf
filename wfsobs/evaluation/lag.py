"""Delay of an estimate behind the truth."""

from __future__ import annotations

import numpy as np

from wfsobs.typing import Array

MAX_LAG = 0.025
"""Maximum lag [s]."""


def lag(truth: Array, value: Array, dt: float) -> float | None:
    """Estimate the delay of `value` behind `truth` [s]: where their correlation coefficient is highest.

    The maximum is interpolated by a parabola through three points. Positive is late; None where either is constant.

    The middle of the truth is compared with equally long pieces of the estimate, each with its own mean and variance:
    a plain cross-correlation has fewer terms at larger lags, which biases the broad maximum of a slow signal towards
    zero. The phase of an oscillation tells its delay but for whole periods: of maxima that reach half of the highest, which
    may be highest by chance, it is the one nearest to zero.
    """
    reach = min(round(MAX_LAG / dt), (truth.size - 1) // 4)
    middle = truth[reach : truth.size - reach]
    if np.ptp(value) == 0 or np.ptp(middle) == 0:
        return None
    n, moving = middle.size, value - value.mean()
    sums, squares = (np.concatenate([[0.0], np.cumsum(x)]) for x in (moving, moving**2))
    power = squares[n:] - squares[:-n] - (sums[n:] - sums[:-n]) ** 2 / n
    if not power.max() > 0:  # so small that its square is nothing
        return None
    power = np.maximum(power, 1e-12 * power.max())
    alike = np.correlate(moving, middle - middle.mean(), "valid") / np.sqrt(power)
    inner = alike[1:-1]
    tops = 1 + np.flatnonzero((inner >= alike[:-2]) & (inner >= alike[2:]) & (inner >= 0.5 * alike.max()))
    if tops.size == 0:
        return float((np.argmax(alike) - reach) * dt)
    peak = tops[np.argmin(np.abs(tops - reach))]
    before, at, after = alike[peak - 1 : peak + 2]
    curvature = before - 2.0 * at + after
    shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return float((peak - reach + shift) * dt)
