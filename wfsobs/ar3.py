"""A third-order process: the AR(2) of the paper with one more corner, beyond which its spectrum falls as f^-6.

Frozen flow falls as f^-17/3 there (Conan, Rousset and Madec, JOSA A 12, 1559, 1995), an AR(2) as f^-4: a filter that
believes the AR(2) takes too much of the noise for turbulence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from wfsobs.arrays import Array

SLOWEST = 3e-3
"""Least corner of a fitted process, over the sampling rate: slower ones cost digits, and a filter nothing."""


@dataclass(frozen=True)
class Ar3:
    """1 / ((1 - p q) (1 - p* q) (1 - r q)) driven by white noise, sampled every `dt`.

    omega, damping : of the pole pair p = exp((-xi + i sqrt(1 - xi^2)) w T) [rad/s], as of an AR(2)
    corner : of the real pole r = exp(-corner T) [rad/s]; rms : standard deviation [any unit]; dt : sampling time [s]
    """

    omega: float
    damping: float
    corner: float
    rms: float
    dt: float

    @property
    def poles(self) -> NDArray[np.complex128]:
        """The three poles."""
        pair = complex(-self.damping, np.sqrt(1.0 - self.damping**2)) * self.omega * self.dt
        return np.exp([pair, pair.conjugate(), -self.corner * self.dt])

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
        """One-sided power spectral density [unit^2/Hz] at `frequency` [Hz]."""
        turn = np.exp(-2j * np.pi * np.asarray(frequency) * self.dt)
        distance = np.abs(np.prod([1.0 - pole * turn for pole in self.poles], axis=0))
        drive = self.rms**2 * np.prod(1.0 - self.reflections**2)
        return 2.0 * self.dt * drive / distance**2


def fitted_ar3(spectrum: Array, noise: float, start: Ar3) -> Ar3:
    """The process whose spectrum, with white noise of variance `noise`, is nearest to a given one, with the same noise.

    spectrum : per sample, on the frequencies of `wiener`, (n // 2 + 1,). Nearest is what makes the innovations of the
    filter built on it whitest and smallest: the mean of log S + S_true / S is least (Whittle, Ark. Mat. 2, 423, 1953). The
    frequencies are thinned out to so many per octave, each standing for those about it.
    """
    n = 2 * (spectrum.size - 1)
    edges = np.unique(np.concatenate([[1], np.geomspace(1, n // 2 + 1, 400).astype(int)]))
    bins, weight = edges[:-1], np.diff(edges)
    frequency = (bins + 0.5 * (weight - 1)) / (n * start.dt)
    measured = np.add.reduceat(spectrum[: edges[-1]], bins) / weight + noise

    def process(x: Array) -> Ar3:
        return Ar3(float(np.exp(x[0])), float(1.0 / (1.0 + np.exp(-x[1]))), float(np.exp(x[2])), float(np.exp(x[3])), start.dt)

    def distance(x: Array) -> float:
        model = process(x).psd(frequency) / (2.0 * start.dt) + noise
        return float(weight @ (np.log(model) + measured / model) / weight.sum())

    logit = np.log(start.damping / max(1.0 - start.damping, 1e-3))
    first = np.array([np.log(start.omega), logit, np.log(start.corner), np.log(start.rms)])
    bounds = [(np.log(SLOWEST / start.dt), np.log(1.0 / start.dt)), (-4.0, 6.0),
              (np.log(SLOWEST / start.dt), np.log(3.0 / start.dt)),
              (np.log(1e-6), np.log(1e3))]
    found = minimize(distance, first, method="L-BFGS-B", bounds=bounds)
    return process(found.x)
