"""Root mean square and power spectral density of a sampled signal."""

from __future__ import annotations

import numpy as np
from scipy.signal import welch

from wfsobs.typing import Array


def rms(x: Array) -> float:
    """Root of the mean square; the mean stays in."""
    return float(np.sqrt(np.mean(np.square(x)))) if x.size else 0.0


def welch_psd(x: Array, dt: float, resolution: float = 0.5) -> tuple[Array, Array]:
    """Frequencies [Hz] and one-sided power spectral density [unit^2/Hz] of x (n, n_columns): Welch's average of
    half-overlapping Hann windows of 1 / resolution seconds, or of the whole record if that is shorter."""
    window = min(round(1.0 / (resolution * dt)), x.shape[0])
    frequency, density = welch(x, fs=1.0 / dt, nperseg=window, axis=0, detrend="constant")
    return frequency, density
