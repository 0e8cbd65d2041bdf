"""The Butterworth bank: a sum of narrow band-passes that isolates vibration (paper, section 2.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfilt

Array = NDArray[np.float64]


def bandpass_bank(frequencies: Sequence[float], bandwidth: float, order: int, dt: float) -> list[Array]:
    """Second-order sections of one digital Butterworth band-pass per centre, edges centre +- bandwidth / 2 [Hz]."""
    return [
        butter(order, [f - bandwidth / 2.0, f + bandwidth / 2.0], "bandpass", fs=1.0 / dt, output="sos")
        for f in frequencies
    ]


def filter_causal(bank: Sequence[Array], x: Array) -> Array:
    """Sum of the band-passes of x (n, n_modes) along the steps, from rest; same shape."""
    out = np.zeros_like(x)
    for sos in bank:
        out += sosfilt(sos, x, axis=0)
    return out


def filter_zero_phase(bank: Sequence[Array], x: Array) -> Array:
    """Sum of the band-passes, each run forward and then backward in time so that it delays nothing; same shape.

    Looks ahead: for references and training targets only.
    """
    out = np.zeros_like(x)
    for sos in bank:
        out += sosfilt(sos, sosfilt(sos, x, axis=0)[::-1], axis=0)[::-1]
    return out
