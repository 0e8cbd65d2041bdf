"""Recursive least squares with forgetting: empirical orthogonal functions as they are run.

The next measurement is predicted as a linear function of the last measurements of all modes,

    z[k+1] = W h[k],    h[k] = (z[k], z[k-1], ..., z[k-L+1]),

with the W that has the least sum of squares up to step k, the past forgotten exponentially. Empirical orthogonal functions
(Guyon and Males 2017, arXiv:1707.00570) are this with a batch of the past; recursively it is the adaptive predictor of Haykin,
Adaptive Filter Theory, chapter 10. It is told nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from wfsobs.observers.base import TARGETS, Observer
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Estimates, Measurements
from wfsobs.typing import Array
from wfsobs_arena.challengers.base import WHOLE, Challenger, whole_estimate

ORDER = 20
"""Measurements of each mode that a prediction uses."""

MEMORY = 10.0
"""Time after which the past counts 1 / e [s]."""

PENALTY = 1e-3
"""Of the weights at the start, over the mean square of the first measurements."""

BLOCK = 1000
"""Steps between two looks at whether to stop."""


def histories(z: Array, order: int) -> Array:
    """Return h[k] (n, order * n_modes), the newest measurement first, zeros before the start; z : (n, n_modes)."""
    padded = np.vstack([np.zeros((order - 1, z.shape[1])), z])
    return np.hstack([padded[order - 1 - j : order - 1 - j + len(z)] for j in range(order)])


class Rls:
    """Weights of least squares, the past forgotten exponentially, after each pair of input and output.

    Parameters
    ----------
    n_inputs, n_outputs : int
        Sizes.
    forgetting : float
        Factor of the past from pair to pair, 1 for none.
    penalty : float
        Of the squares of the weights, before the first pair.

    Attributes
    ----------
    P : Array
        Inverse of the weighed sum of the products of inputs, (n_inputs, n_inputs).
    W : Array
        Weights, (n_inputs, n_outputs).
    """

    def __init__(self, n_inputs: int, n_outputs: int, forgetting: float, penalty: float):
        self.P, self.W, self.forgetting = np.eye(n_inputs) / penalty, np.zeros((n_inputs, n_outputs)), forgetting

    def learn(self, h: Array, output: Array) -> None:
        """Take a pair into account; h : (n_inputs,), output : (n_outputs,)."""
        Ph = self.P @ h
        gain = Ph / (self.forgetting + h @ Ph)
        self.W += np.outer(gain, output - h @ self.W)
        self.P -= np.outer(gain, Ph)
        self.P /= self.forgetting


def predict_rls(z: Array, order: int, forgetting: float, penalty: float, watch: Watch | None = None) -> tuple[Array, Array]:
    """Predict by recursive least squares.

    Parameters
    ----------
    z : Array
        Measurements, (n, n_modes).
    order : int
        Measurements of each mode that a prediction uses.
    forgetting : float
        Factor of the past from step to step, 1 for none.
    penalty : float
        Of the squares of the weights, before the first step.
    watch : Watch, optional
        Asked whether to stop.

    Returns
    -------
    Array
        Prediction of z[k + 1] from z up to step k, (n, n_modes).
    Array
        Weights after the last step, (order * n_modes, n_modes).
    """
    H, n = histories(z, order), len(z)
    fit = Rls(H.shape[1], z.shape[1], forgetting, penalty)
    out = np.empty_like(z)
    for k in range(n):
        if watch is not None and k % BLOCK == 0:
            watch.step(k / n)
        if k > 0:
            fit.learn(H[k - 1], z[k])
        out[k] = H[k] @ fit.W
    return out, fit.W


def recent_sd(z: Array, prediction: Array, forgetting: float) -> Array:
    """Return the rms of z[k] - prediction[k - 1] up to each step, the past forgotten, (n, n_modes)."""
    squares = np.zeros_like(z)
    squares[1:] = (z[1:] - prediction[:-1]) ** 2
    sums, total, weight = np.empty_like(z), np.zeros(z.shape[1]), 0.0
    for k, square in enumerate(squares):
        total, weight = forgetting * total + square, forgetting * weight + 1.0
        sums[k] = total / weight
    return np.sqrt(sums)


def run_rls(measurements: Measurements, _prior: Prior, _settings: Any, watch: Watch) -> Estimates:
    """Run recursive least squares on z."""
    z, forgetting = measurements.z, float(np.exp(-measurements.dt / MEMORY))
    start = max(float(np.mean(z[:ORDER] ** 2)), 1e-12)
    predicted, _ = predict_rls(z, ORDER, forgetting, PENALTY * start, watch)
    predicted[: ORDER - 1] = 0.0  # before all is measured that the penalty is taken from
    return whole_estimate(predicted, recent_sd(z, predicted, forgetting))


RLS = Challenger(
    Observer("rls", "Recursive least squares", TARGETS, run_rls, help="least squares on 20 measurements of all modes, recursive"),
    WHOLE,
    "Guyon and Males 2017, arXiv:1707.00570",
)
