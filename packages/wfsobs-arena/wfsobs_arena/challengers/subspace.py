"""Subspace predictor: the few combinations of the past that predict the future.

The last PAST measurements of all modes, Z, and the next FUTURE ones, F, have canonical correlations. For a disturbance of n
states n of them are not zero; the state is the n combinations of Z that belong to them, and the next measurement is regressed on
it (canonical variate analysis, Larimore 1990, Proc. 29th CDC, 596). Data-driven subspace predictive control (Haffert et al. 2021,
JATIS 7, 029001) rests on the same regression of the future on the past. The order is that of the least Akaike criterion of a
regression of rank n. It is told nothing and learns anew every REFIT seconds.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from wfsobs.observers.base import TARGETS, Observer
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Estimates, Measurements
from wfsobs.typing import Array
from wfsobs_arena.challengers.base import WHOLE, Challenger, whole_estimate
from wfsobs_arena.challengers.rls import histories

PAST, FUTURE = 50, 25
"""Measurements of each mode in the past and in the future."""

REFIT = 0.5
"""Time between two fits [s]."""

PENALTY = 1e-7
"""Added to the covariance of the past and of the future, over their mean variance."""


class SubspacePredictor(NamedTuple):
    """Predictor of rank n.

    weights      : of the past, (past * n_modes, n_modes), the newest measurement first
    correlations : canonical correlations, the largest first
    order        : n
    covariance   : of its residuals, (n_modes, n_modes)
    """

    weights: Array
    correlations: Array
    order: int
    covariance: Array


def fit_subspace(moments: Array, n: int, n_modes: int, past: int) -> SubspacePredictor:
    """Fit the predictor.

    Parameters
    ----------
    moments : Array
        Sum of the products of (past, future), the past the newest first, the future the next measurement first,
        ((past + future) * n_modes, (past + future) * n_modes).
    n : int
        Number of what was summed.
    n_modes, past : int
        Modes, and measurements of each in the past.

    Returns
    -------
    SubspacePredictor
        With the order of the least Akaike criterion.
    """
    size = past * n_modes
    R = moments / n + PENALTY * np.mean(np.diag(moments)) / n * np.eye(len(moments))
    of_past, of_future = np.linalg.cholesky(R[:size, :size]), np.linalg.cholesky(R[size:, size:])
    scaled = solve_triangular(of_future, solve_triangular(of_past, R[:size, size:], lower=True).T, lower=True)
    _, r, V = np.linalg.svd(scaled, full_matrices=False)
    r = np.minimum(r, 1.0 - 1e-12)
    orders = np.arange(len(r) + 1)
    left = np.concatenate([np.cumsum(-np.log1p(-(r[::-1] ** 2)))[::-1], [0.0]])
    order = int(np.argmin(n * left + 2.0 * orders * (sum(scaled.shape) - orders)))
    states = solve_triangular(of_past, V[:order].T, lower=True, trans="T")  # of unit covariance
    shared = R[:size, size : size + n_modes]
    weights = states @ (states.T @ shared)
    covariance = R[size : size + n_modes, size : size + n_modes] - weights.T @ shared
    return SubspacePredictor(weights, r, order, covariance)


def joint_moments(H: Array, z: Array, start: int, stop: int, future: int) -> Array:
    """Return the sum over k from `start` to `stop` - 1 of the products of (h[k], z[k+1], ..., z[k+future])."""
    joint = np.hstack([H[start:stop], *(z[start + j : stop + j] for j in range(1, future + 1))])
    return joint.T @ joint


def run_subspace(measurements: Measurements, _prior: Prior, _settings: Any, watch: Watch) -> Estimates:
    """Run the predictor on z; the last measurement before the first fit."""
    z, m = measurements.z, measurements.n_modes
    block = max(round(REFIT / measurements.dt), 4 * (PAST + FUTURE) * m)
    H, size = histories(z, PAST), (PAST + FUTURE) * m
    moments, done, out, sd = np.zeros((size, size)), 0, z.copy(), np.full_like(z, np.nan)
    for start in range(block, len(z), block):
        watch.step(start / len(z))
        stop = start - FUTURE + 1  # z[stop - 1 + FUTURE] is known at step `start`
        moments += joint_moments(H, z, done, stop, FUTURE)
        done = stop
        found = fit_subspace(moments, done, m, PAST)
        out[start : start + block] = H[start : start + block] @ found.weights
        sd[start : start + block] = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    return whole_estimate(out, sd)


SUBSPACE = Challenger(
    Observer(
        "subspace",
        "Subspace predictor",
        TARGETS,
        run_subspace,
        help="the combinations of the past that predict the future, by canonical correlations",
    ),
    WHOLE,
    "Haffert et al. 2021, JATIS 7, 029001; Larimore 1990",
)
