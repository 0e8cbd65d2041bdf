"""Fits of a spectral density to a power spectrum by the likelihood of Whittle (Ark. Mat. 2, 423, 1953).

With m bins of mean power I about a frequency, - log L = sum m (log S + I / S). Its gradient is sum m (1 - I / S) d log S, its
expected second derivatives are the Fisher information, sum m (d log S)(d log S)'. A trust-region method with these two finds the
minimum.

Bounds are kept by a change of variables, x = middle + half sin t (James and Roos, Comput. Phys. Commun. 10, 343, 1975). At an
active bound dx/dt is zero: the gradient by t vanishes at every minimum, inside or at a bound.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy.optimize import minimize

from wfsobs.typing import Array

Density = Callable[[Array], Array]
"""S at every frequency (n,), as a function of the parameters (p,)."""
LogSlopes = Callable[[Array, Array], Array]
"""d log S (p, n) by the parameters, as a function of these and of S."""

INSIDE = 1e-3
"""Minimum distance of the start from a bound, over half the width: at a bound the gradient by t is zero."""


def negative_log_likelihood(S: Array, mean: Array, count: Array) -> float:
    """Return - log L of the density S, without a constant; mean : I; count : m; all (n,)."""
    return float(count @ (np.log(S) + mean / S))


def information(log_slopes: Array, count: Array) -> Array:
    """Return the Fisher information (p, p) of parameters by which log S has these slopes (p, n)."""
    return (log_slopes * count) @ log_slopes.T


def whittle_fit(
    density: Density, log_slopes: LogSlopes, start: Array, bounds: Array, mean: Array, count: Array, tolerance: float, steps: int
) -> Array:
    """Find the parameters of the minimum of - log L near a start.

    Parameters
    ----------
    density, log_slopes : callable
        Density of the parameters, and the derivatives of its logarithm.
    start : Array
        First guess, (p,).
    bounds : Array
        Minimum and maximum of each parameter, (p, 2).
    mean, count : Array
        I and m at the frequencies of `density`, (n,).
    tolerance : float
        Norm of the gradient at which the search ends, with the parameters in units of their standard deviations at the start.
    steps : int
        Maximum number of steps.

    Returns
    -------
    Array
        Parameters, (p,).
    """
    middle, half = bounds.mean(axis=1), 0.5 * np.diff(bounds)[:, 0]
    first = np.arcsin(np.clip((start - middle) / half, INSIDE - 1.0, 1.0 - INSIDE))
    x = middle + half * np.sin(first)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information(log_slopes(x, density(x)), count)), 1e-3)) / (half * np.cos(first))

    @lru_cache(maxsize=2)
    def at(u: bytes) -> tuple[Array, Array, Array]:
        """t, x and S there: value, gradient and curvature take the same."""
        t = first + scale * np.frombuffer(u)
        x = middle + half * np.sin(t)
        return t, x, density(x)

    @lru_cache(maxsize=1)
    def slopes(u: bytes) -> tuple[Array, Array]:
        """Of log S and of - log L, by x."""
        _, x, S = at(u)
        d = log_slopes(x, S)
        return d, d @ (count * (1.0 - mean / S))

    def value(u: Array) -> float:
        return negative_log_likelihood(at(u.tobytes())[2], mean, count)

    def gradient(u: Array) -> Array:
        t, _, _ = at(u.tobytes())
        return scale * half * np.cos(t) * slopes(u.tobytes())[1]

    def curvature(u: Array) -> Array:
        t, _, _ = at(u.tobytes())
        d, by_x = slopes(u.tobytes())
        move = scale * half * np.cos(t)
        return information(d, count) * np.outer(move, move) + np.diag(1e-9 - scale**2 * half * np.sin(t) * by_x)

    found = minimize(
        value,
        np.zeros(len(start)),
        jac=gradient,
        hess=curvature,
        method="trust-exact",
        options={"maxiter": steps, "gtol": tolerance, "initial_trust_radius": 3.0, "max_trust_radius": 1e4},
    )
    return at(found.x.tobytes())[1]
