"""Gaussian process regression on evenly spaced samples by a Kalman filter, and its likelihood with the gradient.

    z[k] = f(k dt) + noise,    f ~ GP(0, kernel)

The filter starts from the prior, so that its predictions and its likelihood are those of the dense regression, sample by sample.
Derivatives are those of the complex step: with one hyper-parameter at x + i e, e = 1e-30, the imaginary part of the result over
e is its derivative, to rounding, as nothing is subtracted (Squire and Trapp, SIAM Review 40, 110, 1998).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from wfsobs.observers.gp.kernels import Kernel, Number
from wfsobs.typing import Array

TINY = 1e-30
"""Imaginary step of a derivative."""

STILL = 1e-14
"""Move in a step, over the largest element, below which a covariance is at rest: the gain then stays as it is."""

CHECKED = 16
"""Steps from one check for that to the next."""


class Regression(NamedTuple):
    """What the samples before say of each sample, and what it adds.

    mean, variance   : of f, given the samples before and including each, (n,)
    ahead, innovation : prediction of each sample by those before, and its variance, noise and all, (n,)
    log_likelihood   : of all samples
    """

    mean: Array
    variance: Array
    ahead: Array
    innovation: Array
    log_likelihood: float


def regress(kernel: Kernel, noise: float, dt: float, z: Array) -> Regression:
    """Run the regression over samples.

    Parameters
    ----------
    kernel : Kernel
        Covariance of f.
    noise : float
        Standard deviation of the noise [unit of z].
    dt : float
        Step [s].
    z : Array
        Samples, (n,); NaN is missing.

    Returns
    -------
    Regression
        Means, variances and likelihood.
    """
    found = _regressions([(kernel, noise)], dt, z)
    mean, variance, ahead, innovation = (x[:, 0] for x in found[:4])
    return Regression(mean, variance, ahead, innovation, float(found[4][0]))


def log_likelihood(make: Callable[[Array], tuple[Kernel, Number]], parameters: Array, dt: float, z: Array) -> tuple[float, Array]:
    """Return the log-likelihood of samples, and its gradient by the parameters.

    Parameters
    ----------
    make : callable
        Parameters (p,) -> kernel and standard deviation of the noise, analytic: it is called with complex numbers.
    parameters : Array
        Hyper-parameters, (p,).
    dt : float
        Step [s].
    z : Array
        Samples, (n,); NaN is missing.

    Returns
    -------
    float, Array
        Log-likelihood and its gradient (p,).
    """
    moved = np.asarray(parameters) + 1j * TINY * np.eye(len(parameters))
    total = _regressions([make(one) for one in moved], dt, z)[4]
    return float(np.real(total[0])), np.imag(total) / TINY


def _regressions(models: Sequence[tuple[Kernel, Number]], dt: float, z: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Run m regressions (kernel, noise) side by side; results (steps, m), and the log-likelihoods (m,)."""
    spaces = [kernel.state_space() for kernel, _ in models]
    A, Q = (np.array(parts) for parts in zip(*(space.discretise(dt) for space in spaces), strict=True))
    h, P = np.array([space.h for space in spaces]), np.array([space.P for space in spaces])
    return _filter(A, Q, h, P, np.array([noise**2 for _, noise in models]), z)


def _filter(A: Array, Q: Array, h: Array, P: Array, r: Array, z: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Run the filters: A, Q, P (m, n, n), h (m, n), r (m,)."""
    kind = np.result_type(A, Q, h, P, r)
    mean, variance, ahead, innovation = np.empty((4, len(z), len(r)), dtype=kind)
    x, turned = np.zeros(h.shape, dtype=kind), A.swapaxes(1, 2)
    P, is_still, k = P.astype(kind), False, 0
    missing = np.isnan(z)
    known = np.where(missing, 0.0, z)
    gaps = np.append(np.flatnonzero(missing), len(z))
    while k < len(z):
        Ph = np.einsum("mij,mj->mi", P, h)
        spread = np.sum(h * Ph, axis=1)
        S = spread + r
        gain = Ph / S[:, None] * (not missing[k])
        stop = int(gaps[np.searchsorted(gaps, k)]) if is_still and not missing[k] else k + 1
        variance[k:stop], innovation[k:stop] = spread, S
        x = _predict(A, h, gain, x, known[k:stop], ahead[k:stop])
        following = A @ (P - gain[:, :, None] * Ph[:, None, :]) @ turned + Q
        following = 0.5 * (following + following.swapaxes(1, 2))
        is_still = not missing[k] and k % CHECKED == 0 and _is_still(P, following)
        P, k = following, stop
    there = ~missing
    v, S = z[there, None] - ahead[there], innovation[there]
    mean[:] = ahead
    mean[there] += variance[there] / S * v
    variance[there] *= r / S
    return mean, variance, ahead, innovation, -0.5 * np.sum(np.log(2.0 * np.pi * S) + v * v / S, axis=0)


def _predict(A: Array, h: Array, gain: Array, x: Array, z: Array, ahead: Array) -> Array:
    """Write the predictions of samples, with a gain that stays as it is, and return the states after them, (m, n)."""
    driven = (A @ gain[:, :, None])[:, :, 0]
    step = np.concatenate([h[:, None], A - driven[:, :, None] * h[:, None]], axis=1)  # to the sample, and to the next state
    for i, sample in enumerate(z):
        found = (step @ x[:, :, None])[:, :, 0]
        ahead[i], x = found[:, 0], found[:, 1:] + driven * sample
    return x


def _is_still(P: Array, following: Array) -> bool:
    """Return whether the covariances, and their derivatives, have come to rest."""
    moved = following - P
    parts = ((np.real(moved), np.real(P)), (np.imag(moved), np.imag(P)))
    return all(bool((np.abs(m).max(axis=(1, 2)) <= STILL * np.abs(of).max(axis=(1, 2))).all()) for m, of in parts)
