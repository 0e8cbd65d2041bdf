"""Covariances of a filter of given gains, in its steady state: Lyapunov equations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wfsobs.typing import Array

Step = tuple[Array, Array, Array, Array]
"""(A, C, Q, R) of one step: measure with C and R, then predict with A and Q."""


class RiccatiError(ValueError):
    """Error: no usable steady-state filter for the given model; one line with the reason."""


def posteriors_of_gains(cycle: Sequence[Step], gains: Sequence[Array]) -> list[Array]:
    """Return the covariances of a filter whose gains need not be optimal, in its steady state.

    Parameters
    ----------
    cycle : sequence of Step
        (A, C, Q, R) of every step of the cycle, as for `steady_state`.
    gains : sequence of Array
        Filter gain of every step, (n, m).

    Returns
    -------
    list of Array
        Covariance after the measurement of every step, (n, n).

    Raises
    ------
    RiccatiError
        The filter is not stable.
    """
    F, W = np.eye(len(cycle[0][0])), np.zeros_like(cycle[0][0])
    for (A, C, Q, R), L in zip(cycle, gains, strict=True):
        reduced = np.eye(len(A)) - L @ C
        W = A @ (reduced @ W @ reduced.T + L @ R @ L.T) @ A.T + Q
        F = A @ reduced @ F
    P, out = lyapunov(F, W), []
    for (A, C, Q, R), L in zip(cycle, gains, strict=True):
        reduced = np.eye(len(A)) - L @ C
        out.append(reduced @ P @ reduced.T + L @ R @ L.T)
        P = A @ out[-1] @ A.T + Q
    return out


def lyapunov(F: Array, W: Array) -> Array:
    """Solve S = F S F' + W by doubling the number of terms of its series in every pass.

    Parameters
    ----------
    F, W : Array
        Transition matrix, stable, and covariance of the drive, both (n, n).

    Returns
    -------
    Array
        S, (n, n).

    Raises
    ------
    RiccatiError
        F is not stable.
    """
    S = W
    for _ in range(60):
        with np.errstate(over="ignore", invalid="ignore"):
            step = F @ S @ F.T
            S = S + step
            F = F @ F
        if not np.isfinite(S).all():
            break
        if np.abs(step).max() <= 1e-17 * np.abs(S).max():
            return 0.5 * (S + S.T)
    raise RiccatiError("the filter is not stable: its error would grow without bound")
