"""The tapered periodogram of one mode, and fits of a `Spectrum` to it by Whittle's likelihood: errors, first guesses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.fft import next_fast_len, rfft
from scipy.optimize import least_squares
from scipy.signal.windows import tukey
from scipy.special import logit

from wfsobs.signal import whittle
from wfsobs.signal.autoregressive import Ar2, Ar3
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
    h = tukey(n, 2.0 * min(TAPERED / n, MOST_TAPERED))
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
        Measured share of each bin (`missing`); by default all.
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


STEPS = 40
"""Maximum number of steps of a fit."""
TOLERANCE = 1e-2
"""Distance of a fit from its minimum, in standard deviations of its parameters."""
NOISE, TURBULENCE, BACKGROUND, RESONANCE = 3.0, (2.0, 8.0, 4.0, 3.0), (1.5, 0.0, 4.0), (0.1, 6.0, 4.0)
"""Maximum distance of parameters from their start: a resonance stays near its frequency."""
NARROWEST = 0.2
"""Minimum half width of a resonance in bins: bins tell nothing of a smaller one, between two of which it would become a line."""
NO_NEARER = 1.1
"""Minimum third corner, over the first two, for its standard deviation."""


def spectrum_negative_log_likelihood(spectrum: Spectrum, cells: Cells) -> float:
    """Return - log L of a spectrum, without a constant."""
    return whittle.negative_log_likelihood(spectrum.psd(cells.frequency), cells.mean, cells.count)


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
    index = [i for i in (range(len(start)) if free is None else free) if i not in spectrum.fixed_parameters]
    first = () if spectrum.turbulence is None else TURBULENCE[: spectrum.starts[1] - 1]
    second = () if spectrum.background is None else BACKGROUND
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


def standard_deviations(spectrum: Spectrum, cells: Cells, inflation: float) -> Array:
    """Return the standard deviations of the parameters, with that of the damping in place of its logit, (p,)."""
    t = spectrum.turbulence
    if isinstance(t, Ar3):  # at its bound the corner's own number says nothing
        spectrum = replace(spectrum, turbulence=replace(t, corner=max(t.corner, NO_NEARER * t.omega)))
    std = np.zeros(spectrum.starts[-1])
    free = [i for i in range(len(std)) if i not in spectrum.fixed_parameters]
    covariance = np.linalg.inv(spectrum_information(spectrum, cells, free) + 1e-12 * np.eye(len(free)))
    std[free] = np.sqrt(np.maximum(np.diag(covariance) * inflation, 0.0))
    for start, p in zip(spectrum.starts, spectrum.processes, strict=False):
        std[start + 1] *= p.damping * (1.0 - p.damping)
    return std


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
