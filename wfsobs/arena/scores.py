"""Scores of entries: error over the reference, geometric mean over scenarios, paired intervals, ranks.

A scenario's ratio is the rms error over its samples (seeds) over that of the reference; the score of a track is their geometric
mean. Its logarithm is a smooth function of mean squares, and its variance follows from the influence of each sample

    d log r = (a[i] / mean(a) - b[i] / mean(b)) / 2,

a and b the mean squares of error and reference (the delta method). The scenarios are fixed: intervals are over seeds. Two entries
are compared on the same records, so that what the records have in common cancels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from wfsobs.campaign.compare import LEVEL
from wfsobs.typing import Array


@dataclass(frozen=True)
class Standing:
    """An entry in a track.

    Attributes
    ----------
    entry : str
        Id.
    score : float
        Geometric mean of the ratios.
    interval : tuple of float or None
        Of the score, at LEVEL; None with fewer than two samples of a scenario.
    rank : int
        One more than the number of entries that are significantly better.
    is_tie : bool
        Whether another entry has the same rank.
    ratios : tuple of float
        Error over reference, one per scenario.
    """

    entry: str
    score: float
    interval: tuple[float, float] | None
    rank: int
    is_tie: bool
    ratios: tuple[float, ...]


def geometric_mean(ratios: Sequence[float]) -> float:
    """Return the geometric mean.

    >>> round(geometric_mean([1.0, 4.0]), 12)
    2.0
    """
    with np.errstate(divide="ignore"):
        return float(np.exp(np.mean(np.log(ratios))))


def log_ratio(a: Sequence[Array], b: Sequence[Array], level: float = LEVEL) -> tuple[float, float | None]:
    """Return the mean over scenarios of log(rms a / rms b), and the half-width of its interval.

    Parameters
    ----------
    a, b : sequence of Array
        Mean squares on the same samples, one array (n_samples,) per scenario.
    level : float
        Level of the interval.

    Returns
    -------
    float
        Mean.
    float or None
        Half-width by Student's t, degrees of freedom by Welch and Satterthwaite; None with fewer than two samples of a scenario.
    """
    with np.errstate(divide="ignore"):
        mean = float(np.mean([0.5 * (np.log(np.mean(x)) - np.log(np.mean(y))) for x, y in zip(a, b, strict=True)]))
    if min(len(x) for x in a) < 2 or not np.isfinite(mean):
        return mean, None
    influence = [0.5 * (x / np.mean(x) - y / np.mean(y)) for x, y in zip(a, b, strict=True)]
    parts = np.array([np.sum(i**2) / (len(i) * (len(i) - 1)) for i in influence]) / len(influence) ** 2
    total = float(parts.sum())
    if total == 0.0:
        return mean, 0.0
    freedom = total**2 / float(sum(p**2 / (len(i) - 1) for p, i in zip(parts, influence, strict=True)))
    return mean, float(stdtrit(freedom, (1 + level) / 2) * np.sqrt(total))


def rank_entries(squares: Mapping[str, Sequence[Array]], reference: Sequence[Array]) -> list[Standing]:
    """Rank the entries of a track.

    Parameters
    ----------
    squares : mapping of str to sequence of Array
        Entry -> mean squares of its errors, one array (n_samples,) per scenario, on the same samples.
    reference : sequence of Array
        Those of the reference.

    Returns
    -------
    list of Standing
        The smallest score first.
    """
    better = {name: sum(_is_better(other, own) for other in squares.values()) for name, own in squares.items()}
    ranks = {name: 1 + count for name, count in better.items()}
    out = []
    for name, own in squares.items():
        ratios = tuple(float(np.sqrt(np.mean(a) / np.mean(b))) for a, b in zip(own, reference, strict=True))
        mean, half = log_ratio(own, reference)
        interval = None if half is None else (float(np.exp(mean - half)), float(np.exp(mean + half)))
        tied = list(ranks.values()).count(ranks[name]) > 1
        out.append(Standing(name, geometric_mean(ratios), interval, ranks[name], tied, ratios))
    return sorted(out, key=lambda s: s.score)


def _is_better(a: Sequence[Array], b: Sequence[Array]) -> bool:
    """Return whether a is significantly better than b; with one sample of a scenario nothing is."""
    if a is b:
        return False
    mean, half = log_ratio(a, b)
    return half is not None and mean < 0.0 and -mean > half
