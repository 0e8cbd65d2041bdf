"""Where a whitened periodogram still holds something: one test over all frequencies, widths and modes.

The whitened periodogram I / S of the right S is exponential of mean 1. A pure line raises one of its bins, a resonance several;
means over 1 ... 243 bins are Gamma distributed. Every frequency gets a share of the level as df / f: of two equally strong peaks
the lower is the likelier to be one of a structure; most of it below STRUCTURES.
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
"""Frequencies per bin at which lines are looked for."""
LOWEST = 5.0
"""Frequency from which peaks are looked for [Hz], unless told: below, what is left is turbulence that no AR(2) is like."""
OVERLAP = 4
"""Means per width."""
OF_LINES = 0.8
"""Share of the level that lines get: one bin has to stand out of all, means of many do so by little."""
SPOILS = 2.0
"""Mean I / S from which bins would spoil the fit of a spectrum that has no peak there."""
STRUCTURES, BELOW = 100.0, 0.9
"""Frequency up to which structures of telescopes are known to vibrate [Hz], and the share of the level spent below it."""


@dataclass(frozen=True)
class Candidate:
    """Something at `frequency` [Hz] over `width` bins.

    strength : gain of log-likelihood if all of it were explained, over the square root of the width: the strongest of all widths
        is then about as wide as the peak, and has no other one in it
    """

    frequency: float
    width: int
    strength: float


@dataclass(frozen=True)
class Found:
    """The strongest candidate; which bins (bins,) are above their limit at some width, and which of them by so much that they
    would spoil a fit."""

    best: Candidate | None
    flagged: Array
    strong: Array


def search(fine: Array, n: int, dt: float, modes: int, level: float, lowest: float = LOWEST) -> Found:
    """Candidates in a whitened periodogram, at PAD frequencies per bin, of n samples; the sum over `modes` of them.

    level : probability of finding any where there is none, OF_LINES of it for lines
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
    return Found(best, flagged, strong)


def _gain(total: Array, count: int):
    """Log-likelihood that `count` bins of the sum `total` gain by a spectrum raised to their mean."""
    mean = np.maximum(total / count, 1.0)
    return count * (mean - 1.0 - np.log(mean))


@lru_cache(maxsize=32)
def _limits(count: int, T: float, width: int, modes: int, share: float, n: int, lowest: float) -> Array:
    """What a sum over `width` bins and `modes` modes may reach, at j / T, j = 1 ... count.

    A line is looked for between the bins as well: the maximum over a continuous frequency passes u as often as
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
    """Density [1/Hz] with which the level is spent from `lowest` to `highest`: as 1 / f, BELOW of it up to STRUCTURES."""
    f = np.maximum(f, lowest)
    if not lowest < STRUCTURES < highest:
        return 1.0 / (f * np.log(highest / lowest))
    return np.where(f < STRUCTURES, BELOW / np.log(STRUCTURES / lowest), (1.0 - BELOW) / np.log(highest / STRUCTURES)) / f
