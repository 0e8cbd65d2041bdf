"""By how much a smooth spectrum may be too low: what it is seen to be too high by nearby.

Frozen flow has lobes, a few hertz apart and by tens of percent above and below any smooth curve, which are no peaks. Peaks only
rise: where a fitted spectrum is too high, its shape is wrong, and it is as likely to be too low by as much within an octave.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import gamma

from wfsobs.typing import Array

WIDTH = 27
"""Bins of a mean I / S: the lobes of frozen flow are wider in a minute."""
ABOUT = 2.0
"""Factor in frequency on either side over which dips are gathered: the first lobes are as far apart as they are from zero."""
LEVEL = 1e-3
"""Probability with which the right spectrum is given a margin at a frequency."""
MEAN, VARIANCE = 0.2772, 0.3543
"""Of what a dip of the right spectrum is worth in log-likelihood, 0 for means above one; of normal means 0.25 and 0.3125."""


def margin(ratio: Array) -> Array:
    """Factor (bins,), 1 or more, by which S may be too low, from I / S (bins,).

    A dip of WIDTH bins is worth d = WIDTH (r - 1 - log r) in log-likelihood, r < 1 their mean. Where the sum of d over an octave
    on either side is not that of noise, all of it is taken for that of log S + a sin: over n means n WIDTH a^2 / 8. The factor
    is exp(a).
    """
    n = len(ratio) // WIDTH
    if n < 2:
        return np.ones(len(ratio))
    r = np.clip(ratio[: n * WIDTH].reshape(n, WIDTH).mean(axis=1), 1e-6, 1.0)
    total = np.concatenate([[0.0], np.cumsum(WIDTH * (r - 1.0 - np.log(r)))])
    centre = np.arange(n) + 0.5
    low, high = (centre / ABOUT).astype(int), np.minimum(np.ceil(centre * ABOUT).astype(int), n)
    count, found = high - low, total[high] - total[low]
    limit = gamma.isf(LEVEL, count * MEAN**2 / VARIANCE, scale=VARIANCE / MEAN)
    a = np.sqrt(8.0 * found / (WIDTH * count))
    return np.exp(np.interp(np.arange(len(ratio)), WIDTH * centre, np.where(found > limit, a, 0.0)))
