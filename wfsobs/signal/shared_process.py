"""Two views of one process as a sum of independent processes, fitted to their spectra.

The views are s and m, with real cross spectrum. With a gain g,

    s = c + d,    m = g c + e,

c is what both see, d and e what one sees alone. Then S_c = S_sm / g, S_d = S_s - S_sm / g and S_e = S_m - g S_sm, which at every
frequency are positive for some g. Here it is the regression of m on s, so that what is strong is common; where others came out
negative they are taken as zero. Each is a third-order process (`ar3`) in the white noise beside which it has to be known.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from wfsobs.signal.ar3 import Ar3, Ar3Fits
from wfsobs.signal.wiener import circle_mean
from wfsobs.typing import Array

NOTHING = 1e-6
"""Variance over that of the noise below which a process is left out."""

FLOOR = 1e-12
"""Minimum of a spectrum, over the noise: where others would be negative."""


class SharedProcess(NamedTuple):
    """Processes common to both views, of s alone and of m alone; gain : of m for those in common."""

    gain: float
    common: tuple[Ar3, ...]
    first: tuple[Ar3, ...]
    second: tuple[Ar3, ...]


def fit_shared_process(
    first: Array, second: Array, cross: Array, noise: float, start: Ar3, fits: Ar3Fits | None = None
) -> SharedProcess:
    """Fit the processes of two views.

    Parameters
    ----------
    first, second : Array
        Spectra of s and m per sample, on the frequencies of `wiener`, (n // 2 + 1,).
    cross : Array
        Real part of their cross spectrum, (n // 2 + 1,).
    noise : float
        Variance of the white noise of a measurement.
    start : Ar3
        First guess of shape; each starts with its own rms.
    fits : Ar3Fits, optional
        Those of similar spectra, to start from.

    Returns
    -------
    SharedProcess
        Gain and processes.
    """
    fits = fits or Ar3Fits()

    def fit(name: str, spectrum: Array) -> tuple[Ar3, ...]:
        positive = np.maximum(spectrum, FLOOR * noise)
        variance = circle_mean(positive)
        if variance <= NOTHING * noise:
            return ()
        return (fits.fit(name, positive, noise, replace(start, rms=float(np.sqrt(variance)))),)

    strength, together = circle_mean(first), circle_mean(cross)
    gain = together / strength if strength > 0 else 0.0
    if gain <= 0.0:
        return SharedProcess(0.0, (), fit("first", first), fit("second", second))
    common = cross / gain
    return SharedProcess(gain, fit("common", common), fit("first", first - common), fit("second", second - gain * cross))
