"""Lines in a periodogram: the search for them, undamped ones subtracted in the time domain, and what is known of a narrow one.

A line x(t) = Re(c(t) exp(2 pi i f t)) of half width g [Hz] has a complex amplitude with E c(t) c*(s) = 2 P exp(-2 pi g |t - s|).
In a record of T <= 1 / g that is one realised amplitude, which drifts a little: it says little of P, its phase moves the
frequency by sqrt(g / (2 pi T)), and the bins of a periodogram are not independent, as Whittle's likelihood has them. Along the
eigenvectors of the covariance of c, line and noise are independent normal variables: frequency, width and P are known by the
likelihood of those on a grid, and so is the power that the line has had.

The whitened periodogram I / S of the right S is exponential of mean 1. An undamped line raises one of its bins, a resonance
several; means over 1 ... 243 bins are Gamma distributed. Every frequency gets a share of the level as df / f: of two equally
strong peaks the lower is the likelier to be one of a structure; most of it below STRUCTURES.

Lines that do not stand out are taken for continuum; the window tells a little of their variance. In octave b of frequency,
between the lines that were found, the periodogram is above the spectrum by E_b = sum (I - S) df, of standard deviation s_b =
sqrt(sum S^2) df. What is missed there, M_b >= 0, has an exponential prior, so that given E_b it is a normal variable of mean E_b
- s_b^2 / scale and standard deviation s_b above zero. The scale is that of a line that would just stand out: SEEN bins of
continuum, their geometric mean over the octaves.

Under turbulence little is known of lines, and the prior is all there is; where there is noise alone, the periodogram decides.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from math import log2, pi, sqrt

import numpy as np
from scipy.fft import fft, ifft
from scipy.optimize import minimize_scalar
from scipy.special import erfcx, gammainccinv

from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.whittle import MOST_TAPERED, inflation, periodogram, periodogram_frequencies, taper
from wfsobs.typing import Array

BANDS = (64, 32, 16)
"""Bins about a line that are looked at, and samples of its amplitude: the first that is not above a quarter of its periods in it,
as what is beside the line must vary little over them."""
HALF_WIDTHS = np.concatenate([[1e-4], np.geomspace(0.05, 8.0, 18)])
"""Half widths of a line that are compared, in bins: the first is that of an undamped one. All are as likely beforehand."""
POWERS = np.geomspace(0.1, 20.0, 16)
"""Expected power of a line that are compared, over the one measured."""
OFFSETS = 3.0 * np.sinh(np.linspace(-7.0, 7.0, 41)) / np.sinh(7.0)
"""Frequencies that are compared at first, from a first guess, in bins."""
TAPERED = 5.0
"""Periods of a line under the cosine at either end of a record."""
PASSES, WITHIN = 2, 5.0
"""Further grids of frequencies, over so many standard deviations of the one before on either side."""


@dataclass(frozen=True)
class Sinusoid:
    """An undamped line.

    Attributes
    ----------
    frequency : float
        Frequency f [Hz].
    amplitude : complex
        Amplitude c [um].
    """

    frequency: float
    amplitude: complex

    @property
    def rms(self) -> float:
        """Root mean square [um]."""
        return abs(self.amplitude) / np.sqrt(2.0)

    def signal(self, n: int, dt: float) -> Array:
        """Return `n` steps of the signal, (n,) [um]."""
        return (self.amplitude * _phasor(self.frequency, n, dt)).real


def nearest_line(x: Array, dt: float, near: float, within: float) -> Sinusoid:
    """Find the line of greatest power in x (n,), at `near` [Hz] to +- `within`."""
    n = len(x)
    tapered, total = taper(n) * x, float(taper(n).sum())

    def transform(f: float) -> complex:
        return complex(np.vdot(_phasor(f, n, dt), tapered))

    low, high = max(near - within, 0.1 / (n * dt)), min(near + within, 0.5 / dt)
    best = minimize_scalar(lambda f: -abs(transform(f)), bounds=(low, high), method="bounded", options={"xatol": 1e-4 / (n * dt)})
    return Sinusoid(float(best.x), 2.0 * transform(float(best.x)) / total)


def line_in_record(x: Array, dt: float, near: float, floor: Callable[[Array], Array]) -> tuple[float, float, float, float]:
    """Estimate the frequency of a narrow line and its rms within the record: means and standard deviations.

    Parameters
    ----------
    x : Array
        The line and all that is beside it, (n,) [um].
    dt : float
        Time step [s].
    near : float
        First guess of the frequency [Hz].
    floor : callable
        Density [um^2/Hz] of what is beside it at frequencies [Hz].

    Returns
    -------
    frequency, its standard deviation : float
        [Hz].
    rms, its standard deviation : float
        Of the line within the record, not of the process that it is drawn from [um].
    """
    n, T = len(x), len(x) * dt
    band = next((it for it in BANDS if it <= 0.25 * near * T), BANDS[-1])
    bins = np.fft.fftfreq(band, 1.0 / band)
    f = near + bins / T
    S = floor(np.clip(np.abs(f), 1.0 / T, 0.5 / dt))
    # white noise of the density S has the variance 1 in every sample of y, and a line the energy T rms^2 / S
    h = short_taper(n, dt, near)
    y = sqrt(2.0 * dt / n) * fft(h * x * _phasor(near, n, dt).conj())[bins.astype(int)] / np.sqrt(S)
    t = (np.arange(band) + 0.5) / band
    y = sqrt(band) * ifft(y * np.exp(1j * pi * bins / band))
    edges = np.arange(band + 1) * n // band
    y /= np.add.reduceat(h, edges[:-1]) / np.diff(edges)
    shapes, variances = _own_coordinates(band)
    energy = max(float(np.sum(np.abs(y) ** 2)) - band, 8.0)
    variance = energy * POWERS[:, None] * variances[:, None, :]  # of every coordinate by the line alone
    passed, constant = variance / (variance + 1.0), -np.sum(np.log1p(variance), axis=-1)
    inside = 2.0 / pi * np.arctan(0.5 * band / HALF_WIDTHS)  # part of the power of a line
    offsets = OFFSETS
    for again in range(PASSES + 1):
        turned = y[:, None] * np.exp(-2j * pi * t[:, None] * offsets)
        seen = (shapes @ turned.real) ** 2 + (shapes @ turned.imag) ** 2  # (widths, coordinates, offsets)
        log_weight = constant[:, :, None] + passed @ seen  # (widths, powers, offsets)
        weight = np.exp(log_weight - log_weight.max()) * np.gradient(offsets)
        weight /= weight.sum()
        by_offset = weight.sum(axis=(0, 1))
        centre = float(by_offset @ offsets)
        spread = sqrt(float(by_offset @ (offsets - centre) ** 2))
        if again < PASSES:
            offsets = centre + max(spread, 1e-4) * np.linspace(-WITHIN, WITHIN, 21)
    kept = passed**2 @ seen
    mean = kept + passed.sum(axis=-1)[:, :, None]
    around = np.sum(passed**2, axis=-1)[:, :, None] + 2.0 * (passed**3 @ seen)
    mean, around = mean / inside[:, None, None], around / inside[:, None, None] ** 2
    expected = float(np.sum(weight * mean))
    std = sqrt(float(np.sum(weight * (around + (mean - expected) ** 2))))
    rms = sqrt(expected * float(S[0]) / T)
    frequency = abs(near + centre / T)
    frequency = min(frequency, 1.0 / dt - frequency)  # below half the rate, not its image above
    return frequency, spread / T, rms, 0.5 * rms * std / expected


def short_taper(n: int, dt: float, frequency: float) -> Array:
    """Return a taper (n,) that suffices at one frequency [Hz]: of a line that is not stationary it loses less than `taper`."""
    h, count = np.ones(n), max(int(min(TAPERED / (frequency * dt), MOST_TAPERED * n)), 1)
    h[:count] = np.sin(0.5 * pi * (np.arange(count) + 0.5) / count) ** 2
    h[n - count :] = h[:count][::-1]
    return h


@lru_cache(maxsize=len(BANDS))
def _own_coordinates(band: int) -> tuple[Array, Array]:
    """Return the eigenvectors (widths, coordinates, band) and eigenvalues (widths, coordinates) of the covariances of a line.

    Of the amplitude of a line of every half width, mean square 1 / band.
    """
    k = np.arange(band)
    values, vectors = np.linalg.eigh(np.exp(-2.0 * pi / band * HALF_WIDTHS[:, None, None] * np.abs(k[:, None] - k)) / band)
    return np.swapaxes(vectors, 1, 2), np.maximum(values, 0.0)


def _phasor(f: float, n: int, dt: float) -> Array:
    """Return exp(2 pi i f t), (n,), as an outer product of two shorter ones, which is fast."""
    block = 256
    fast = np.exp(2j * np.pi * f * dt * np.arange(block))
    slow = np.exp(2j * np.pi * f * dt * block * np.arange(-(-n // block)))
    return (slow[:, None] * fast).ravel()[:n]


WIDTHS = (3, 9, 27, 81, 243)
"""Bins of a mean."""
PAD = 4
"""Frequencies per bin in the search for lines."""
LOWEST = 5.0
"""Default minimum frequency of a peak [Hz]: below, the remainder is turbulence that no AR(2) matches."""
OVERLAP = 4
"""Means per width."""
OF_LINES = 0.8
"""Share of the level for lines: one bin has to exceed all others, means of many exceed them by little."""
SPOILS = 2.0
"""Mean I / S from which bins would spoil the fit of a spectrum without a peak there."""
STRUCTURES, BELOW = 100.0, 0.9
"""Maximum frequency at which structures of telescopes are known to vibrate [Hz], and the share of the level spent below it."""


@dataclass(frozen=True)
class Candidate:
    """A possible peak at `frequency` [Hz] over `width` bins.

    strength : gain of log-likelihood if all of it were explained, over the square root of the width: the strongest of all widths
        is then about as wide as the peak, and contains no other one
    """

    frequency: float
    width: int
    strength: float


@dataclass(frozen=True)
class SearchResult:
    """Result of a peak search.

    Attributes
    ----------
    best : Candidate or None
        The strongest candidate.
    above_limit : Array
        Bins above their limit at some width, bool (bins,).
    strong : Array
        Those so far above it that they would spoil a fit.
    """

    best: Candidate | None
    above_limit: Array
    strong: Array


def search_peaks(fine: Array, n: int, dt: float, modes: int, level: float, lowest: float = LOWEST) -> SearchResult:
    """Search a whitened periodogram for peaks.

    Parameters
    ----------
    fine : Array
        Sum of the whitened periodograms of all modes, at PAD frequencies per bin.
    n : int
        Number of samples of the record.
    dt : float
        Time step [s].
    modes : int
        Number of modes in the sum.
    level : float
        Probability of a false peak where there is none, OF_LINES of it for lines.
    lowest : float
        Minimum frequency [Hz].

    Returns
    -------
    Found
        Best candidate and flagged bins.
    """
    T = n * dt
    of_lines, share = OF_LINES * level, (1.0 - OF_LINES) * level / len(WIDTHS)
    flagged, strong = np.zeros((2, (n + 1) // 2 - 1), bool)
    best: Candidate | None = None
    f = np.arange(1, len(fine) + 1) / (PAD * T)
    high = (fine > _limits(len(fine), PAD * T, 1, modes, of_lines, n, lowest)) & (f >= lowest)
    if high.any():
        at = int(np.argmax(np.where(high, fine, 0.0)))
        best = Candidate(float(f[at]), 1, float(_gain(fine[at], modes)))
        bins = np.clip(np.round((np.flatnonzero(high) + 1) / PAD).astype(int) - 1, 0, len(flagged) - 1)
        flagged[bins] = strong[bins] = True
    sums = np.concatenate([[0.0], np.cumsum(fine[PAD - 1 :: PAD][: len(flagged)])])
    for width in WIDTHS:
        start = np.arange(0, len(flagged) - width, max(width // OVERLAP, 1))
        total = sums[start + width] - sums[start]
        centre = (start + (width + 1) / 2.0) / T
        limit = np.interp(centre, np.arange(1, len(flagged) + 1) / T, _limits(len(flagged), T, width, modes, share, n, lowest))
        high = (total > limit) & (centre - width / 2.0 / T >= lowest)
        for i in np.flatnonzero(high):
            flagged[start[i] : start[i] + width] = True
            strong[start[i] : start[i] + width] |= total[i] > SPOILS * width * modes
        if high.any():
            strengths = np.where(high, _gain(total, width * modes), 0.0) / np.sqrt(width)
            i = int(np.argmax(strengths))
            if best is None or strengths[i] > best.strength:
                best = Candidate(float(centre[i]), width, float(strengths[i]))
    return SearchResult(best, flagged, strong)


def _gain(total: Array, count: int):
    """Return the gain of log-likelihood of `count` bins of the sum `total` when the spectrum is raised to their mean."""
    mean = np.maximum(total / count, 1.0)
    return count * (mean - 1.0 - np.log(mean))


@lru_cache(maxsize=32)
def _limits(count: int, T: float, width: int, modes: int, share: float, n: int, lowest: float) -> Array:
    """Return the limit of a sum over `width` bins and `modes` modes, at j / T, j = 1 ... count.

    A line is searched between the bins as well: the maximum over a continuous frequency passes u as often as
    sqrt(pi u / 3) exp(-u) per bin and once more (Turkman and Walker, Adv. Appl. Prob. 16, 819, 1984; for sums of several, Davies,
    Biometrika 74, 33, 1987).
    """
    j = np.geomspace(1, count, 200)
    probability = share * (max(width // OVERLAP, 1) / T) * _prior(j / T, lowest, count / T)
    shape = width * modes / (1.0 if width == 1 else inflation(n))
    if width == 1:  # PAD frequencies to a bin, and the factor above: by iteration
        probability = probability * PAD
        limit = gammainccinv(shape, probability)
        for _ in range(4):
            limit = gammainccinv(shape, probability / (1.0 + np.sqrt(np.pi * limit / 3.0)))
    else:
        limit = gammainccinv(shape, probability) * width * modes / shape
    return np.interp(np.log(np.arange(1, count + 1)), np.log(j), limit)


def _prior(f: Array, lowest: float, highest: float) -> Array:
    """Return the density [1/Hz] of the level from `lowest` to `highest`: as 1 / f, BELOW of it up to STRUCTURES."""
    f = np.maximum(f, lowest)
    if not lowest < STRUCTURES < highest:
        return 1.0 / (f * np.log(highest / lowest))
    return np.where(f < STRUCTURES, BELOW / np.log(STRUCTURES / lowest), (1.0 - BELOW) / np.log(highest / STRUCTURES)) / f


SEEN = 10.0
"""Bins of continuum in a line of one bin that gains 8 of log-likelihood: I / S = 11."""
FREE = 2.0
"""S over the continuum below which a bin is between lines."""


def missed_variance(lines: Spectrum, z: Array, lowest: float = LOWEST) -> float:
    """Compute the expected variance [um^2] of the vibration in a window z (n,), mean zero [um], that is in none of the lines.

    It is looked for in whole octaves from `lowest` [Hz] up, to where structures vibrate or to Nyquist.
    """
    f, found = periodogram_frequencies(len(z), lines.dt), periodogram(z, lines.dt)
    df, count = f[0], int(log2(max(min(STRUCTURES, f[-1]) / lowest, 1.0)))
    octave = np.floor(np.log2(f / lowest)).astype(int)
    inside = (octave >= 0) & (octave < count)
    if not inside.any():
        return 0.0
    octave, f, found = octave[inside], f[inside], found[inside]
    S, continuum = lines.psd(f), replace(lines, resonances=()).psd(f)
    bins = np.bincount(octave, minlength=count)
    level = np.bincount(octave, continuum, count)[bins > 0] / bins[bins > 0] * df
    free = FREE * continuum > S
    excess = np.bincount(octave[free], (found - S)[free] * df, count)
    spread = np.sqrt(np.bincount(octave[free], (S[free] * df) ** 2, count))
    if not level.min() > 0.0:  # nothing moves
        return 0.0
    scale = SEEN * float(np.exp(np.mean(np.log(level))))
    return float(np.sum(expected_above_zero(excess[spread > 0], spread[spread > 0], scale)))


def missed_rms(lines: Spectrum, z: Array, lowest: float = LOWEST) -> float:
    """Compute the root of `missed_variance` [um] for a window of any mean."""
    return sqrt(missed_variance(lines, z - z.mean(), lowest))


def expected_above_zero(estimate: Array, spread: Array, scale: float) -> Array:
    """Return the expectation of a number above zero of exponential prior of mean `scale`, estimated with a normal error."""
    mean = estimate - spread**2 / scale
    return np.maximum(mean + spread * sqrt(2.0 / pi) / erfcx(-mean / spread / sqrt(2.0)), 0.0)
