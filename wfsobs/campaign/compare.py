"""Compare what ran on the same records: errors as arrays, paired differences and their intervals, what is best."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import stdtrit

from wfsobs.evaluation.evidence import columns_differ
from wfsobs.evaluation.result import NOT_OBSERVERS, can_be_best
from wfsobs.evaluation.scores import BOUNDS, COMMON_BOUNDS
from wfsobs.observers import OBSERVERS
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


class CampaignPlace(NamedTuple):
    """One observer, controller or bound over some scenarios.

    Attributes
    ----------
    name : str
        Id.
    rms : float
        Root mean square over the seeds, of several scenarios the geometric mean [nm].
    above : float
        Mean of its rms over that of the best, less 1; NaN where it is not compared.
    low, high : float
        Interval of `above`; NaN where there is none.
    is_best, is_tie, is_untested : bool
        Whether it is the best; whether a test of all pairs together finds no difference from the best; whether it is compared
        with too little to test.
    """

    name: str
    rms: float
    above: float
    low: float
    high: float
    is_best: bool
    is_tie: bool
    is_untested: bool

    @property
    def is_rival(self) -> bool:
        """Whether it is compared with the best."""
        return self.is_tie or self.is_untested or not np.isnan(self.above)


class CampaignWinner(NamedTuple):
    """The best over some scenarios.

    margin : how much worse the next is where both have a result, NaN without one;  ties : what does not differ by a test
    is_decided : whether it differs significantly from all others
    """

    best: CampaignPlace
    margin: float
    ties: tuple[str, ...]
    is_decided: bool


@dataclass(frozen=True)
class CampaignErrors:
    """Errors of a campaign, for one target and mode.

    Attributes
    ----------
    names : tuple of str
        Ids of observers or controllers, and of bounds.
    values : Array
        rms [nm], (n_cells, n_seeds, n_names), NaN without a result.
    eligible : Array
        Whether a name ran in a scenario and can be the best there, bool (n_cells, n_names).
    level : float
        Level of the tests and of the intervals of differences.
    """

    names: tuple[str, ...]
    values: Array
    eligible: Array
    level: float = LEVEL

    @cached_property
    def count(self) -> Array:
        """Records with a result, (n_cells, n_names)."""
        return (~np.isnan(self.values)).sum(axis=1)

    @cached_property
    def rms(self) -> Array:
        """Root mean square over the seeds [nm], (n_cells, n_names)."""
        squares = np.nansum(self.values**2, axis=1)
        return np.sqrt(np.divide(squares, self.count, out=np.full(squares.shape, np.nan), where=self.count > 0))

    @cached_property
    def bound(self) -> Array:
        """The smallest bound of what all observers are given, of every scenario [nm], (n_cells,); NaN where none is known."""
        of = [i for i, name in enumerate(self.names) if name in COMMON_BOUNDS]
        known = self.rms[:, of] if of else np.full((len(self.rms), 1), np.nan)
        return np.fmin.reduce(known, axis=1)

    def over_bound(self, cells: Sequence[int] | Array) -> tuple[Array, Array, Array]:
        """Return the geometric mean over scenarios of rms over bound, and its interval, each (n_names,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(self.rms[cells] / self.bound[cells, None])
        mean, half = mean_interval(np.where(np.isfinite(logs), logs, np.nan))
        return np.exp(mean), np.exp(mean - half), np.exp(mean + half)

    def known_cells(self, cells: Sequence[int] | Array) -> Array:
        """Return those of some scenarios that have results."""
        cells = np.asarray(cells, dtype=int)
        return cells[self.count[cells].any(axis=1)]

    def standings(self, cells: Sequence[int] | Array) -> list[CampaignPlace]:
        """Compare all names over some scenarios: over the seeds if a single one has results, else over the scenarios.

        Seeds of one scenario are no independent evidence about others, so that of several each counts once, by the logarithm of
        its rms. The best is the one with the smallest mean of those with a result in most records or scenarios.
        """
        cells = self.known_cells(cells)
        if len(cells) == 1:
            samples, mean, eligible = self.values[cells[0]], self.rms[cells[0]], self.eligible[cells[0]]
        else:
            rms = self.rms[cells]
            with np.errstate(divide="ignore"):
                samples = np.where(rms > 0, np.log(rms), np.nan)
            mean, eligible = np.exp(mean_interval(samples)[0]), np.all(self.eligible[cells] | np.isnan(rms), axis=0)
        best, difference, half, tie, untested = compare_columns(samples, mean, eligible, self.level)
        parts = difference, difference - half, difference + half
        above, low, high = (part / mean[best] if len(cells) == 1 else np.expm1(part) for part in parts)
        numbers = [column.tolist() for column in (mean, above, low, high, np.arange(len(mean)) == best, tie, untested)]
        known = np.any(~np.isnan(samples), axis=0)
        return [CampaignPlace(self.names[i], *(column[i] for column in numbers)) for i in np.argsort(mean) if known[i]]

    def verdict(self, cells: Sequence[int] | Array) -> CampaignWinner | None:
        """Return the best over some scenarios; None where nothing is known."""
        standings = self.standings(cells)
        best = next((s for s in standings if s.is_best), None)
        if best is None:
            return None
        rivals = [s for s in standings if s.is_rival]
        decided = bool(rivals) and not any(s.is_tie or s.is_untested for s in rivals)
        above = [s.above for s in rivals if not np.isnan(s.above)]
        margin = max(min(above), 0.0) if above else np.nan  # what failed may be better where it did not
        return CampaignWinner(best, margin, tuple(s.name for s in standings if s.is_tie), decided)

    @cached_property
    def winners(self) -> dict[int, CampaignWinner]:
        """The best of every scenario that has results."""
        known = np.flatnonzero((self.count * self.eligible).any(axis=1)).tolist()
        return {cell: verdict for cell in known if (verdict := self.verdict([cell])) is not None}


def can_win(name: str, target: str) -> bool:
    """Return whether an observer or a controller is one that can be the best."""
    if target == "residual":
        return name not in BOUNDS
    return name not in (*OBSERVERS, *NOT_OBSERVERS) or can_be_best(name, apart=False)


def compare_columns(samples: Array, mean: Array, eligible: Array, level: float = LEVEL) -> tuple[int, Array, Array, Array, Array]:
    """Find the best: the smallest mean of those with a result in most samples, and compare all that can be the best with it.

    Parameters
    ----------
    samples : Array
        Errors or their logarithms, (n, n_names), NaN without a result.
    mean : Array
        By which is ranked, (n_names,).
    eligible : Array
        Whether a name can be the best, bool (n_names,).
    level : float
        Level of the intervals.

    Returns
    -------
    int
        Column of the best; -1 where nothing is known.
    Array
        Means of the differences from it, (n_names,), NaN where they are not compared.
    Array
        Half-widths of their intervals, NaN where these are not known.
    Array
        Whether a test of all pairs together finds no difference from the best, bool (n_names,).
    Array
        Whether there is too little to test, bool (n_names,).
    """
    known = (~np.isnan(samples)).sum(axis=0)
    candidates = eligible & (known > 0)
    ranked = [i for i in np.argsort(mean) if candidates[i] and known[i] == known[candidates].max()]
    if not ranked:
        nothing, none = np.full(len(mean), np.nan), np.zeros(len(mean), dtype=bool)
        return -1, nothing, nothing, none, none
    best = int(ranked[0])
    rivals = candidates & (np.arange(len(mean)) != best)
    difference, half = (np.where(rivals, part, np.nan) for part in mean_interval(samples - samples[:, [best]], level))
    untested, tie, compared = rivals & np.isnan(half), np.zeros(len(mean), dtype=bool), np.flatnonzero(candidates)
    tie[compared] = ~columns_differ(samples[:, compared], 1.0 - level)[compared == best][0]
    return best, difference, half, tie & rivals & ~untested, untested


def mean_interval(samples: Array, level: float = LEVEL) -> tuple[Array, Array]:
    """Return mean and half-width of its interval by Student's t along the first axis; NaN with fewer than one and two samples."""
    known = ~np.isnan(samples)
    n = known.sum(axis=0)
    some = np.maximum(n, 1)
    mean = np.where(known, samples, 0.0).sum(axis=0) / some
    spread = np.sqrt((np.where(known, samples - mean, 0.0) ** 2).sum(axis=0) / np.maximum(n - 1, 1))
    half = stdtrit(np.maximum(n - 1, 1), (1 + level) / 2) * spread / np.sqrt(some)
    return np.where(n > 0, mean, np.nan), np.where(n > 1, half, np.nan)


ROW = np.dtype(
    [("cell", "i4"), ("seed", "i8"), ("name", "i4"), ("target", "i4"), ("mode", "i4"), ("rms_nm", "f8"), ("apart", "?")]
)
"""One row, its texts as numbers."""


def coded_rows(table: pyarrow.Table, codes: dict[str, int]) -> Array:
    """Return rows of a campaign as an array of ROW; codes : text -> its number, to which new ones are added."""
    rows = np.zeros(table.num_rows, dtype=ROW)
    for column in ("cell", "seed", "rms_nm"):
        rows[column] = table[column].to_numpy()
    rows["apart"] = table["apart"].fill_null(False).to_numpy()
    for column in ("name", "target", "mode"):
        encoded = table[column].combine_chunks().dictionary_encode()
        known = np.array([codes.setdefault(text, len(codes)) for text in encoded.dictionary.to_pylist()], dtype=int)
        rows[column] = known[encoded.indices.to_numpy()] if len(known) else 0
    return rows


def gather_errors(
    rows: Array, codes: Mapping[str, int], shape: tuple[int, int], level: float = LEVEL
) -> dict[tuple[str, str], CampaignErrors]:
    """Return (target, mode) -> errors of rows, whose cells and seeds are places in an array of this shape."""
    texts, out = list(codes), {}
    for target, mode in np.unique(rows[["target", "mode"]]).tolist():
        if texts[target]:
            part = rows[(rows["target"] == target) & (rows["mode"] == mode)]
            out[texts[target], texts[mode]] = _errors_of(part, texts, texts[target], shape, level)
    return out


def _errors_of(rows: Array, texts: list[str], target: str, shape: tuple[int, int], level: float) -> CampaignErrors:
    """Return the errors of the rows of one target and mode."""
    codes, place = np.unique(rows["name"], return_inverse=True)
    known, order = np.unique([texts[code] for code in codes], return_inverse=True)
    names, column = known.tolist(), order[place]
    values, eligible = np.full((*shape, len(names)), np.nan), np.zeros((shape[0], len(names)), dtype=bool)
    values[rows["cell"], rows["seed"], column] = rows["rms_nm"]
    eligible[rows["cell"], column] = np.array([can_win(name, target) for name in names])[column]
    eligible[rows["cell"][rows["apart"]], column[rows["apart"]]] = False
    return CampaignErrors(tuple(names), values, eligible, level)


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
    out = []
    for where, errors in each_group(table):
        values, rms, count, eligible = errors.values[0], errors.rms[0], errors.count[0], errors.eligible[0]
        best, difference, half, tie, untested = compare_columns(values, rms, eligible, level)
        for i in np.argsort(rms):
            if not count[i] and not eligible[i]:
                continue
            by, reach = (None if np.isnan(x[i]) else float(x[i]) for x in (difference, half))
            known = values[~np.isnan(values[:, i]), i]
            spread = tuple(np.quantile(known, QUANTILES).tolist()) if count[i] else ()
            counts = int(count[i]), len(values) - int(count[i])
            is_tie = bool(tie[i] or untested[i])
            out.append(Comparison(*where, errors.names[i], *counts, float(rms[i]), by, reach, bool(i == best), is_tie, spread))
    return out


def each_group(table: pyarrow.Table) -> Iterator[tuple[tuple[int, str, str, str], CampaignErrors]]:
    """Yield the errors of each scenario, for each target and mode, after its number, its name, target and mode."""
    codes: dict[str, int] = {}
    rows = coded_rows(table, codes)
    cells, first, rows["cell"] = np.unique(rows["cell"], return_index=True, return_inverse=True)
    seeds, rows["seed"] = np.unique(rows["seed"], return_inverse=True)
    ran = np.zeros((len(cells), len(seeds)), dtype=bool)
    ran[rows["cell"], rows["seed"]] = True
    found = sorted(gather_errors(rows, codes, ran.shape).items())
    for i, cell in enumerate(cells.tolist()):
        scenario = table["scenario"][int(first[i])].as_py()
        for key, errors in found:
            own = CampaignErrors(errors.names, errors.values[[i]][:, ran[i]], errors.eligible[[i]])
            if own.count.any() or own.eligible.any():
                yield (cell, scenario, *key), own


def comparison_groups(comparisons: Sequence[Comparison]) -> dict[tuple[int, str, str], list[Comparison]]:
    """Return (number of the scenario, target, mode) -> what was compared there; comparisons : in the order of `compare`."""
    return {key: list(of) for key, of in groupby(comparisons, attrgetter("cell", "target", "mode"))}
