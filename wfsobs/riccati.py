"""Steady-state Kalman gains: the discrete algebraic Riccati equation by structured doubling.

P = A P A' - A P C' (C P C' + R)^-1 C P A' + Q (paper, eq. 9b).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class RiccatiError(ValueError):
    """No usable steady-state filter for the given model; one line saying why."""


@dataclass(frozen=True)
class SteadyState:
    """P (n, n) predicted covariance; L (n, m) filter gain; K = A L (n, m) predictor gain;
    filtered (n, n) covariance after the measurement."""

    P: Array
    L: Array
    K: Array
    filtered: Array


def steady_state(A: Array, C: Array, Q: Array, R: Array, tolerance: float = 1e-14) -> SteadyState:
    """Solve the Riccati equation and return covariance and gains.

    A (n, n), C (m, n) or (n,), Q (n, n), R (m, m) or scalar, R positive definite, A stable.
    Structured doubling: with A_0 = A', G_0 = C' R^-1 C, H_0 = Q, each pass squares the closed-loop
    matrix, and H converges to P from below, quadratically. Measurements are whitened by R and the
    unit is that of the largest entry of R first, so the result does not depend on the unit.
    Raises RiccatiError where R is not positive definite or no stable solution is reached.
    """
    C = np.atleast_2d(C)
    R = np.atleast_2d(np.asarray(R, dtype=float))
    try:
        root = np.linalg.cholesky(R)
    except np.linalg.LinAlgError:
        raise RiccatiError("the measurement noise must be above zero") from None
    Cw = np.linalg.solve(root, C)
    n = A.shape[0]
    identity = np.eye(n)
    Ak, G, H = A.T.copy(), Cw.T @ Cw, Q.copy()
    for _ in range(60):
        W = np.linalg.solve(identity + G @ H, np.hstack([Ak, G]))
        step = Ak.T @ H @ W[:, :n]
        G = G + Ak @ W[:, n:] @ Ak.T
        Ak = Ak @ W[:, :n]
        H = H + step
        H, G = 0.5 * (H + H.T), 0.5 * (G + G.T)
        if not np.isfinite(H).all():
            break
        if np.abs(step).max() <= tolerance * np.abs(H).max():
            return _checked(A, C, Q, R, H)
    raise RiccatiError("the Riccati equation did not converge")


def _checked(A: Array, C: Array, Q: Array, R: Array, P: Array) -> SteadyState:
    S = C @ P @ C.T + R
    L = np.linalg.solve(S, C @ P).T
    # Joseph form: a sum of squares, so the covariance stays symmetric and non-negative.
    reduced = np.eye(len(A)) - L @ C
    filtered = reduced @ P @ reduced.T + L @ R @ L.T
    residual = np.abs(A @ filtered @ A.T + Q - P).max()
    if residual > 1e-8 * np.abs(P).max():
        raise RiccatiError(f"the Riccati equation is not met: residual {residual:.1e} of {np.abs(P).max():.1e}")
    radius = np.abs(np.linalg.eigvals(A @ reduced)).max()
    if radius >= 1.0:
        raise RiccatiError(f"the steady-state filter is not stable: spectral radius {radius:.6f}")
    return SteadyState(P, L, A @ L, filtered)
