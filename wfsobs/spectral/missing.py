"""Missing samples of one mode: their expected values for a given spectrum, and the share of bins lost with them. Outlying ones.

A filled record is not a measurement: it has no noise in its gaps. With C the covariance of the complete record (circulant, of
eigenvalues S), the filled record is the conditional mean of the complete one given the measured samples; the expected periodogram
of the complete one is that of the filled one plus V(f), the spectrum of the unknown part. V is estimated from records drawn
from S with the same gaps, then filled: any gaps, single or in bursts. Fitting S to I + V and filling anew is the EM algorithm
(Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1, 1977), which ends at the maximum of Whittle's likelihood of the samples.
"""

from __future__ import annotations

from itertools import pairwise
from math import ceil, log

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.fft import irfft, rfft
from scipy.ndimage import binary_opening, median_filter
from scipy.sparse.linalg import LinearOperator, cg

from wfsobs.spectral.whittle import periodogram
from wfsobs.typing import Array

DRAWS = 2
"""Records drawn for V. Its scale is known: the shares of all bins add up to the share of measured samples."""
BANDS = 40
"""Bands over which V is smoothed. Of single samples it is flat where S is white or far above noise: a resonance makes no step."""
LONG = 20
"""Samples in a row that are a long gap. It hides resonances and noise alike, so V / S is smoothed, not V."""
CLOSE, MOST = 1e-4, 300
"""Approximate error of a filled sample, over the noise, at which conjugate gradients stop; maximum number of steps."""
LEAST = 1e-3
"""Minimum measured share of a bin."""
HALF = 8
"""Samples to either side from which a sample is predicted."""
FAR = 5.0
"""Standard deviations beyond which a sample is outlying: one in 2e6 of Gaussian noise."""
PART = 500
"""Samples over which a standard deviation is taken, by a median; of a part and its neighbours the largest holds."""
MOST_OUTLYING = 0.1
"""Maximum share of outlying samples: beyond it they are what the sensor measures."""


class MissingSamples:
    """The missing samples of one mode.

    Parameters
    ----------
    is_missing : Array
        Which samples are missing, bool (n,).
    dt : float
        Time step [s].
    rng : numpy.random.Generator, optional
        For the records drawn; who only fills has none.
    """

    is_missing: Array
    dt: float
    n: int
    noise: Array

    def __init__(self, is_missing: Array, dt: float, rng: np.random.Generator | None = None):
        self.is_missing, self.dt, self.n = is_missing, dt, len(is_missing)
        self.any: bool = bool(is_missing.any())
        self.noise = rng.standard_normal((DRAWS, self.n)) if self.any and rng is not None else np.zeros((0, self.n))

    def rounds(self, left: float) -> int:
        """Return the number of rounds of filling and fitting that leave `left` of the first error; 1 where nothing is missing."""
        return max(1, ceil(log(left) / log(self.is_missing.mean()))) if self.any else 1

    def interpolate(self, z: Array) -> Array:
        """Return z (n,) with straight lines through the gaps, for a first guess."""
        k = np.arange(self.n)
        return np.interp(k, k[~self.is_missing], z[~self.is_missing]) if self.any else z

    def fill(self, z: Array, S: Array) -> Array:
        """Return z (n,) with the missing samples replaced by their expectation for the density S (bins,), given all others."""
        weight = self._at_all_frequencies(S)
        weight = weight.min() / weight

        def weighted(x: Array) -> Array:
            return irfft(weight * rfft(x), self.n)

        def within(x: Array) -> Array:
            whole = np.zeros(self.n)
            whole[self.is_missing] = x
            return weighted(whole)[self.is_missing]

        start = self.interpolate(z)
        out, count = start.copy(), int(self.is_missing.sum())
        rest = -weighted(start)[self.is_missing]
        size = CLOSE * np.sqrt(count * S.min() / (2.0 * self.dt))
        move, _ = cg(LinearOperator((count, count), matvec=within, dtype=float), rest, rtol=0.0, atol=size, maxiter=MOST)
        out[self.is_missing] += move
        return out

    def draw_errors(self, S: Array) -> Array:
        """Return the errors of the fills of records drawn from the density S, (DRAWS, n): missing samples minus their fill."""
        root = np.sqrt(self._at_all_frequencies(S) / (2.0 * self.dt))
        drawn = irfft(root * rfft(self.noise), self.n)
        return np.array([x - self.fill(x, S) for x in drawn])

    def measured_share(self, S: Array, unknown: Array) -> Array:
        """Return the measured share 1 - V / S of every bin, (bins,): for white noise the share of measured samples."""
        is_long, V = binary_opening(self.is_missing, np.ones(LONG, int)), np.zeros_like(S)
        for part, unit in ((is_long, S), (~is_long, np.ones_like(S))):
            V += unit * _smooth(np.mean([periodogram(e * part, self.dt) for e in unknown], axis=0) / unit)
        return np.maximum(1.0 - V / S * self.is_missing.mean() / np.mean(V / S), LEAST)

    def _at_all_frequencies(self, S: Array) -> Array:
        """Return a density at all frequencies of rfft, zero included."""
        return np.concatenate([S[:1], S, S[-1:]])[: self.n // 2 + 1]


def _smooth(V: Array) -> Array:
    """Return V (bins,) smoothed over BANDS."""
    j = np.arange(1.0, len(V) + 1.0)
    edges = np.unique(np.concatenate([[0], np.geomspace(1, len(V), BANDS).astype(int)]))
    centre, level = (np.array([x[a:b].mean() for a, b in pairwise(edges)]) for x in (np.log(j), V))
    return np.exp(np.interp(np.log(j), centre, np.log(np.maximum(level, np.finfo(float).tiny))))


def find_outlying(z: Array) -> Array:
    """Return which samples of z (n,) are far from what their neighbours on both sides predict, bool (n,); NaN is missing.

    First those far from a running median, then, until it is the same ones, those far from the best linear prediction from the
    samples that are neither missing nor outlying: so an outlier does not make its neighbours look like others.
    """
    gone, k = np.isnan(z), np.arange(len(z))
    x = np.interp(k, k[~gone], z[~gone] - np.median(z[~gone]))
    out = _is_far(x - median_filter(x, 5), gone, 0.0)
    for _ in range(20):
        before, absent = out, gone | out
        out = _is_far(_prediction_errors(x, absent), absent, 0.05) & ~gone
        if (out == before).all():
            break
    return out if out.mean() <= MOST_OUTLYING else np.zeros_like(out)


def _is_far(errors: Array, absent: Array, least: float) -> Array:
    """Return which errors are more than FAR of their standard deviations around there, at least `least`."""
    size = np.abs(errors)
    parts = np.array_split(np.where(absent, np.nan, size), max(len(size) // PART, 1))
    scale = np.array([np.nanmedian(part) if np.isfinite(part).any() else 0.0 for part in parts]) / 0.6745
    scale = sliding_window_view(np.pad(scale, 1), 3).max(axis=1)
    return size > FAR * np.repeat(np.maximum(scale, least), [len(part) for part in parts])


def _prediction_errors(x: Array, absent: Array) -> Array:
    """Return x (n,) minus its prediction from what is not absent of the HALF samples on either side, over its deviation.

    The covariance is that of the windows without absent samples; zeros where there are too few, or nothing but zeros.
    """
    count = 2 * HALF
    windows = sliding_window_view(np.pad(np.where(absent, 0.0, x), HALF), count + 1)
    known = ~sliding_window_view(np.pad(absent, HALF, constant_values=True), count + 1)
    whole = known.all(axis=1)
    learnt = windows[whole]
    size = np.abs(learnt).max(initial=0.0)
    if len(learnt) < 10 * count or size == 0.0:
        return np.zeros_like(x)
    M = (learnt / size).T @ (learnt / size) / len(learnt)
    M = 0.5 * (M + M[::-1, ::-1]) + 1e-10 * np.trace(M) * np.eye(count + 1)
    beside = np.arange(count + 1) != HALF
    C, c = M[beside][:, beside], M[beside, HALF]
    weights = np.tile(np.linalg.solve(C, c), (len(x), 1))
    for some in np.array_split(np.flatnonzero(~whole), 1 + (~whole).sum() // 5000):  # for the memory
        there = known[some][:, beside]
        each = np.where(there[:, :, None] & there[:, None], C, np.eye(count))
        weights[some] = np.linalg.solve(each, np.where(there, c, 0.0)[..., None])[..., 0]
    return (x - (windows[:, beside] * weights).sum(axis=1)) / (size * np.sqrt(M[HALF, HALF] - weights @ c))
