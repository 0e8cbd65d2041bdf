"""Whether an observer is as sure as it says: its standard deviation against its errors."""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from wfsobs.typing import Array

BANDS = (0.68, 0.95)
"""Shares of the errors that the bands of a Gaussian error hold."""


def half_width(share: float) -> float:
    """Return the half width of the band that holds this share of a Gaussian error [sd].

    >>> round(half_width(0.95), 4)
    1.96
    """
    return float(ndtri(0.5 + 0.5 * share))


class Calibration(NamedTuple):
    """Stated standard deviations against errors.

    sd        : rms of the standard deviations [um]
    within_68, within_95 : share of the errors within the bands of 68 and 95 %
    crps      : continuous ranked probability score, mean [um]: lower is better, and lowest where what is stated is true
    """

    sd: float
    within_68: float
    within_95: float
    crps: float


def crps(error: Array, sd: Array) -> Array:
    """Return the continuous ranked probability score of Gaussian predictions, closed form.

    Parameters
    ----------
    error, sd : Array
        Errors of the means, and standard deviations, of equal shape [any unit].

    Returns
    -------
    Array
        Scores [same unit]; |error| where the standard deviation is zero.

    Notes
    -----
    Gneiting and Raftery, JASA 102, 359 (2007), eq. 21.
    """
    w = np.abs(error) / np.where(sd > 0.0, sd, 1.0)
    gaussian = sd * (w * (2.0 * ndtr(w) - 1.0) + sqrt(2.0 / pi) * np.exp(-0.5 * w**2) - 1.0 / sqrt(pi))
    return np.where(sd > 0.0, gaussian, np.abs(error))


def calibration(error: Array, sd: Array) -> Calibration | None:
    """Compare errors with stated standard deviations, (n,) [um]; None where nothing is stated."""
    stated = np.isfinite(sd) & np.isfinite(error)
    if not stated.any():
        return None
    error, sd = error[stated], sd[stated]
    low, high = (float(np.mean(np.abs(error) <= half_width(share) * sd)) for share in BANDS)
    return Calibration(float(np.sqrt(np.mean(sd**2))), low, high, float(np.mean(crps(error, sd))))
