"""How sure a Kalman filter is: the standard deviation of its error by its own model, in its steady state.

With P the covariance of the state after the measurement, the error of the estimate h x_hat[k] is h P h'. P is the same at every
step, or repeats with the NGS frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from wfsobs.observers.base import TARGETS
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.kalman.step import matrix_power
from wfsobs.signal.filter_covariance import lyapunov
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.stepping import Gain
from wfsobs.typing import Array


def target_sd(rows: Array, posteriors: Sequence[Array]) -> Array:
    """Return the standard deviation of rows (p, n) of the state, the first states of a filter, (steps that repeat, p)."""
    n = rows.shape[1]
    return np.sqrt([np.maximum(np.sum((rows @ P[:n, :n]) * rows, axis=1), 0.0) for P in posteriors])


def over_record(sd: Array, n_steps: int, first: int = 0) -> Array:
    """Return numbers that repeat, (steps that repeat, n_modes), for every step of a record from `first` on, NaN before."""
    if len(sd) == 1 and first == 0:
        return np.broadcast_to(sd, (n_steps, sd.shape[1]))
    out = np.full((n_steps, sd.shape[1]), np.nan)
    out[first:] = np.resize(sd, (max(n_steps - first, 0), sd.shape[1]))
    return out


def by_target(columns: Sequence[Array], sd: Sequence[Array] = (), first: int = 0) -> Estimates:
    """Return results per mode (n_steps, n_targets) by target.

    sd : per mode (steps that repeat, n_targets), from step `first` on
    """
    values, n_steps = np.stack(columns, axis=-1), len(columns[0])
    spreads = np.stack(sd, axis=-1) if len(sd) else None
    return Estimates(
        {target: values[:, i] for i, target in enumerate(TARGETS)},
        None if spreads is None else {target: over_record(spreads[:, i], n_steps, first) for i, target in enumerate(TARGETS)},
    )


class FrameErrors:
    """Errors of a filter that sees NGS frames alone, where its model is true at the fast step and a frame is the mean that it is.

    The pair (state xi of the fast model with the running frame, estimate x_hat) after a frame is stationary from frame to frame:

        xi[i+1] = Phi xi[i] + w,    x_hat[i+1] = F x_hat[i] + L (c xi[i+1] + v).

    Parameters
    ----------
    model : DisturbanceModel
        At the fast step.
    slow : Gain
        The filter of the frames.
    ratio : int
        Fast steps per frame.
    noise : float
        RMS of a frame's noise [um].
    """

    def __init__(self, model: DisturbanceModel, slow: Gain, ratio: int, noise: float):
        n, L, c = len(model.A), slow.L, np.eye(len(model.A) + 1)[-1:]
        A, Q = block_diag(model.A, [[1.0]]), block_diag(model.Q, [[0.0]])
        A[n, :n] = sum(model.outputs.values()) / ratio
        Phi, W = np.diag([*np.ones(n), 0.0]), np.zeros_like(A)  # a frame that has been read starts anew
        for _ in range(ratio):
            Phi, W = A @ Phi, A @ W @ A.T + Q
        reduced = (np.eye(len(L)) - L @ slow.C) @ slow.A
        seen = np.vstack([np.eye(n + 1), L @ c])
        transition = np.hstack([seen @ Phi, np.vstack([np.zeros((n + 1, len(L))), reduced])])
        S = lyapunov(transition, seen @ W @ seen.T + block_diag(np.zeros_like(W), noise**2 * L @ L.T))
        self._A, self._states, self._cross, self._estimates = model.A, S[:n, :n], S[:n, n + 1 :], S[n + 1 :, n + 1 :]

    def sd(self, now: Array, row: Array, since: float) -> float:
        """Return the standard deviation of the estimate row x_hat of now x, that many fast steps after the frame [um]."""
        ahead = now @ matrix_power(self._A, since)
        variance = now @ self._states @ now - 2.0 * ahead @ self._cross @ row + row @ self._estimates @ row
        return float(np.sqrt(max(variance, 0.0)))
