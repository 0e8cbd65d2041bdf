"""How sure a Kalman filter is: the standard deviation of its error by its own model, in its steady state.

With P the covariance of the state after the measurement, the error of the estimate h x_hat[k] is h P h'. P is the same at every
step, or repeats with the NGS frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from wfsobs.observers.base import TARGETS
from wfsobs.observers.estimates import NEXT_Z, TOTAL, Estimates
from wfsobs.observers.kalman.step import KalmanEstimator, matrix_power
from wfsobs.signal.filter_covariance import lyapunov
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.stepping import Gain
from wfsobs.typing import Array


def target_sd(rows: Array, posteriors: Sequence[Array]) -> Array:
    """Return the standard deviation of rows (p, n) of the state, the first states of a filter, (steps that repeat, p)."""
    n = rows.shape[1]
    return np.sqrt([np.maximum(np.sum((rows @ P[:n, :n]) * rows, axis=1), 0.0) for P in posteriors])


def learnt_sd(rows: Array, posteriors: Sequence[Array], hidden_rms: float) -> Array:
    """Return the standard deviations of targets and of TOTAL by a model that was learnt, (steps that repeat, 3) [um].

    rows       : of the targets
    hidden_rms : rms of vibration that may be in none of its lines, taken for turbulence, not missing in both together [um]
    """
    return with_hidden(target_sd(np.vstack([rows, rows.sum(axis=0)]), posteriors), hidden_rms)


def with_hidden(sd: Array, hidden_rms: float) -> Array:
    """Return standard deviations of the targets and TOTAL, (..., 3) [um], with what is hidden, as in `learnt_sd`."""
    return np.hypot(sd, hidden_rms * np.array([1.0, 1.0, 0.0]))


def learnt_estimate(kalman: KalmanEstimator | None, mean: float, hidden_rms: float) -> tuple[Array, Array]:
    """Return the estimates (2,) of the last frame by the filter of one mode, and deviations of these and TOTAL, (3,) [um].

    mean : of its window, which is turbulence, and all that is known without a filter [um]; NaN where there is no window yet
    hidden_rms : as in `learnt_sd`
    """
    of_window = np.array([mean, 0.0 * mean])
    if kalman is None:
        return of_window, np.full(3, np.nan)
    values, sd = kalman.estimate()
    return values[:, 0] + of_window, with_hidden(sd[:3, 0], hidden_rms)


def over_record(sd: Array, n_steps: int, first: int = 0) -> Array:
    """Return numbers that repeat, (steps that repeat, n_modes), for every step of a record from `first` on, NaN before."""
    if len(sd) == 1 and first == 0:
        return np.broadcast_to(sd, (n_steps, sd.shape[1]))
    out = np.full((n_steps, sd.shape[1]), np.nan)
    left = max(n_steps - first, 0)
    out[first:] = np.tile(sd, (-(-left // len(sd)), 1))[:left]
    return out


def by_target(columns: Sequence[Array], sd: Sequence[Array] = (), first: int = 0) -> Estimates:
    """Return results per mode (n_steps, n_targets) by target.

    sd : per mode (steps that repeat, 2 or 4), as of `by_name`, from step `first` on
    """
    values, n_steps = np.stack(columns, axis=-1), len(columns[0])
    spreads = np.stack(sd, axis=-1) if len(sd) else None
    return Estimates(
        by_name(values),
        None if spreads is None else {name: over_record(x, n_steps, first) for name, x in by_name(spreads).items()},
    )


def by_name(x: Array) -> dict[str, Array]:
    """Return the columns of x (n, 2 to 4, n_modes) by what they are: targets, and of standard deviations TOTAL and NEXT_Z."""
    return {name: x[:, i] for i, name in zip(range(x.shape[1]), (*TARGETS, TOTAL, NEXT_Z), strict=False)}


class FrameErrors:
    """Errors of a filter that sees NGS frames alone, where its model is true at the fast step and a frame is the mean that it is.

    The pair (state xi of the fast model with the running frame, estimate x_hat) after a frame goes on from frame to frame as

        xi[i+1] = Phi xi[i] + w,    x_hat[i+1] = F x_hat[i] + L (c xi[i+1] + v).

    Attributes
    ----------
    steady : Array
        Its covariance, the same after every frame unless one is missing.

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
        n = len(model.A)
        A, Q = block_diag(model.A, [[1.0]]), block_diag(model.Q, [[0.0]])
        A[n, :n] = sum(model.outputs.values()) / ratio
        Phi, W = np.diag([*np.ones(n), 0.0]), np.zeros_like(A)  # a frame that has been read starts anew
        for _ in range(ratio):
            Phi, W = A @ Phi, A @ W @ A.T + Q
        self._A, self._Phi, self._W, self._noise = model.A, Phi, W, noise
        self.steady = lyapunov(*self._map((np.eye(len(slow.L)) - slow.L @ slow.C) @ slow.A, slow.L))

    def _map(self, F: Array, L: Array) -> tuple[Array, Array]:
        """Return transition and drive of the pair; F (n, n), L (n, 1): x_hat[i+1] = F x_hat[i] + L z[i+1]."""
        m, W = len(self._Phi), self._W
        seen = np.vstack([np.eye(m), L @ np.eye(m)[-1:]])
        transition = np.hstack([seen @ self._Phi, np.vstack([np.zeros((m, len(L))), F])])
        return transition, seen @ W @ seen.T + block_diag(np.zeros_like(W), self._noise**2 * L @ L.T)

    def after(self, S: Array, update: Array) -> Array:
        """Return the covariance after a frame with another gain; update (n, n + 1): of x_hat and the frame."""
        T, drive = self._map(update[:, :-1], update[:, -1:])
        return T @ S @ T.T + drive

    def sd(self, now: Array, row: Array, since: float, S: Array | None = None) -> float:
        """Return the standard deviation of the estimate row x_hat of now x, that many fast steps after the frame [um].

        S : covariance of the pair, by default the steady one
        """
        S, n, m = self.steady if S is None else S, len(self._A), len(self._Phi)
        ahead = now @ matrix_power(self._A, since)
        variance = now @ S[:n, :n] @ now - 2.0 * ahead @ S[:n, m:] @ row + row @ S[m:, m:] @ row
        return float(np.sqrt(max(variance, 0.0)))
