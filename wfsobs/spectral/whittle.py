"""The tapered periodogram of one mode, its missing samples, and fits of a `Spectrum` to it by Whittle's likelihood.

The expected values of missing samples are those for a given spectrum. A filled record is not a measurement: it has no noise in
its gaps. With C the covariance of the complete record (circulant, of eigenvalues S), the filled record is the conditional mean of
the complete one given the measured samples; the expected periodogram of the complete one is that of the filled one plus V(f), the
spectrum of the unknown part. V is estimated from records drawn from S with the same gaps, then filled: any gaps, single or in
bursts. Fitting S to I + V and filling anew is the EM algorithm (Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1, 1977), which
ends at the maximum of Whittle's likelihood of the samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from itertools import pairwise
from math import ceil, log

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import binary_opening, median_filter
from scipy.optimize import least_squares
from scipy.sparse.linalg import LinearOperator, cg
from scipy.special import logit

from wfsobs.record import hold_last
from wfsobs.signal import whittle
from wfsobs.signal.autoregressive import Ar2
from wfsobs.spectral.model import Spectrum
from wfsobs.typing import Array

TAPERED, MOST_TAPERED = 500, 0.05
"""Samples under the cosine at either end of a record, and their maximum share.

Leakage of turbulence over the noise falls as f^-6 beyond two periods of it, 4 Hz at 1 kHz, below which no noise is visible; more
would cost power of lines.
"""
FINE, NEAR = 200, 8
"""A cell is at most 1 / FINE of its frequency wide, and 1 / NEAR of its distance to the next resonance."""


@lru_cache(maxsize=4)
def taper(n: int) -> Array:
    """Return Tukey's taper for n samples, its mean square 1, (n,)."""
    k, edge = np.arange(n), min(TAPERED / n, MOST_TAPERED) * (n - 1)
    h = 0.5 - 0.5 * np.cos(np.pi * np.minimum(np.minimum(k, k[::-1]) / edge, 1.0))
    h /= np.sqrt(np.mean(h**2))
    h.flags.writeable = False
    return h


@lru_cache(maxsize=4)
def inflation(n: int) -> float:
    """Return the factor by which the taper raises the variance of a mean over bins.

    n sum h^4 / (sum h^2)^2: 1.009 at 60 000 samples.
    """
    return float(np.mean(taper(n) ** 4))


def periodogram(x: Array, dt: float, pad: int = 1) -> Array:
    """Compute the one-sided periodogram [unit^2/Hz] of x (n,) at j / (pad n dt), j = 1, 2, ... below Nyquist."""
    n = len(x)
    spectrum = rfft(taper(n) * x, pad * n)[1 : (pad * n + 1) // 2]
    return 2.0 * dt / n * (spectrum.real**2 + spectrum.imag**2)


def periodogram_frequencies(n: int, dt: float, pad: int = 1) -> Array:
    """Return the frequencies [Hz] of `periodogram`."""
    return np.arange(1, (pad * n + 1) // 2) / (pad * n * dt)


def fast_length(n: int) -> int:
    """Return the longest length up to n whose Fourier transform is fast, at most 2 % shorter, or n."""
    for length in range(n, int(0.98 * n), -1):
        if next_fast_len(length) == length:
            return length
    return n


class Cells:
    """Bins of a periodogram, averaged where the spectrum is smooth.

    Parameters
    ----------
    f, I : Array
        Frequencies [Hz] and periodogram, (bins,).
    keep : Array
        Bins in use, bool (bins,).
    resonances : iterable of float
        Frequencies [Hz] near which cells stay narrow.
    share : Array or float
        Measured share of each bin (`measured_share`); by default all.
    sizes : tuple of int
        As FINE and NEAR.

    Attributes
    ----------
    bin_width : float
        1 / length of the record [Hz].
    frequency, mean, count, share : Array
        Frequency [Hz], mean of the periodogram, number of bins and measured share, each (cells,).
    """

    bin_width: float
    count: Array
    frequency: Array
    mean: Array
    share: Array

    def __init__(
        self,
        f: Array,
        I: Array,  # noqa: E741
        keep: Array,
        resonances: Iterable[float] = (),
        share: Array | float = 1.0,
        sizes: tuple[int, int] = (FINE, NEAR),
    ):
        self.bin_width, j = float(f[0]), np.arange(1.0, len(f) + 1.0)
        fine, near = sizes
        size = np.maximum(j / fine, 1.0)
        for centre in resonances:
            bin_ = centre / f[0]
            # no further off than where |j - bin| / near = j / fine, cells are narrower than elsewhere
            first, last = int(bin_ * fine / (fine + near)), int(bin_ * fine / (fine - near)) + 1
            size[first:last] = np.minimum(size[first:last], np.maximum(np.abs(j[first:last] - bin_) / near, 1.0))
        cell = np.floor(np.cumsum(1.0 / size) + 1e-6).astype(int)
        count = np.bincount(cell, keep)
        used = count > 0
        self.count = count[used]
        self.frequency = np.bincount(cell, keep * f)[used] / self.count
        self.mean = np.bincount(cell, keep * I)[used] / self.count
        self.share = np.bincount(cell, keep * share)[used] / self.count

    def misfit(self, spectrum: Spectrum) -> float:
        """Return - log L of a spectrum, without a constant."""
        return whittle.negative_log_likelihood(spectrum.psd(self.frequency), self.mean, self.count)


STEPS = 40
"""Maximum number of steps of a fit."""
TOLERANCE = 1e-2
"""Distance of a fit from its minimum, in standard deviations of its parameters."""
NOISE, TURBULENCE, BACKGROUND, RESONANCE = 3.0, (2.0, 8.0, 4.0, 3.0), (1.5, 0.0, 4.0), (0.1, 6.0, 4.0)
"""Maximum distance of parameters from their start: a resonance stays near its frequency."""
NARROWEST = 0.2
"""Minimum half width of a resonance in bins: bins tell nothing of a smaller one, between two of which it would become a line."""


def spectrum_information(spectrum: Spectrum, cells: Cells, indices: Sequence[int] | None = None) -> Array:
    """Return the Fisher information of some parameters of `Spectrum.vector`, (p, p); by default of all.

    Where samples are missing, with g the measured share of a bin, it is sum g^2 d d' + v v' / sum g (1 - g) with
    v = sum g (1 - g) d: random gaps spread what a bin loses over all others, where it adds to noise but not to a peak.
    """
    indices = range(spectrum.starts[-1]) if indices is None else indices
    d = spectrum.slopes(cells.frequency, indices) / spectrum.psd(cells.frequency)
    carried = cells.count * cells.share * (1.0 - cells.share)
    v = d @ carried
    return (d * (cells.count * cells.share**2)) @ d.T + np.outer(v, v) / max(carried.sum(), 1e-300)


def fit_spectrum(spectrum: Spectrum, cells: Cells, free: Sequence[int] | None = None) -> Spectrum:
    """Fit a spectrum by maximum likelihood, starting from the given one.

    Parameters
    ----------
    spectrum : Spectrum
        First guess.
    cells : Cells
        Periodogram.
    free : sequence of int, optional
        Indices of the parameters to fit; by default all but the damping of a background.

    Returns
    -------
    Spectrum
        The fit.
    """
    start = spectrum.vector
    index = [i for i in spectrum.free_parameters if free is None or i in free]
    first = TURBULENCE[: spectrum.starts[1] - 1] if spectrum.turbulence else ()
    second = BACKGROUND if spectrum.background else ()
    reach = np.array([NOISE, *first, *second, *RESONANCE * len(spectrum.resonances)])

    def moved(x: Array) -> Spectrum:
        vector = start.copy()
        vector[index] = x
        return spectrum.with_vector(vector)

    def density(x: Array) -> Array:
        return moved(x).psd(cells.frequency)

    def log_slopes(x: Array, S: Array) -> Array:
        return moved(x).slopes(cells.frequency, index) / S

    bounds = np.transpose([start - reach, start + reach])
    for i, p in zip(spectrum.starts[len(spectrum.continuum) :], spectrum.resonances, strict=False):
        least = logit(min(NARROWEST * cells.bin_width * 2.0 * np.pi / p.omega, 0.5))
        bounds[i + 1] = np.maximum(bounds[i + 1], [least, least + 1.0])
    return moved(whittle.whittle_fit(density, log_slopes, start[index], bounds[index], cells.mean, cells.count, TOLERANCE, STEPS))


def first_guess(f: Array, I: Array, dt: float, starts: int = 4) -> Spectrum:  # noqa: E741
    """Estimate noise and turbulence from medians of the periodogram over bands, which ignore lines and narrow resonances.

    Without turbulence where white noise alone is as likely.

    Parameters
    ----------
    f, I : Array
        Frequencies [Hz] and periodogram, (bins,).
    dt : float
        Time step [s].
    starts : int
        Number of corners tried, of four, the lowest first.

    Returns
    -------
    Spectrum
        First guess, without resonances.
    """
    edges = np.unique(np.concatenate([[0], np.geomspace(3, len(f), 60).astype(int)]))
    bands = [slice(a, b) for a, b in pairwise(edges)]
    at = np.array([f[b].mean() for b in bands])
    level = np.array([np.median(I[b]) for b in bands]) / np.log(2.0)
    weight = np.sqrt([b.stop - b.start for b in bands])

    def misfit(vector: Array, shape: Spectrum) -> Array:
        return weight * (np.log(level) - np.log(shape.with_vector(vector).psd(at)))

    noise = float(np.sqrt(np.median(I[len(I) // 2 :]) / np.log(2.0) / (2.0 * dt)))
    alone = Spectrum(noise, dt)
    rms = float(np.sqrt(max(np.sum(I) * f[0] - noise**2, 1e-4 * noise**2)))
    found = []
    for corner in np.geomspace(max(3 * f[0], 0.1), 0.02 / dt, 4)[:starts]:
        shape = Spectrum(noise, dt, Ar2(2.0 * np.pi * corner, 0.7, rms, dt))
        fit = least_squares(
            misfit, shape.vector, args=(shape,), loss="soft_l1", max_nfev=60, bounds=(shape.vector - 12.0, shape.vector + 12.0)
        )
        found.append((fit.cost, shape.with_vector(fit.x)))
    cost, best = min(found, key=lambda pair: pair[0])
    nothing = least_squares(misfit, alone.vector, args=(alone,), loss="soft_l1")
    return best if nothing.cost - cost > 3.0 * np.log(len(f)) else alone.with_vector(nothing.x)


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
ROUNDS = 5
"""Of `complete`: each leaves about the share that is missing of the error of the spectrum."""
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
        For the records drawn; filling needs none.
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


def complete(z: Array, dt: float) -> Array:
    """Return z (n, n_modes) without gaps (NaN) and outlying samples, to see its spectrum.

    There is what is likely given all others: a random draw that has the smoothed spectrum of z.
    """
    out = hold_last(z).copy()
    for mode in np.flatnonzero(np.ptp(out, axis=0) > 0.0):
        seen = np.where(find_outlying(z[:, mode]), np.nan, z[:, mode])
        missing, mean = MissingSamples(np.isnan(seen), dt, np.random.default_rng(0)), np.nanmean(seen)
        if missing.any:
            x = missing.interpolate(seen - mean)
            for _ in range(ROUNDS):
                S = _smooth(periodogram(x, dt))
                x = missing.fill(seen - mean, S) + missing.draw_errors(S)[0]
            out[:, mode] = x + mean
    return out


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
