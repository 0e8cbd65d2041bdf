"""Whiteness of the residual: two tests of one mode, both of level LEVEL."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.stats import chi2, kstwobign

from wfsobs.observers.kalman.single import steady_filter
from wfsobs.signal.statespace import disturbance_model
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.periodogram import inflation
from wfsobs.typing import Array

LEVEL = 0.01
LAGS = 100
"""Lags of the autocorrelation, beside one for every parameter of the model."""
MIN_NOISE = 1e-6
"""Minimum noise of the filter, over the rms of z."""


@dataclass(frozen=True)
class Whiteness:
    """Tests of the residual of one mode; p-values are probabilities that white noise would look less white.

    Attributes
    ----------
    periodogram : float
        p-value of the largest distance between the cumulative I / S and a straight line (Bartlett, with Kolmogorov's law).
    innovations : float
        p-value of the autocorrelation of the Kalman filter's innovations (Ljung and Box, Biometrika 65, 297, 1978).
    left : int
        Candidates that the search still finds and no peak explains.
    remarks : tuple of str
        Differences, one clause each, where it is not white.
    """

    periodogram: float
    innovations: float
    left: int
    remarks: tuple[str, ...] = ()

    @property
    def white(self) -> bool:
        """Whether both tests pass at LEVEL and no candidate is left."""
        return min(self.periodogram, self.innovations) >= LEVEL and not self.left


def cumulated_test(ratio: Array, n: int) -> float:
    """Return the p-value of I / S, (bins,), of a record of n samples."""
    count = len(ratio)
    distance = np.cumsum(ratio) / ratio.sum() - np.arange(1, count + 1) / count
    return float(kstwobign.sf(np.max(np.abs(distance)) * np.sqrt(count / inflation(n))))


def innovations(z: Array, spectrum: Spectrum) -> Array:
    """Return the innovations of the steady-state Kalman filter of the spectrum on z (n,), without the start.

    One second or a tenth of the record is left out; the rest is white where the spectrum is that of z.
    """
    settle = min(len(z) // 10, round(1.0 / spectrum.dt))
    if not spectrum.processes:
        return z[settle:]
    model = disturbance_model(list(spectrum.processes[:1]), list(spectrum.processes[1:]))
    kalman, _ = steady_filter(model, max(spectrum.noise, MIN_NOISE * float(np.std(z))), (model.C @ model.A)[None])
    predicted = kalman.run(z[:, None, None])[:, 0, 0]  # C A x_hat[k], what z[k+1] should be
    return (z[1:] - predicted[:-1])[settle:]


def autocorrelation_test(e: Array, numbers: int) -> float:
    """Return the p-value of Ljung and Box's statistic of e (n,); numbers : parameters of the model that made it."""
    n, lags = len(e), LAGS + numbers
    e = e - e.mean()
    power = np.abs(rfft(e, next_fast_len(2 * n, real=True))) ** 2
    r = irfft(power)[: lags + 1]
    rho = r[1:] / r[0]
    statistic = n * (n + 2) * np.sum(rho**2 / (n - np.arange(1, lags + 1)))
    return float(chi2.sf(statistic, LAGS))
