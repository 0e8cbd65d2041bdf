"""Stability in the mean square of a loop whose step differs at random, independently, from one to the next.

The covariance S of the state goes from step to step by E[A S A'], and the loop is stable where no S grows (O. Costa, M. Fragoso,
R. Marques, Discrete-Time Markov Jump Linear Systems, 2005). Steps differ only in what the mirror makes of a change of its
commands, a few rows V of the state: A = E[A] + U V with U random, so that

    E[A S A'] = E[A] S E[A]' + W(V S V'),    W(M) = E[U M U'],

and a rate of growth is one at which the covariance of those rows, a matrix of as many rows, comes back as it was by W and the
sum of all that follows from it: no eigenvalue of the n^2 numbers of S is looked for.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import brentq

from wfsobs.typing import Array

SAME = 1e-12
"""Relative size below which draws do not differ."""

NEAR = 1e-10
"""Least relative distance of the rate of growth from that of the mean step."""

DOUBLINGS = 60
"""Of the number of cycles whose contributions are added up."""


def mean_square_radius(weights: Sequence[float], draws: Sequence[Sequence[Array]]) -> float:
    """Growth of the covariance of the state over a cycle, at most; below 1 the loop is stable in the mean square.

    Parameters
    ----------
    weights : sequence of float
        Probabilities of the draws.
    draws : sequence of sequence of Array
        Steps of a cycle in each draw, (n, n), independent of each other.

    Returns
    -------
    float
        Spectral radius of E[A x A] over a cycle.
    """
    steps, w = np.array(draws), np.array(weights)
    mean = np.tensordot(w, steps, 1)
    phases, n = mean.shape[:2]
    rows, spread = [], []
    for off in np.moveaxis(steps - mean, 1, 0):
        size, V = np.linalg.svd((np.sqrt(w)[:, None, None] * off).reshape(-1, n), full_matrices=False)[1:]
        V = V[size > SAME * np.abs(mean).max()]
        rows.append(V)
        spread.append(np.sqrt(w)[:, None, None] * (off @ V.T))
    least = float(np.abs(np.linalg.eigvals(_cycle(mean, 0))).max()) ** 2
    if not any(len(V) for V in rows):
        return least

    def excess(log_rate: float) -> float:
        scale = np.exp(-0.5 * log_rate / phases)
        returned = _carry_around(scale * mean, rows, [scale * U for U in spread])
        return float(np.log(np.abs(np.linalg.eigvals(returned)).max() + 1e-300))

    low = np.log(max(least, 1e-12)) + NEAR
    if excess(low) <= 0.0:
        return least
    high = low + 0.1
    while excess(high) > 0.0:
        high += 1.0
    return float(np.exp(brentq(excess, low, high, xtol=1e-12)))


def _cycle(mean: Array, first: int) -> Array:
    """Return the product of the steps of a cycle that begins with this one."""
    out = np.eye(mean.shape[1])
    for phase in range(first, first + len(mean)):
        out = mean[phase % len(mean)] @ out
    return out


def _carry_around(mean: Array, rows: Sequence[Array], spread: Sequence[Array]) -> Array:
    """Return what comes back, in all phases, of a covariance of the rows in each: a square matrix of all their numbers."""
    starts = np.cumsum([0, *(len(V) ** 2 for V in rows)])
    out = np.zeros((starts[-1], starts[-1]))
    for phase, (V, U) in enumerate(zip(rows, spread, strict=True)):
        unit = np.eye(len(V) ** 2).reshape(-1, len(V), len(V))
        S = np.einsum("dia,eab,djb->eij", U, unit, U)
        power = _cycle(mean, phase + 1)
        for _ in range(DOUBLINGS):
            S = S + power @ S @ power.T
            power = power @ power
            if np.abs(power).max() < SAME**2:
                break
        for later in range(phase + 1, phase + 1 + len(mean)):
            at = later % len(mean)
            seen = rows[at] @ S @ rows[at].T
            out[starts[at] : starts[at + 1], starts[phase] : starts[phase + 1]] = seen.reshape(len(unit), -1).T
            S = mean[at] @ S @ mean[at].T
    return out
