"""Third-order process: the AR(2) of the paper with one more corner, beyond which its spectrum falls as f^-6.

Frozen flow falls as f^-17/3 there (Conan, Rousset and Madec, JOSA A 12, 1559, 1995), an AR(2) as f^-4: a filter
with the AR(2) model takes too much of the noise for turbulence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from wfsobs.signal.whittle import negative_log_likelihood, whittle_fit
from wfsobs.typing import Array

SLOWEST = 3e-3
"""Minimum corner of a fitted process, over the sampling rate: slower ones lose digits and gain nothing in a filter."""
TOLERANCE = 1e-3
"""Distance of a fit from its minimum, in standard deviations of its parameters."""
STEPS = 100
"""Maximum number of steps of a fit."""


@dataclass(frozen=True)
class Ar3:
    """Process 1 / ((1 - p q) (1 - p* q) (1 - r q)) driven by white noise.

    Attributes
    ----------
    omega, damping : float
        Of the pole pair p = exp((-xi + i sqrt(1 - xi^2)) w T), as of an AR(2) [rad/s, -].
    corner : float
        Corner of the real pole r = exp(-corner T) [rad/s].
    rms : float
        Standard deviation [any unit].
    dt : float
        Time step [s].
    """

    omega: float
    damping: float
    corner: float
    rms: float
    dt: float

    @property
    def poles(self) -> NDArray[np.complex128]:
        """The three poles."""
        return np.exp(-self.decays)

    @property
    def decays(self) -> NDArray[np.complex128]:
        """Exponents a_i of the three poles exp(-a_i)."""
        pair = complex(self.damping, np.sqrt(1.0 - self.damping**2)) * self.omega * self.dt
        return np.array([pair, pair.conjugate(), self.corner * self.dt])

    @property
    def unit_drive_variance(self) -> float:
        """Variance of the drive for which the process has the variance 1.

        The product of 1 - p_i p_j over i <= j, divided by 1 + e_2 - e_1 e_3 - e_3^2 with e_i the elementary symmetric polynomials
        of the poles: one over the sum of squares of the impulse response. Grouped so that nothing cancels when it is slow.
        """
        a, total = self.decays, self.decays.sum()
        pairs = np.prod(-np.expm1(-(a[:, None] + a))[np.triu_indices(3)])
        return float((pairs / (-np.expm1(-2.0 * total) - (np.exp(a - total) * np.expm1(-2.0 * a)).sum())).real)

    @property
    def reflections(self) -> Array:
        """Partial autocorrelations k_1, k_2, k_3, all between -1 and 1, by the step-down recursion."""
        a = -np.poly(self.poles).real[1:]  # phi[k] = a_1 phi[k-1] + ...
        out = np.zeros(a.size)
        while a.size:
            k = out[a.size - 1] = a[-1]
            a = (a[:-1] + k * a[-2::-1]) / (1.0 - k**2)
        return out

    def psd(self, frequency: Array) -> Array:
        """Return the one-sided power spectral density [unit^2/Hz] at `frequency` [Hz]."""
        half = np.pi * np.asarray(frequency) * self.dt
        out = np.full(half.shape, 2.0 * self.dt * self.rms**2 * self.unit_drive_variance)
        for a in self.decays:  # |1 - p q|^2 without cancellation, and without complex exponentials, which take five times as long
            within = -np.expm1(-a.real)
            out /= within**2 + 4.0 * (1.0 - within) * np.sin(half + 0.5 * a.imag) ** 2
        return out

    def log_slopes(self, frequency: Array) -> Array:
        """Return the derivatives of log `psd` by log omega, logit damping, log corner and log rms, (4, n)."""
        a, xi = self.decays, self.damping
        turn = 2j * np.pi * np.asarray(frequency) * self.dt
        pairs = 1.0 / np.expm1(a[:, None] + a)
        drive = pairs.sum(axis=1) + np.diag(pairs) + 1.0
        drive -= (np.cosh(a.sum()) + np.cosh(a)) / (np.sinh(a.sum()) + np.sinh(a).sum())
        by_decay = drive[:, None] - 2.0 / np.expm1(a[:, None] + turn)
        damped = self.omega * self.dt * complex(xi * (1.0 - xi), -(xi**2) * np.sqrt((1.0 - xi) / (1.0 + xi)))
        moves = np.array([[a[0], a[1], 0.0], [damped, damped.conjugate(), 0.0], [0.0, 0.0, a[2]]])
        return np.vstack([(moves @ by_decay).real, np.full(by_decay.shape[1], 2.0)])


def fit_ar3(spectrum: Array, noise: float, start: Ar3) -> Ar3:
    """Fit a third-order process in white noise to a spectrum.

    The fit makes the innovations of the filter built on it as white and as small as possible: it minimises the mean of
    log S + S_true / S (`whittle`). Frequencies are thinned to a fixed number per octave, each with the weight of those it
    replaces. There can be two minima, with the pair below or above the real pole: the fit starts from `start` and from the
    same with the two exchanged, and keeps the lower minimum.

    Parameters
    ----------
    spectrum : Array
        Two-sided spectrum per sample, on the frequencies of `wiener`, (n // 2 + 1,).
    noise : float
        Variance of the white noise, the same in spectrum and fit.
    start : Ar3
        First guess.

    Returns
    -------
    Ar3
        The process whose spectrum is nearest.
    """
    return Ar3Fits().fit("", spectrum, noise, start)


class Ar3Fits:
    """Fits as `fit_ar3`, of spectra that change little by little: each starts where the two before it ended.

    That takes a quarter of the steps. A minimum that comes up while both are at another one is not found.
    """

    def __init__(self) -> None:
        self._minima: dict[str, list[Ar3]] = {}

    def fit(self, name: str, spectrum: Array, noise: float, start: Ar3) -> Ar3:
        """Fit the spectrum of that name, which starts at `start` only where there is none before it."""
        exchanged = replace(start, omega=start.corner, corner=start.omega)
        found = self._minima[name] = _minima(spectrum, noise, self._minima.get(name, [start, exchanged]))
        return found[0]


def _minima(spectrum: Array, noise: float, starts: Sequence[Ar3]) -> list[Ar3]:
    """Return where the fits from these starts end, the lowest minimum first."""
    n, dt = 2 * (spectrum.size - 1), starts[0].dt
    edges = np.unique(np.concatenate([[1], np.geomspace(1, n // 2 + 1, 400).astype(int)]))
    bins, count = edges[:-1], np.diff(edges)
    frequency = (bins + 0.5 * (count - 1)) / (n * dt)
    mean = np.add.reduceat(spectrum[: edges[-1]], bins) / count + noise

    def process(x: Array) -> Ar3:
        return Ar3(float(np.exp(x[0])), float(expit(x[1])), float(np.exp(x[2])), float(np.exp(x[3])), dt)

    def density(x: Array) -> Array:
        return process(x).psd(frequency) / (2.0 * dt) + noise

    def log_slopes(x: Array, S: Array) -> Array:
        return process(x).log_slopes(frequency) * (1.0 - noise / S)

    slowest = np.log(SLOWEST / dt)
    bounds = np.array([(slowest, np.log(1.0 / dt)), (-4.0, 6.0), (slowest, np.log(3.0 / dt)), (np.log(1e-6), np.log(1e3))])
    found = []
    for start in starts:
        first = np.array([np.log(start.omega), logit(min(start.damping, 0.999)), np.log(start.corner), np.log(start.rms)])
        found.append(whittle_fit(density, log_slopes, first, bounds, mean, count, TOLERANCE, STEPS))
    return [process(x) for x in sorted(found, key=lambda x: negative_log_likelihood(density(x), mean, count))]
