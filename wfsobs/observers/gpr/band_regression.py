"""Gaussian process regression with a linear kernel whose weights are a process in the lag, in the space of these weights.

The target of the window x, its newest sample first, is f = w'x + noise, with w ~ N(0, s^2 C) and C (depth, depth) the covariance
of a stationary process: kernel s^2 x'C x' on windows, weights that oscillate in the bands of C alone. With C = L L' (L of as many
columns as C has digits in those bands) and X the windows as rows, the posterior mean of w is

    w = L (L'X'X L + lambda I)^-1 L'X'f,    lambda = sigma_n^2 / s^2,

which is k(x)' (K + sigma_n^2 I)^-1 f of the regression on windows, at a cost in which their number does not enter. lambda and
sigma_n are the likeliest (marginal likelihood, sigma_n in closed form).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided, sliding_window_view
from scipy.linalg import toeplitz
from scipy.linalg.lapack import dpstrf

from wfsobs.typing import Array

DIGITS = 3e-3
"""Of C, over its largest number: what is smaller is in no band. With a thousandth of it errors change by 1e-4 of themselves."""
RATIOS = np.logspace(-6.0, 4.0, 81)
"""lambda over that mean among which the likeliest is chosen; the estimate changes little from one to the next."""


class BandRegression(NamedTuple):
    """A regression.

    weights : posterior mean, the newest sample first, (depth,)
    noise   : sigma_n, rms of what windows cannot know of their targets [unit of targets]
    spread  : rms of the standard deviation of w'x over the training windows [same]
    ratio   : lambda
    """

    weights: Array
    noise: float
    spread: float
    ratio: float


def factor_of(covariance: Array, digits: float = DIGITS) -> Array:
    """Return L (depth, rank) of the stationary covariance (depth,), L L' = C but for `digits`."""
    C = toeplitz(covariance / covariance[0])
    factor, pivots, rank, _ = dpstrf(C, tol=digits, lower=1)
    out = np.zeros((len(C), rank))
    out[pivots - 1] = np.tril(factor[:, :rank])
    return out


def window_products(x: Array, targets: Array, first: int, depth: int) -> tuple[Array, Array]:
    """Return X'X (depth, depth) and X'f (depth,) of the windows that end at first ... first + len(targets) - 1.

    x : samples (n,); first >= depth. Inner products slide: the next on a diagonal has one sample less and one more.
    """
    end = first + len(targets)
    lags = x[first - depth + 1 : end]
    ends = [x[last - 1 : last - depth - 1 if last > depth else None : -1] for last in (first, end)]
    come, gone = (sliding_window_view(np.concatenate([part[:-1], np.zeros(depth)]), depth) * part[:, None] for part in ends)
    diagonals = np.cumsum(np.vstack([np.correlate(lags, x[first:end], "valid")[::-1], (come - gone)[:-1]]), axis=0)
    upper = np.zeros((depth, 2 * depth))
    as_strided(upper, diagonals.shape, (sum(upper.strides), upper.strides[1]))[...] = diagonals  # [i, j] at [i, i + j]
    upper = upper[:, :depth]
    return upper + np.triu(upper, 1).T, np.correlate(lags, targets, "valid")[::-1]


def fit_bands(x: Array, targets: Array, first: int, covariance: Array) -> BandRegression:
    """Fit the targets (m,) of the windows of x (n,) that end at step `first` and later; covariance : of weights, (depth,)."""
    L, m = factor_of(covariance), len(targets)
    gram, along = window_products(x, targets, first, len(L))
    values, vectors = np.linalg.eigh(L.T @ gram @ L)
    values, b = np.maximum(values, 0.0), vectors.T @ (L.T @ along)
    ratios = RATIOS * values.mean()
    rest = targets @ targets - np.sum(b**2 / (values + ratios[:, None]), axis=1)
    likelihood = -0.5 * (m * np.log(rest) + np.sum(np.log1p(values / ratios[:, None]), axis=1))
    best = int(np.argmax(likelihood))
    noise2, inverse = rest[best] / m, 1.0 / (values + ratios[best])
    return BandRegression(
        L @ (vectors @ (b * inverse)),
        float(np.sqrt(noise2)),
        float(np.sqrt(noise2 * np.sum(values * inverse) / m)),
        float(ratios[best]),
    )
