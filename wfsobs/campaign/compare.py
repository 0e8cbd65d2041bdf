"""Compare what ran on the same records: rms over seeds, paired differences and their intervals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import stdtrit

from wfsobs.evaluation.evidence import columns_differ
from wfsobs.evaluation.rows import can_be_best
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.typing import Array

if TYPE_CHECKING:
    import pyarrow

LEVEL = 0.95
"""Level of intervals."""
QUANTILES = (0.05, 0.5, 0.95)
"""Shares of the seeds of which the rms is stated."""


@dataclass(frozen=True)
class Comparison:
    """One observer or controller in one scenario, target and mode.

    Attributes
    ----------
    cell : int
        Number of the scenario.
    scenario, target, mode, name : str
        What was compared.
    seeds : int
        Number of records with a result.
    failures : int
        Number of records without.
    rms : float
        Root mean square over the records [nm].
    difference : float or None
        Mean of its rms less that of the best over the records that both have [nm]; None for the best and for rows that cannot be
        the best.
    half_width : float or None
        Of the interval of this one difference at the level [nm]; None with fewer than two records.
    is_best : bool
        Whether it has the smallest error of those that can be the best and did not fail more often than others.
    is_tie : bool
        Whether the difference from the best is not significant, with all pairs of what can be the best tested together (`holm`).
    quantiles : tuple of float
        Of the rms of single records [nm], of QUANTILES; empty without a result.
    """

    cell: int
    scenario: str
    target: str
    mode: str
    name: str
    seeds: int
    failures: int
    rms: float
    difference: float | None = None
    half_width: float | None = None
    is_best: bool = False
    is_tie: bool = False
    quantiles: tuple[float, ...] = ()


def paired_difference(a: Array, b: Array, level: float = LEVEL) -> tuple[float, float | None]:
    """Return the mean of a - b, and the half-width of its interval by Student's t.

    Parameters
    ----------
    a, b : Array
        Results on the same records, (n,); pairs with NaN are left out.
    level : float
        Level of the interval.

    Returns
    -------
    float
        Mean.
    float or None
        Half-width; None for fewer than two pairs.

    Examples
    --------
    >>> import numpy as np
    >>> mean, half = paired_difference(np.array([2.0, 4.0]), np.array([1.0, 1.0]))
    >>> round(mean, 3), round(half, 3)  # t(0.975, 1 degree of freedom) = 12.706
    (2.0, 12.706)
    """
    d = (a - b)[~np.isnan(a - b)]
    if len(d) < 2:
        return (float(d.mean()) if len(d) else float("nan")), None
    return float(d.mean()), float(stdtrit(len(d) - 1, (1 + level) / 2) * d.std(ddof=1) / np.sqrt(len(d)))


def compare(table: pyarrow.Table, level: float = LEVEL) -> list[Comparison]:
    """Compare all that ran in each scenario.

    Parameters
    ----------
    table : pyarrow.Table
        Rows of `wfsobs.campaign.store.read_results`.
    level : float
        Level of the intervals of the differences.

    Returns
    -------
    list of Comparison
        By scenario, target and mode, the smallest error first.
    """
    return [one for group in each_group(table) for one in _compare_one(group, level)]


@dataclass(frozen=True)
class Samples:
    """What ran in one scenario, for one target and mode.

    Attributes
    ----------
    cell : int
        Number of the scenario.
    scenario, target, mode : str
        What was compared.
    names : list of str
        Ids.
    values : Array
        rms [nm], (n_seeds, n_names), NaN without a result.
    eligible : Array
        Whether a name can be the best, bool (n_names,).
    """

    cell: int
    scenario: str
    target: str
    mode: str
    names: list[str]
    values: Array
    eligible: Array


def each_group(table: pyarrow.Table) -> Iterator[Samples]:
    """Yield what ran in each scenario, for each target and mode."""
    if not len(table):
        return
    table = table.sort_by([(c, "ascending") for c in ("cell", "target", "mode", "name", "seed")])
    cell, seed, rms = (table[c].to_numpy() for c in ("cell", "seed", "rms_nm"))
    apart = table["apart"].fill_null(False).to_numpy()
    (target, targets), (mode, modes), (name, names) = (_codes(table[c]) for c in ("target", "mode", "name"))
    changes = np.any(np.diff([cell, target, mode], axis=1) != 0, axis=0)
    edges = np.concatenate([[0], np.flatnonzero(changes) + 1, [len(table)]])
    failed_cells, failed_seeds = cell[target == targets.get("", -1)], seed[target == targets.get("", -1)]
    of_target, of_mode, of_name = (list(texts) for texts in (targets, modes, names))
    for start, stop in pairwise(edges):
        what, part = of_target[target[start]], slice(start, stop)
        if not what:
            continue
        ran, column = np.unique(name[part], return_inverse=True)
        found = [of_name[code] for code in ran]
        missing = failed_seeds[slice(*np.searchsorted(failed_cells, [cell[start], cell[start] + 1]))]
        seeds = np.unique(np.concatenate([seed[part], missing]))
        values = np.full((len(seeds), len(found)), np.nan)
        values[np.searchsorted(seeds, seed[part]), column] = rms[part]
        is_apart = np.bincount(column, weights=apart[part], minlength=len(found)) > 0
        is_residual = what == "residual"
        eligible = np.array(
            [
                (is_residual and one not in BOUNDS) or can_be_best(one, bool(beside))
                for one, beside in zip(found, is_apart, strict=True)
            ]
        )
        scenario = table["scenario"][int(start)].as_py()
        yield Samples(int(cell[start]), scenario, what, of_mode[mode[start]], found, values, eligible)


def _codes(column: pyarrow.ChunkedArray) -> tuple[Array, dict[str, int]]:
    """Return texts as numbers, (n,), and the number of each text, in alphabetical order."""
    encoded = column.combine_chunks().dictionary_encode()
    texts = encoded.dictionary.to_pylist()
    order = {text: i for i, text in enumerate(sorted(texts))}
    return np.array([order[text] for text in texts])[encoded.indices.to_numpy()], order


def _compare_one(group: Samples, level: float) -> list[Comparison]:
    """Return the rows of a group, the smallest error first."""
    names, values, eligible = group.names, group.values, group.eligible
    known = ~np.isnan(values)
    count = known.sum(axis=0)
    with np.errstate(invalid="ignore"):
        rms = np.sqrt((np.where(known, values, 0.0) ** 2).sum(axis=0) / count)
    ranked = [i for i in np.argsort(rms) if eligible[i] and count[i] == count[eligible].max(initial=0)]
    out = []
    rivals = np.flatnonzero(eligible)
    differs = (
        dict(zip(rivals, columns_differ(values[:, rivals], 1.0 - level)[rivals == ranked[0]][0], strict=True)) if ranked else {}
    )
    for i in np.argsort(rms):
        difference, half, is_tie = None, None, False
        if ranked and eligible[i] and i != ranked[0]:
            difference, half = paired_difference(values[:, i], values[:, ranked[0]], level)
            is_tie = not differs[i]
        failures, is_best = len(values) - int(count[i]), bool(ranked) and bool(i == ranked[0])
        where = group.cell, group.scenario, group.target, group.mode
        spread = tuple(np.quantile(values[known[:, i], i], QUANTILES).tolist()) if count[i] else ()
        out.append(
            Comparison(*where, names[i], int(count[i]), failures, float(rms[i]), difference, half, is_best, is_tie, spread)
        )
    return out
