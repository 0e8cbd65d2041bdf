"""Ranks over many scenarios: mean ranks, the critical difference, and how stable the first place is.

The test is Friedman's with Nemenyi's critical difference (J. Demsar, J. Mach. Learn. Res. 7 (2006) 1). Scenarios are the blocks:
seeds of one scenario are no independent evidence about others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import rankdata, studentized_range

from wfsobs.campaign.compare import LEVEL, Comparison, each_group
from wfsobs.typing import Array

if TYPE_CHECKING:
    import pyarrow

RESAMPLES = 500
"""Bootstrap samples of the seeds."""


@dataclass(frozen=True)
class Ranking:
    """Ranks of what can be the best, for one target and mode.

    Attributes
    ----------
    target, mode : str
        What was ranked.
    names : tuple of str
        Ids, the best mean rank first.
    mean_ranks : tuple of float
        Mean over the scenarios, 1 for the best.
    scenarios : int
        Number of scenarios.
    critical : float or None
        Difference of mean ranks that is significant; None for fewer than two scenarios or names.
    ties : tuple of (int, int)
        First and last position of names whose mean ranks do not differ significantly, the longest runs alone.
    """

    target: str
    mode: str
    names: tuple[str, ...]
    mean_ranks: tuple[float, ...]
    scenarios: int
    critical: float | None
    ties: tuple[tuple[int, int], ...] = ()


def critical_difference(names: int, blocks: int, level: float = LEVEL) -> float:
    """Return Nemenyi's critical difference of mean ranks.

    Parameters
    ----------
    names : int
        Number of what is compared.
    blocks : int
        Number of scenarios.
    level : float
        Level of the test.

    Returns
    -------
    float
        Difference.

    Examples
    --------
    >>> round(critical_difference(5, 6) / (5 * 6 / (6 * 6)) ** 0.5, 3)  # Demsar's table 5: 2.728
    2.728
    """
    q = float(studentized_range.ppf(level, names, np.inf)) / np.sqrt(2.0)
    return float(q * np.sqrt(names * (names + 1) / (6.0 * blocks)))


def rank(comparisons: Sequence[Comparison]) -> list[Ranking]:
    """Rank by the rms over the seeds, scenario by scenario.

    Parameters
    ----------
    comparisons : sequence of Comparison
        Of all scenarios; a name takes part that can be the best in every one of them.

    Returns
    -------
    list of Ranking
        One per target and mode.
    """
    groups: dict[tuple[str, str], dict[int, dict[str, float]]] = {}
    for c in comparisons:
        if c.is_best or c.difference is not None:
            groups.setdefault((c.target, c.mode), {}).setdefault(c.cell, {})[c.name] = c.rms
    return [_rank_one(*key, list(cells.values())) for key, cells in sorted(groups.items())]


def _rank_one(target: str, mode: str, cells: Sequence[dict[str, float]]) -> Ranking:
    names = [name for name in cells[0] if all(name in cell for cell in cells)]
    mean = np.mean([rankdata([cell[name] for name in names]) for cell in cells], axis=0)
    order = np.argsort(mean, kind="stable")
    ordered = [float(mean[i]) for i in order]
    critical = critical_difference(len(names), len(cells)) if len(names) > 1 and len(cells) > 1 else None
    ties = () if critical is None else _runs(ordered, critical)
    return Ranking(target, mode, tuple(names[i] for i in order), tuple(ordered), len(cells), critical, ties)


def _runs(mean_ranks: Sequence[float], critical: float) -> tuple[tuple[int, int], ...]:
    """Return the longest runs of positions within the critical difference.

    >>> _runs([1.0, 1.4, 2.0, 4.0], 1.1)
    ((0, 2),)
    """
    runs = [(i, max(j for j, r in enumerate(mean_ranks) if r - first < critical)) for i, first in enumerate(mean_ranks)]
    longest = runs[:1] + [b for a, b in pairwise(runs) if b[1] > a[1]]
    return tuple(run for run in longest if run[1] > run[0])


def first_places(table: pyarrow.Table, rng: np.random.Generator) -> dict[tuple[int, str, str], dict[str, float]]:
    """Return how often each name is the best when the seeds are drawn again.

    Parameters
    ----------
    table : pyarrow.Table
        Rows of a campaign.
    rng : numpy.random.Generator
        Draws the seeds.

    Returns
    -------
    dict
        (cell, target, mode) -> name -> share of RESAMPLES samples in which its rms is the smallest.
    """
    out: dict[tuple[int, str, str], dict[str, float]] = {}
    for group in each_group(table):
        columns = np.flatnonzero(group.eligible & ~np.isnan(group.values).any(axis=0))
        if not len(columns):
            continue
        best = _best_of_samples(group.values[:, columns] ** 2, rng)
        shares = np.bincount(best, minlength=len(columns)) / RESAMPLES
        out[group.cell, group.target, group.mode] = {
            group.names[i]: float(share) for i, share in zip(columns, shares, strict=True) if share
        }
    return out


def _best_of_samples(squares: Array, rng: np.random.Generator) -> Array:
    """Return the column with the smallest mean in samples of the rows, (RESAMPLES,)."""
    weights = rng.multinomial(len(squares), np.full(len(squares), 1 / len(squares)), size=RESAMPLES)
    return np.argmin(weights @ squares, axis=1)
