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
    x, total, turned = np.zeros(h.shape, dtype=kind), np.zeros(len(r), dtype=kind), A.swapaxes(1, 2)
    P = P.astype(kind)
    for k, sample in enumerate(z):
        Ph = np.einsum("mij,mj->mi", P, h)
        ahead[k], spread = np.sum(h * x, axis=1), np.sum(h * Ph, axis=1)
        innovation[k] = S = spread + r
        mean[k], variance[k] = ahead[k], spread
        if sample == sample:
            v = sample - ahead[k]
            total -= 0.5 * (np.log(2.0 * np.pi * S) + v * v / S)
            gain = Ph / S[:, None]
            x = x + gain * v[:, None]
            P = P - gain[:, :, None] * Ph[:, None, :]
            mean[k], variance[k] = ahead[k] + spread / S * v, spread * r / S
        x = np.einsum("mij,mj->mi", A, x)
        P = A @ P @ turned + Q
        P = 0.5 * (P + P.swapaxes(1, 2))
    return mean, variance, ahead, innovation, total
