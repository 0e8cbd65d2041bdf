"""Autoregression of all modes together, its order by Akaike's final prediction error.

    z[k+1] = A_1 z[k] + ... + A_p z[k-p+1] + e[k+1],

by least squares on all that has been measured, anew every REFIT seconds. Off-diagonal elements of A couple the modes. The order
is that of ORDERS with the least |S| ((n + m p) / (n - m p))^m, S the covariance of the residuals, m the modes, n the measurements
(Akaike 1971, Ann. Inst. Statist. Math. 23, 163). Hafeez et al. (2022, JATIS 8, 029003) find thirty coefficients enough for tip
and tilt, and nothing that networks add. It is told nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve

from wfsobs.observers.base import TARGETS, Observer
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Estimates, Measurements
from wfsobs.typing import Array
from wfsobs_arena.challengers.base import WHOLE, Challenger, whole_estimate
from wfsobs_arena.challengers.rls import histories

ORDERS = (2, 5, 10, 20, 30, 50)
"""Orders that are tried."""

REFIT = 0.5
"""Time between two fits [s]."""

PENALTY = 1e-7
"""Of the squares of the coefficients, over the mean square of z."""


class Autoregression(NamedTuple):
    """Autoregression: weights (order * n_modes, n_modes), the newest measurement first; covariance of its residuals."""

    weights: Array
    covariance: Array

    @property
    def order(self) -> int:
        """Number of measurements of each mode."""
        return len(self.weights) // len(self.covariance)


class NormalEquations:
    """Sums of products of histories h[k] and what follows them, to which rows are added."""

    def __init__(self, n_modes: int, order: int):
        size = n_modes * order
        self.n_modes, self.n = n_modes, 0
        self.gram, self.cross, self.power = np.zeros((size, size)), np.zeros((size, n_modes)), np.zeros((n_modes, n_modes))

    def add(self, H: Array, later: Array) -> None:
        """Add histories (n, order * n_modes) and what follows them (n, n_modes)."""
        self.n += len(H)
        self.gram += H.T @ H
        self.cross += H.T @ later
        self.power += later.T @ later

    def fit(self, order: int) -> Autoregression:
        """Return the autoregression of an order up to that of the histories."""
        size, penalty = order * self.n_modes, PENALTY * float(np.trace(self.power)) / self.n_modes
        cross = self.cross[:size]
        weights = solve(self.gram[:size, :size] + penalty * np.eye(size), cross, assume_a="pos")
        left = self.power - weights.T @ cross
        return Autoregression(weights, left / self.n)

    def best(self, orders: tuple[int, ...] = ORDERS) -> Autoregression:
        """Return the autoregression with the least final prediction error."""
        m, n = self.n_modes, self.n
        fits = [self.fit(order) for order in orders if n > 4 * m * order]

        def prediction_error(one: Autoregression) -> float:
            return float(np.linalg.slogdet(one.covariance)[1] + m * np.log((n + m * one.order) / (n - m * one.order)))

        return min(fits, key=prediction_error)


def run_coupled_ar(measurements: Measurements, _prior: Prior, _settings: Any, watch: Watch) -> Estimates:
    """Run the autoregression on z; the last measurement before the first fit."""
    z, block = measurements.z, max(round(REFIT / measurements.dt), 16 * measurements.n_modes)
    H, sums = histories(z, ORDERS[-1]), NormalEquations(measurements.n_modes, ORDERS[-1])
    out, sd = z.copy(), np.full_like(z, np.nan)
    for start in range(block, len(z), block):
        watch.step(start / len(z))
        sums.add(H[start - block : start], z[start - block + 1 : start + 1])  # known at step `start`
        found = sums.best()
        out[start : start + block] = H[start : start + block, : len(found.weights)] @ found.weights
        sd[start : start + block] = np.sqrt(np.diag(found.covariance))
    return whole_estimate(out, sd)


COUPLED_AR = Challenger(
    Observer(
        "coupled-ar",
        "Coupled autoregression",
        TARGETS,
        run_coupled_ar,
        help="an autoregression of all modes together, its order by the final prediction error",
    ),
    WHOLE,
    "Akaike 1971; Hafeez et al. 2022, JATIS 8, 029003",
)
