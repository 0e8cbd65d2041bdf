"""How finely spectra are sampled where a record is made of them, or a bound.

A record made by an inverse DFT of its own length is a sum of lines at multiples of 1 / T: it repeats itself, and whoever
remembers T seconds of it knows the rest. So it is cut from a period many times as long. How wide lines are decides how well
they can be told ahead; a record of T shows none narrower than about 1 / T. All that is damped or a table is therefore taken
to be `line_width` wide at least, in the record as in the bound. Pure lines are sines of their own.
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
"""Lines over the width that a record can show."""

BINS = 2
"""Bins of the period in the width of a line."""


def line_width(scenario: Scenario) -> float:
    """The least width of a line at half maximum [Hz]: a sixteenth of what a record could show."""
    return 1.0 / (SHARPER * min(max(scenario.run.duration, 1.0), LONGEST))


def period_steps(scenario: Scenario, n: int) -> int:
    """Steps of the period that a record of `n` steps is cut from, an even number: twice the record at least."""
    return 2 * next_fast_len(max(ceil(0.5 * BINS / (line_width(scenario) * scenario.dt)), n), real=True)


def damping_at_least(width: float, frequency: float, damping: float) -> float:
    """The damping of a resonance, so high that it is `width` wide at half maximum; both in [Hz]."""
    return min(max(damping, width / (2.0 * frequency)), 1.0)


def widened(spectrum: Array, width: float) -> Array:
    """A spectrum (n // 2 + 1,) of even n whose lines are `width` wider [cycles per sample]: correlations decay as
    exp(-pi width |lag|)."""
    n = 2 * (spectrum.size - 1)
    lag = np.minimum(np.arange(n), n - np.arange(n))
    return np.maximum(np.fft.rfft(np.fft.irfft(spectrum, n) * np.exp(-pi * width * lag)).real, 0.0)
