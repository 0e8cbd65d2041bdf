"""Peak search in a whitened periodogram: one test over all frequencies, widths and modes.

The whitened periodogram I / S of the right S is exponential of mean 1. An undamped line raises one of its bins, a resonance
several; means over 1 ... 243 bins are Gamma distributed. Every frequency gets a share of the level as df / f: of two equally
strong peaks the lower is the likelier to be one of a structure; most of it below STRUCTURES.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.stats import gamma

from wfsobs.spectral.periodogram import inflation
from wfsobs.typing import Array

WIDTHS = (3, 9, 27, 81, 243)
"""Bins of a mean."""
PAD = 4
"""Frequencies per bin in the search for lines."""
LOWEST = 5.0
"""Default minimum frequency of a peak [Hz]: below, the remainder is turbulence that no AR(2) matches."""
OVERLAP = 4
"""Means per width."""
OF_LINES = 0.8
"""Share of the level for lines: one bin has to exceed all others, means of many exceed them by little."""
SPOILS = 2.0
"""Mean I / S from which bins would spoil the fit of a spectrum without a peak there."""
STRUCTURES, BELOW = 100.0, 0.9
"""Maximum frequency at which structures of telescopes are known to vibrate [Hz], and the share of the level spent below it."""


@dataclass(frozen=True)
class Candidate:
    """A possible peak at `frequency` [Hz] over `width` bins.

    strength : gain of log-likelihood if all of it were explained, over the square root of the width: the strongest of all widths
        is then about as wide as the peak, and contains no other one
    """

    frequency: float
    width: int
    strength: float


@dataclass(frozen=True)
class SearchResult:
    """Result of a peak search.

    Attributes
    ----------
    best : Candidate or None
        The strongest candidate.
    above_limit : Array
        Bins above their limit at some width, bool (bins,).
    strong : Array
        Those so far above it that they would spoil a fit.
    """

    best: Candidate | None
    above_limit: Array
    strong: Array


def search_peaks(fine: Array, n: int, dt: float, modes: int, level: float, lowest: float = LOWEST) -> SearchResult:
    """Search a whitened periodogram for peaks.

    Parameters
    ----------
    fine : Array
        Sum of the whitened periodograms of all modes, at PAD frequencies per bin.
    n : int
        Number of samples of the record.
    dt : float
        Time step [s].
    modes : int
        Number of modes in the sum.
    level : float
        Probability of a false peak where there is none, OF_LINES of it for lines.
    lowest : float
        Minimum frequency [Hz].

    Returns
    -------
    Found
        Best candidate and flagged bins.
    """
    T = n * dt
    of_lines, share = OF_LINES * level, (1.0 - OF_LINES) * level / len(WIDTHS)
    flagged, strong = np.zeros((2, (n + 1) // 2 - 1), bool)
    best: Candidate | None = None
    f = np.arange(1, len(fine) + 1) / (PAD * T)
    high = (fine > _limits(len(fine), PAD * T, 1, modes, of_lines, n, lowest)) & (f >= lowest)
    if high.any():
        at = int(np.argmax(np.where(high, fine, 0.0)))
        best = Candidate(float(f[at]), 1, float(_gain(fine[at], modes)))
        bins = np.clip(np.round((np.flatnonzero(high) + 1) / PAD).astype(int) - 1, 0, len(flagged) - 1)
        flagged[bins] = strong[bins] = True
    sums = np.concatenate([[0.0], np.cumsum(fine[PAD - 1 :: PAD][: len(flagged)])])
    for width in WIDTHS:
        start = np.arange(0, len(flagged) - width, max(width // OVERLAP, 1))
        total = sums[start + width] - sums[start]
        centre = (start + (width + 1) / 2.0) / T
        limit = np.interp(centre, np.arange(1, len(flagged) + 1) / T, _limits(len(flagged), T, width, modes, share, n, lowest))
        high = (total > limit) & (centre - width / 2.0 / T >= lowest)
        for i in np.flatnonzero(high):
            flagged[start[i] : start[i] + width] = True
            strong[start[i] : start[i] + width] |= total[i] > SPOILS * width * modes
        if high.any():
            strengths = np.where(high, _gain(total, width * modes), 0.0) / np.sqrt(width)
            i = int(np.argmax(strengths))
            if best is None or strengths[i] > best.strength:
                best = Candidate(float(centre[i]), width, float(strengths[i]))
    return SearchResult(best, flagged, strong)


def _gain(total: Array, count: int):
    """Return the gain of log-likelihood of `count` bins of the sum `total` when the spectrum is raised to their mean."""
    mean = np.maximum(total / count, 1.0)
    return count * (mean - 1.0 - np.log(mean))


@lru_cache(maxsize=32)
def _limits(count: int, T: float, width: int, modes: int, share: float, n: int, lowest: float) -> Array:
    """Return the limit of a sum over `width` bins and `modes` modes, at j / T, j = 1 ... count.

    A line is searched between the bins as well: the maximum over a continuous frequency passes u as often as
    sqrt(pi u / 3) exp(-u) per bin and once more (Turkman and Walker, Adv. Appl. Prob. 16, 819, 1984; for sums of several, Davies,
    Biometrika 74, 33, 1987).
    """
    j = np.geomspace(1, count, 200)
    highest = count / T
    spacing = 1.0 / T if width == 1 else max(width // OVERLAP, 1) / T
    probability = share * spacing * _prior(j / T, lowest, highest)
    shape = width * modes / (1.0 if width == 1 else inflation(n))
    if width == 1:  # PAD frequencies to a bin, and the factor above: by iteration
        probability = probability * PAD
        limit = gamma.isf(probability, shape)
        for _ in range(4):
            limit = gamma.isf(probability / (1.0 + np.sqrt(np.pi * limit / 3.0)), shape)
    else:
        limit = gamma.isf(probability, shape) * width * modes / shape
    return np.interp(np.log(np.arange(1, count + 1)), np.log(j), limit)


def _prior(f: Array, lowest: float, highest: float) -> Array:
    """Return the density [1/Hz] of the level from `lowest` to `highest`: as 1 / f, BELOW of it up to STRUCTURES."""
    f = np.maximum(f, lowest)
    if not lowest < STRUCTURES < highest:
        return 1.0 / (f * np.log(highest / lowest))
    return np.where(f < STRUCTURES, BELOW / np.log(STRUCTURES / lowest), (1.0 - BELOW) / np.log(highest / STRUCTURES)) / f
