"""Undamped lines: x(t) = Re(c exp(2 pi i f t)), found and subtracted in the time domain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from wfsobs.spectral.periodogram import taper
from wfsobs.typing import Array


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

    def standard_deviations(self, n: int, dt: float, floor: float) -> tuple[float, float]:
        """Return the standard deviations of frequency [Hz] and rms [um] in white noise of density `floor` [um^2/Hz].

        The Cramer-Rao bounds (Rife and Boorstyn, IEEE Trans. Inf. Theory 20, 591, 1974), with rho = rms^2 T / floor,
        sigma_f = sqrt(6 / rho) / (2 pi T) and sigma_rms = rms / sqrt(2 rho), times the loss by the taper.
        """
        T, h, t = n * dt, taper(n), (np.arange(n) - (n - 1) / 2.0) / n
        rho = self.rms**2 * T / floor
        in_rms = np.sqrt(np.mean(h**2)) / np.mean(h)
        in_frequency = np.sqrt(np.mean(t**2 * h**2) / 12.0) / np.mean(t**2 * h)
        return np.sqrt(6.0 / rho) / (2.0 * np.pi * T) * float(in_frequency), self.rms / np.sqrt(2.0 * rho) * float(in_rms)


def nearest_line(x: Array, dt: float, near: float, within: float) -> Sinusoid:
    """Find the line of greatest power in x (n,), at `near` [Hz] to +- `within`."""
    n = len(x)
    tapered, total = taper(n) * x, float(taper(n).sum())

    def transform(f: float) -> complex:
        return complex(np.vdot(_phasor(f, n, dt), tapered))

    low, high = max(near - within, 0.1 / (n * dt)), min(near + within, 0.5 / dt)
    best = minimize_scalar(lambda f: -abs(transform(f)), bounds=(low, high), method="bounded", options={"xatol": 1e-4 / (n * dt)})
    return Sinusoid(float(best.x), 2.0 * transform(float(best.x)) / total)


def _phasor(f: float, n: int, dt: float) -> Array:
    """Return exp(2 pi i f t), (n,), as an outer product of two shorter ones, which is fast."""
    block = 256
    fast = np.exp(2j * np.pi * f * dt * np.arange(block))
    slow = np.exp(2j * np.pi * f * dt * block * np.arange(-(-n // block)))
    return (slow[:, None] * fast).ravel()[:n]
