"""Root mean square and power spectral density of a sampled signal."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import get_window, welch

from wfsobs.typing import Array


def rms(x: Array) -> float:
    """Return the root of the mean square; the mean is included."""
    return float(np.sqrt(np.mean(np.square(x)))) if x.size else 0.0


def psd(x: ArrayLike, dt: float, *, resolution: float = 0.5) -> tuple[Array, Array]:
    """Estimate the power spectral density by Welch's method.

    Averages half-overlapping Hann windows of 1 / resolution seconds, or of the whole record if that is shorter.

    Parameters
    ----------
    x : array_like
        Signals, (n,) or (n, n_columns), without NaN.
    dt : float
        Time step [s].
    resolution : float
        Resolution [Hz].

    Returns
    -------
    frequency : Array
        Frequencies [Hz].
    density : Array
        One-sided density [unit^2/Hz], a column per signal.
    """
    x = np.asarray(x, dtype=float)
    window = min(round(1.0 / (resolution * dt)), len(x))
    frequency, density = welch(x, fs=1.0 / dt, nperseg=window, axis=0, detrend="constant")
    return frequency, density


def expected_psd(spectrum: Array, dt: float, n_steps: int, resolution: float = 0.5) -> tuple[Array, Array]:
    """Return the expectation of `psd` for a stationary signal of this spectrum.

    The autocovariance times that of the window, transformed: the spectrum as smooth as the window makes it. Taking off the mean
    of each window, which changes the lowest two frequencies, is left out.

    Parameters
    ----------
    spectrum : Array
        Two-sided spectrum per sample, on the frequencies of `wiener`, (n // 2 + 1,), n at least twice a window.
    dt : float
        Time step [s].
    n_steps : int
        Steps of the record.
    resolution : float
        Resolution [Hz].

    Returns
    -------
    frequency : Array
        Frequencies [Hz].
    density : Array
        One-sided density [unit^2/Hz].
    """
    length, n = min(round(1.0 / (resolution * dt)), n_steps), 2 * (spectrum.size - 1)
    window = get_window("hann", length)
    power = np.abs(np.fft.rfft(window, 2 * length)) ** 2
    weight = np.fft.irfft(power)[:length] / np.sum(window**2)
    covariance = np.zeros(length)
    covariance[: min(length, n // 2)] = np.fft.irfft(spectrum, n)[: min(length, n // 2)]
    weighted = weight * covariance
    folded = weighted.copy()
    folded[1:] += weighted[:0:-1]  # lags -1 ... 1 - length
    density = 2.0 * dt * np.fft.rfft(folded).real
    density[0] *= 0.5
    if length % 2 == 0:
        density[-1] *= 0.5
    return np.fft.rfftfreq(length, dt), np.maximum(density, 0.0)
