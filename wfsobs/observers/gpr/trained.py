"""A trained Gaussian process: its fit to the windows of a record, and what it predicts from others.

With w = a - b c and c = (delta.a) / (1 / s2 + delta.b) (`kernels` has
a, b, delta), a prediction is

    mean = kappa.w + delta_t c,
    variance = M_tt - |L^-1 kappa|^2 + (delta_t - kappa.b)^2 / (1 / s2 + delta.b),    L L' = M + sigma_n^2 I.

The variance, that of the vibration without the noise of a target, costs m^2 operations where the mean costs m: it is computed
once in so many steps and held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import as_strided

from wfsobs.observers.gpr.kernels import (
    Points,
    SquaredExponential,
    band,
    check_condition,
    sliding_products,
    square_from_band,
    squared_norms,
)
from wfsobs.progress import QUIET, Watch
from wfsobs.record import RecordError
from wfsobs.signal.linalg import eliminate, solve_lower, solve_rows
from wfsobs.typing import Array

ROWS = 256
"""Steps predicted at a time."""

HELD = 16
"""Steps over which a standard deviation is held, a divisor of ROWS; windows change little in them."""


@dataclass(frozen=True)
class TrainedGpr:
    """A trained GPR: the signals (d + m - 1, channels) [l] of its m windows, the windows as points, their weights (m,), and c.

    factor, b, pivot : for the variance, L (m, m), b (m,) and 1 / s2 + delta.b
    """

    signals: Array
    depth: int
    points: Points
    weights: Array
    constant: float
    kernel: SquaredExponential
    factor: Array
    b: Array
    pivot: float

    def predict(self, signals: Array, watch: Watch = QUIET, sd: Array | None = None) -> Array:
        """Mean at every step of signals (n, channels), (n,); NaN before the first full window.

        sd : (n,), receives the standard deviations where it is given
        """
        n, m, d = signals.shape[0], self.weights.size, self.depth
        out = np.full(n, np.nan)
        signals = signals / self.kernel.length_scale
        tests = self.kernel.points(squared_norms(signals, d))
        since, held = d - 1, []  # windows whose standard deviation is still to come
        for start in range(d - 1, n, ROWS):
            watch.step(start / n)
            rows = min(ROWS, n - start)
            # products[r, c] of test window start + r and training window c + r - rows + 1
            products = sliding_products(signals, self.signals, d, start, d - rows, rows, m + rows - 1)
            row, item = products.strides
            G = as_strided(products[:, rows - 1 :], (rows, m), (row - item, item))
            end = start + rows
            here = tests.select(lambda p, start=start, end=end: p[start:end])
            if sd is not None:
                held.append(G[::HELD].copy())
                if len(held) == HELD or end == n:  # many at a time, for the whole factor is read each time
                    windows = tests.select(lambda p, since=since, end=end: p[since:end:HELD])
                    sd[since:end] = np.repeat(self._sd(np.concatenate(held), windows), HELD)[: end - since]
                    since, held = end, []
            known = self.kernel.split_times(G, here, self.points, self.weights)
            out[start:end] = known + here.delta * self.constant
        return out

    def _sd(self, G: Array, tests: Points) -> Array:
        """Return the standard deviations (n,) of windows with these inner products G (n, m) [l^2]; uses up G."""
        self.kernel.split(G, tests.select(lambda p: p[:, None]), self.points)
        border = tests.delta - G @ self.b
        whitened = solve_lower(self.factor, G.T)
        variance = self.kernel.own(tests) - np.sum(whitened**2, axis=0) + border**2 / self.pivot
        return np.sqrt(np.maximum(variance, 0.0))

    def predict_one(self, window: Array) -> float:
        """Mean for one window, (channels, depth), the oldest sample first."""
        window = window / self.kernel.length_scale
        G = sum(np.correlate(known, x, "valid") for known, x in zip(self.signals.T, window, strict=True))
        here = self.kernel.points(np.array([np.sum(np.square(window))]))
        known = self.kernel.split_times(np.asarray(G)[None], here, self.points, self.weights)
        return float(known[0] + here.delta[0] * self.constant)


def eliminated_covariance(
    signals: Array, targets: Array, depth: int, first: int, m: int, kernel: SquaredExponential, watch: Watch = QUIET
) -> tuple[Array, Points]:
    """Return the covariance of the m windows that end at first ... first + m - 1, and the windows as points.

    The targets and delta are two more rows; the first m columns are eliminated. Raises ConditionError where the precision is not
    enough, Cancelled.
    """
    V, points = band(signals, depth, kernel, first, m, m - 1)
    watch.check()
    S = np.zeros((m + 2, m + 2), order="F")
    S[:m, :m] = square_from_band(V, 0, m)
    S[m:, :m] = targets[first : first + m], points.delta
    check_condition(S[:m, :m], kernel)
    eliminate(S, m, watch.check)
    return S, points


def train(signals: Array, targets: Array, depth: int, m: int, kernel: SquaredExponential, watch: Watch = QUIET) -> TrainedGpr:
    """Fit the first m windows of signals (n, channels) to targets (n,), one per step.

    Raises RecordError where the record is too short, ConditionError where the precision is not enough.
    """
    if signals.shape[0] < depth + m:
        raise RecordError(f"the training data has {signals.shape[0]} steps, depth + training size need {depth + m}")
    first = depth - 1
    S, points = eliminated_covariance(signals, targets, depth, first, m, kernel, watch)
    a, b = solve_rows(S, m)
    pivot = float(1.0 / kernel.variance + points.delta @ b)
    constant = float(points.delta @ a) / pivot
    known = signals[: first + m] / kernel.length_scale
    return TrainedGpr(known, depth, points, a - b * constant, constant, kernel, S[:m, :m], b, pivot)
