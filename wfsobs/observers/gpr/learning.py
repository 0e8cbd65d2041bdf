"""What the adaptive GPR learns from a window of measurements: inputs, kernel, targets, and the weights of its regression.

The spectrum of the window (`wfsobs.spectral.quick`) says which lines stand above the continuum, S_z = S_c + S_v. From it come

- the inputs: z whitened by the continuum, the innovations of a Kalman filter that knows of turbulence and noise alone. They are
  high-passed with the corner and the slope that the turbulence has, and lines stand out of them;
- the kernel: weights of a window with the spectrum S_v S_c / S_z: the bands of the lines, as wide as they rise above the
  continuum;
- the targets: the vibration that the smoother of that spectrum finds, from the past and the future of a step as far as they are
  in the window. The expectation given the window of x of a quantity and of its expectation given all of z are the same, so that a
  regression on them tends to the best there is, without the lag of causal band-passes and without their turbulence.

The kernel is linear, and its weights are a process in the lag: the target of the window x, its newest sample first, is
f = w'x + noise, with w ~ N(0, s^2 C) and C (depth, depth) the covariance of a stationary process: kernel s^2 x'C x' on windows,
weights that oscillate in the bands of C alone. With C = L L' (L of as many columns as C has digits in those bands) and X the
windows as rows, the posterior mean of w is

    w = L (L'X'X L + lambda I)^-1 L'X'f,    lambda = sigma_n^2 / s^2,

which is k(x)' (K + sigma_n^2 I)^-1 f of the regression on windows, at a cost in which their number does not enter. lambda and
sigma_n are the likeliest (marginal likelihood, sigma_n in closed form).
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided, sliding_window_view
from scipy.linalg import toeplitz
from scipy.linalg.lapack import dpstrf

from wfsobs.observers.estimates import VIBRATION
from wfsobs.observers.kalman.single import MIN_NOISE
from wfsobs.signal.periodic import FilterStep, PeriodicFilter
from wfsobs.signal.riccati import steady_state
from wfsobs.signal.smoother import smoother
from wfsobs.signal.statespace import DisturbanceModel, disturbance_model
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.periodogram import periodogram, periodogram_frequencies
from wfsobs.spectral.quick import quick_spectrum
from wfsobs.spectral.search import missed_variance
from wfsobs.typing import Array

WORTH = 8.0
"""Minimum gain of log-likelihood of a line that is learnt: twice what the fit asks, since a false one is turbulence."""
BINS = 16384
"""Steps of the DFT that turns the spectrum of weights into their covariance; more than twice the depth."""
DIGITS = 3e-3
"""Of C, over its largest number: what is smaller is in no band. With a thousandth of it errors change by 1e-4 of themselves."""
RATIOS = np.logspace(-6.0, 4.0, 81)
"""lambda over that mean among which the likeliest is chosen; the estimate changes little from one to the next."""
SETTLED = 2
"""Depths of a window until filters that start at rest have settled: the first training window ends there."""


class Learnt(NamedTuple):
    """What has been learnt from one window.

    fit     : its spectrum, None before the first
    mean    : of the window [um]
    weights : of the whitened samples, the newest first, (depth,); zero where no line stands above the continuum
    sd      : standard deviation of the estimate's error [um]: by the model, and what lines may be missed; NaN before the first
    """

    fit: Spectrum | None
    mean: float
    weights: Array
    sd: float

    @property
    def whitener(self) -> FilterStep:
        """The filter of the inputs."""
        return whitener_of(self.fit)


def nothing_learnt(depth: int) -> Learnt:
    """Return what is known before the first window: there is no estimate."""
    return Learnt(None, 0.0, np.full(depth, np.nan), np.nan)


def learn(z: Array, dt: float, depth: int, most: int, lowest: float, last: Learnt, horizon: int = 0) -> Learnt:
    """Learn from a window z (n,) [um]; where it has no spectrum, what was learnt last stays.

    depth : samples in a window of the regression; most, lowest : maximum number and minimum frequency [Hz] of lines; horizon :
    steps from a window's end to its target
    """
    mean = float(z.mean())
    z = z - mean
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            fit = quick_spectrum(z, dt, most, lowest, last.fit)
            lines = standing(fit, z)
            missed = missed_variance(lines, z, lowest)
            if not lines.resonances:
                return Learnt(fit, mean, np.zeros(depth), float(np.sqrt(missed)))
            target = smoother(_model(lines), VIBRATION, max(lines.noise, MIN_NOISE))
            x = PeriodicFilter([whitener_of(fit)]).run(z[:, None, None])[:, 0, 0]
            first = SETTLED * depth
            found = fit_bands(x, target.run(z)[first + horizon :], first, weight_covariance(lines, depth))
            sd = np.sqrt(target.variance + found.noise**2 + found.spread**2 + missed)
            return Learnt(fit, mean, found.weights, float(sd))
    except (ValueError, ArithmeticError):
        return last


def standing(fit: Spectrum, z: Array) -> Spectrum:
    """Return the spectrum with the lines alone that are worth WORTH in log-likelihood of z (n,), mean zero."""
    f, found = periodogram_frequencies(len(z), fit.dt), periodogram(z, fit.dt)
    S = fit.psd(f)
    without = [np.maximum(S - line.psd(f), 1e-6 * S) for line in fit.resonances]
    worth = [float(np.sum(np.log(rest / S) + found / rest - found / S)) for rest in without]
    kept = tuple(line for line, gain in zip(fit.resonances, worth, strict=True) if gain > WORTH)
    return replace(fit, resonances=kept)


@lru_cache(maxsize=64)
def whitener_of(fit: Spectrum | None) -> FilterStep:
    """Return the filter z -> innovations of the continuum, over their rms, and their states; (F, G, H, J)."""
    if fit is None or fit.turbulence is None:
        noise = 1.0 if fit is None else max(fit.noise, MIN_NOISE)
        return np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), np.array([[1.0 / noise]])
    model, noise = disturbance_model(fit.continuum, []), max(fit.noise, MIN_NOISE)
    s, C = steady_state(model.A, model.C, model.Q, np.array(noise**2)), model.C[None]
    scale = np.sqrt(float((C @ s.P @ C.T)[0, 0]) + noise**2)
    return model.A - s.K @ C, s.K, -C / scale, np.array([[1.0 / scale]])


def weight_covariance(lines: Spectrum, depth: int) -> Array:
    """Return the covariance of the weights at lags 0 ... depth - 1, (depth,), of the spectrum S_v S_c / S_z."""
    f = np.fft.rfftfreq(BINS, lines.dt)
    whole, continuum = lines.psd(f), replace(lines, resonances=()).psd(f)
    return np.fft.irfft((whole - continuum) * continuum / whole)[:depth]


def _model(lines: Spectrum) -> DisturbanceModel:
    return disturbance_model(lines.continuum, lines.resonances)


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
