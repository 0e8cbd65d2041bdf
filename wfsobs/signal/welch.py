"""Root mean square and power spectral density of a sampled signal."""

from __future__ import annotations

import numpy as np
from scipy.signal import welch

from wfsobs.typing import Array


def rms(x: Array) -> float:
    """Return the root of the mean square; the mean is included."""
    return float(np.sqrt(np.mean(np.square(x)))) if x.size else 0.0


def welch_psd(x: Array, dt: float, resolution: float = 0.5) -> tuple[Array, Array]:
    """Estimate the power spectral density by Welch's method.

    Averages half-overlapping Hann windows of 1 / resolution seconds, or of the whole record if that is shorter.

    Parameters
    ----------
    x : Array
        Signals, (n, n_columns).
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
    window = min(round(1.0 / (resolution * dt)), x.shape[0])
    frequency, density = welch(x, fs=1.0 / dt, nperseg=window, axis=0, detrend="constant")
    return frequency, density
