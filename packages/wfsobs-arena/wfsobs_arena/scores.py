"""Scores of entries: error over the reference, geometric mean over scenarios, paired intervals, ranks.

A scenario's ratio is the rms error over its samples (seeds) over that of the reference; the score of a track is their geometric
mean. Its logarithm is a smooth function of mean squares, and its variance follows from the influence of each sample

    d log r = (a[i] / mean(a) - b[i] / mean(b)) / 2,

a and b the mean squares of error and reference (the delta method). The scenarios are fixed: intervals are over seeds. Two entries
are compared on the same records, so that what the records have in common cancels, and all pairs are tested together (`holm`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from wfsobs.campaign.compare import LEVEL
from wfsobs.evaluation.evidence import all_pairs, pairs_differ, t_probability
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


class LogRatio(NamedTuple):
    """Mean of log(rms a / rms b), its standard error, and degrees of freedom; NaN where there are too few samples."""

    mean: float
    error: float
    freedom: float

    def half_width(self, level: float = LEVEL) -> float | None:
        """Return the half-width of the interval by Student's t; None with fewer than two samples of a scenario."""
        return None if np.isnan(self.error) else float(stdtrit(self.freedom, (1 + level) / 2) * self.error)


def log_ratio(a: Sequence[Array], b: Sequence[Array]) -> LogRatio:
    """Compare two mean squares over scenarios.

    Parameters
    ----------
    a, b : sequence of Array
        Mean squares on the same samples, one array (n_samples,) per scenario.

    Returns
    -------
    LogRatio
        Degrees of freedom by Welch and Satterthwaite.
    """
    with np.errstate(divide="ignore"):
        mean = float(np.mean([0.5 * (np.log(np.mean(x)) - np.log(np.mean(y))) for x, y in zip(a, b, strict=True)]))
    if min(len(x) for x in a) < 2 or not np.isfinite(mean):
        return LogRatio(mean, np.nan, np.nan)
    influence = [0.5 * (x / np.mean(x) - y / np.mean(y)) for x, y in zip(a, b, strict=True)]
    parts = np.array([np.sum(i**2) / (len(i) * (len(i) - 1)) for i in influence]) / len(influence) ** 2
    total = float(parts.sum())
    if total == 0.0:
        return LogRatio(mean, 0.0, 1.0)
    freedom = total**2 / float(sum(p**2 / (len(i) - 1) for p, i in zip(parts, influence, strict=True)))
    return LogRatio(mean, float(np.sqrt(total)), freedom)


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
    entries = list(squares.values())
    ratios = [tuple(float(np.sqrt(np.mean(a) / np.mean(b))) for a, b in zip(own, reference, strict=True)) for own in entries]
    scores = np.array([geometric_mean(one) for one in ratios])
    pairs = [log_ratio(entries[i], entries[j]) for i, j in zip(*all_pairs(len(entries)), strict=True)]
    p = np.nan_to_num(t_probability(*np.array(pairs).reshape(-1, 3).T), nan=1.0)  # with too few samples nothing is decided
    ranks = (1 + (pairs_differ(p) & (scores[:, None] < scores)).sum(axis=0)).tolist()
    out = []
    for name, own, rank, score, of_cases in zip(squares, entries, ranks, scores.tolist(), ratios, strict=True):
        against = log_ratio(own, reference)
        half = against.half_width()
        interval = None if half is None else (float(np.exp(against.mean - half)), float(np.exp(against.mean + half)))
        out.append(Standing(name, score, interval, rank, ranks.count(rank) > 1, of_cases))
    return sorted(out, key=lambda s: s.score)
