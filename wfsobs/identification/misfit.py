"""Margin for the shape of a smooth spectrum: it may be as much too low as it is too high nearby.

Frozen flow has lobes, a few hertz apart and by tens of percent above and below any smooth curve, which are no peaks. Peaks only
rise: where a fitted spectrum is too high, its shape is wrong, and it is as likely to be too low by as much within an octave.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import gamma

from wfsobs.typing import Array

WIDTH = 27
"""Bins of a mean I / S: the lobes of frozen flow are wider in a minute."""
ABOUT, UNUSUAL = 2.0, 0.05
"""Factor in frequency on either side over which dips are gathered, since the first lobes are as far apart as they are from zero;
and the probability below which what noise dips by is unusual."""
FURTHER, LEVEL = 4.0, 1e-3
"""The same over which dips have to be none of noise: probability at most with which the right spectrum is given a margin at a
frequency."""
MEAN, VARIANCE = 0.2772, 0.3543
"""Of the log-likelihood of a dip of the right spectrum, 0 for means above one; of normal means 0.25 and 0.3125."""


def margin(ratio: Array) -> Array:
    """Return the factor (bins,), 1 or more, by which S may be too low, from I / S (bins,).

    A dip of WIDTH bins is worth d = WIDTH (r - 1 - log r) in log-likelihood, r < 1 their mean. Where the sum of d is unusual over
    an octave on either side, and none of noise over two, all of it is taken for that of log S + a sin: over n means n WIDTH
    a^2 / 8, of the octave. The factor is exp(a).
    """
    n = len(ratio) // WIDTH
    if n < 2:
        return np.ones(len(ratio))
    r = np.clip(ratio[: n * WIDTH].reshape(n, WIDTH).mean(axis=1), 1e-6, 1.0)
    worth = np.concatenate([[0.0], np.cumsum(WIDTH * (r - 1.0 - np.log(r)))])
    near, count, unusual = _sum_dips(worth, ABOUT, UNUSUAL)
    *_, no_noise = _sum_dips(worth, FURTHER, LEVEL)
    a = np.where(unusual & no_noise, np.sqrt(8.0 * near / (WIDTH * count)), 0.0)
    return np.exp(np.interp(np.arange(len(ratio)), WIDTH * (np.arange(n) + 0.5), a))


def _sum_dips(worth: Array, about: float, level: float) -> tuple[Array, NDArray[np.intp], NDArray[np.bool_]]:
    """Sum the log-likelihood of dips within a factor `about` of each mean, from the cumulated `worth`.

    Also return the number of means, and whether noise gives as much with a probability of less than `level`.
    """
    n = len(worth) - 1
    centre = np.arange(n) + 0.5
    low, high = (centre / about).astype(int), np.minimum(np.ceil(centre * about).astype(int), n)
    count, found = high - low, worth[high] - worth[low]
    return found, count, found > gamma.isf(level, count * MEAN**2 / VARIANCE, scale=VARIANCE / MEAN)
