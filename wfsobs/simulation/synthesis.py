"""Spectral resolution of the synthesis of a record, and of a bound.

A record made by an inverse DFT of its own length is a sum of lines at multiples of 1 / T: it is periodic, so T seconds of it
determine the rest. A record is therefore cut from a period many times as long. The width of lines determines how well
they can be predicted; a record of T resolves none narrower than about 1 / T. Damped peaks and tables therefore get
at least the width `line_width`, in the record as in the bound. Lines are sines of their own.
"""

from __future__ import annotations

from math import ceil, pi

import numpy as np
from scipy.fft import next_fast_len

from wfsobs.scenario import Scenario
from wfsobs.typing import Array

LONGEST = 30.0
"""Longest record whose resolution counts [s]."""

SHARPER = 16
"""Resolution of a record over the minimum line width."""

BINS = 2
"""Bins of the period in the width of a line."""


def line_width(scenario: Scenario) -> float:
    """Return the minimum line width (FWHM) [Hz]: a sixteenth of the resolution of the record."""
    return 1.0 / (SHARPER * min(max(scenario.run.duration, 1.0), LONGEST))


def period_steps(scenario: Scenario, n: int) -> int:
    """Return the steps of the period that a record of `n` steps is cut from, even: at least twice the record."""
    return 2 * next_fast_len(max(ceil(0.5 * BINS / (line_width(scenario) * scenario.dt)), n), real=True)


def damping_for_width(width: float, frequency: float, damping: float) -> float:
    """Return the damping of a resonance, raised where it is narrower than `width` (FWHM); both in [Hz]."""
    return min(max(damping, width / (2.0 * frequency)), 1.0)


def widen_lines(spectrum: Array, width: float) -> Array:
    """Return a spectrum (n // 2 + 1,) of even n with all lines `width` wider [cycles per sample].

    Correlations decay by exp(-pi width |lag|).
    """
    n = 2 * (spectrum.size - 1)
    lag = np.minimum(np.arange(n), n - np.arange(n))
    return np.maximum(np.fft.rfft(np.fft.irfft(spectrum, n) * np.exp(-pi * width * lag)).real, 0.0)
