"""The variance of vibration that is in a window and in none of the lines found there, as far as the window can tell.

Lines that do not stand out are taken for continuum. In octave b of frequency, between the lines that were found, the periodogram
is above the spectrum by E_b = sum (I - S) df, of standard deviation s_b = sqrt(sum S^2) df. What is missed there, M_b >= 0, has
an exponential prior, so that given E_b it is a normal variable of mean E_b - s_b^2 / scale and standard deviation s_b above zero.
The scale is that of a line that would just stand out: SEEN bins of continuum, their geometric mean over the octaves.

Under turbulence little is known of lines, and the prior is all there is; where there is noise alone, the periodogram decides.
"""

from __future__ import annotations

from dataclasses import replace
from math import log2, pi, sqrt

import numpy as np
from scipy.special import erfcx

from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.periodogram import periodogram, periodogram_frequencies
from wfsobs.spectral.search import LOWEST, STRUCTURES
from wfsobs.typing import Array

SEEN = 10.0
"""Bins of continuum in a line of one bin that gains 8 of log-likelihood: I / S = 11."""
FREE = 2.0
"""S over the continuum below which a bin is between lines."""


def missed_variance(lines: Spectrum, z: Array, lowest: float = LOWEST) -> float:
    """Compute the expected variance [um^2] of the vibration in a window z (n,), mean zero [um], that is in none of the lines.

    It is looked for in whole octaves from `lowest` [Hz] up, to where structures vibrate or to Nyquist.
    """
    f, found = periodogram_frequencies(len(z), lines.dt), periodogram(z, lines.dt)
    df, count = f[0], int(log2(max(min(STRUCTURES, f[-1]) / lowest, 1.0)))
    octave = np.floor(np.log2(f / lowest)).astype(int)
    inside = (octave >= 0) & (octave < count)
    if not inside.any():
        return 0.0
    octave, f, found = octave[inside], f[inside], found[inside]
    S, continuum = lines.psd(f), replace(lines, resonances=()).psd(f)
    bins = np.bincount(octave, minlength=count)
    level = np.bincount(octave, continuum, count)[bins > 0] / bins[bins > 0] * df
    free = FREE * continuum > S
    excess = np.bincount(octave[free], (found - S)[free] * df, count)
    spread = np.sqrt(np.bincount(octave[free], (S[free] * df) ** 2, count))
    if not level.min() > 0.0:  # nothing moves
        return 0.0
    scale = SEEN * float(np.exp(np.mean(np.log(level))))
    return float(np.sum(expected_above_zero(excess[spread > 0], spread[spread > 0], scale)))


def missed_rms(lines: Spectrum, z: Array, lowest: float = LOWEST) -> float:
    """Compute the root of `missed_variance` [um] for a window of any mean."""
    return sqrt(missed_variance(lines, z - z.mean(), lowest))


def expected_above_zero(estimate: Array, spread: Array, scale: float) -> Array:
    """Return the expectation of a number above zero of exponential prior of mean `scale`, estimated with a normal error."""
    mean = estimate - spread**2 / scale
    return np.maximum(mean + spread * sqrt(2.0 / pi) / erfcx(-mean / spread / sqrt(2.0)), 0.0)
