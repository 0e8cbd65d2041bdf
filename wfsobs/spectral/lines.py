"""Lines: undamped ones, found and subtracted in the time domain, and what is known of one that is narrow, damped or not.

A line x(t) = Re(c(t) exp(2 pi i f t)) of half width g [Hz] has a complex amplitude with E c(t) c*(s) = 2 P exp(-2 pi g |t - s|).
In a record of T <= 1 / g that is one realised amplitude, which drifts a little: it says little of P, its phase moves the
frequency by sqrt(g / (2 pi T)), and the bins of a periodogram are not independent, as Whittle's likelihood has them. Along the
eigenvectors of the covariance of c, line and noise are independent normal variables: frequency, width and P are known by the
likelihood of those on a grid, and so is the power that the line has had.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import pi, sqrt

import numpy as np
from scipy.fft import fft, ifft
from scipy.optimize import minimize_scalar

from wfsobs.spectral.periodogram import MOST_TAPERED, taper
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
