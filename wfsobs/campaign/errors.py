"""Errors of a campaign as an array, and who is best in one scenario or over many of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from wfsobs.campaign.compare import LEVEL
from wfsobs.evaluation.evidence import columns_differ
from wfsobs.evaluation.rows import NOT_OBSERVERS, can_be_best
from wfsobs.evaluation.scores import BOUNDS, COMMON_BOUNDS
from wfsobs.observers import OBSERVERS
from wfsobs.typing import Array


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

    margin : how much worse the next is, NaN without one;  ties : what does not differ by a test
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
        Whether a name can be the best in a scenario, bool (n_cells, n_names).
    """

    names: tuple[str, ...]
    values: Array
    eligible: Array

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
        mean, half = _mean_interval(np.where(np.isfinite(logs), logs, np.nan))
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
            mean, eligible = np.exp(_mean_interval(samples)[0]), (self.eligible[cells] | np.isnan(rms)).all(axis=0)
        known = (~np.isnan(samples)).sum(axis=0)
        candidates = eligible & (known > 0)
        ranked = [i for i in np.argsort(mean) if candidates[i] and known[i] == known[candidates].max()]
        above = low = high = np.full(len(mean), np.nan)
        best = ranked[0] if ranked else -1
        tie, untested = np.zeros((2, len(mean)), dtype=bool)
        if ranked:
            difference, half = _mean_interval(samples - samples[:, [best]])
            rivals = candidates & (np.arange(len(mean)) != best)
            untested = rivals & np.isnan(half)
            compared = np.flatnonzero(candidates)
            tie[compared] = ~columns_differ(samples[:, compared])[compared == best][0]
            tie &= rivals & ~untested
            parts = [np.where(rivals, part, np.nan) for part in (difference, difference - half, difference + half)]
            above, low, high = (part / mean[best] if len(cells) == 1 else np.expm1(part) for part in parts)
        numbers = [column.tolist() for column in (mean, above, low, high, np.arange(len(mean)) == best, tie, untested)]
        return [CampaignPlace(self.names[i], *(column[i] for column in numbers)) for i in np.argsort(mean) if known[i]]

    def verdict(self, cells: Sequence[int] | Array) -> CampaignWinner | None:
        """Return the best over some scenarios; None where nothing is known."""
        standings = self.standings(cells)
        best = next((s for s in standings if s.is_best), None)
        if best is None:
            return None
        rivals = [s for s in standings if s.is_rival]
        decided = bool(rivals) and not any(s.is_tie or s.is_untested for s in rivals)
        margin = min((s.rms for s in rivals), default=np.nan) / best.rms - 1.0 if best.rms > 0 else np.nan
        return CampaignWinner(best, float(margin), tuple(s.name for s in standings if s.is_tie), decided)

    @cached_property
    def winners(self) -> dict[int, CampaignWinner]:
        """The best of every scenario that has results."""
        known = np.flatnonzero((self.count * self.eligible).any(axis=1)).tolist()
        found = {cell: self.verdict([cell]) for cell in known}
        return {cell: verdict for cell, verdict in found.items() if verdict is not None}


def can_win(name: str, target: str) -> bool:
    """Return whether an observer or a controller is one that can be the best."""
    if target == "residual":
        return name not in BOUNDS
    return name not in (*OBSERVERS, *NOT_OBSERVERS) or can_be_best(name, apart=False)


def _mean_interval(samples: Array, level: float = LEVEL) -> tuple[Array, Array]:
    """Return mean and half-width of its interval by Student's t along the first axis; NaN with fewer than one and two samples."""
    known = ~np.isnan(samples)
    n = known.sum(axis=0)
    some = np.maximum(n, 1)
    mean = np.where(known, samples, 0.0).sum(axis=0) / some
    spread = np.sqrt((np.where(known, samples - mean, 0.0) ** 2).sum(axis=0) / np.maximum(n - 1, 1))
    half = stdtrit(np.maximum(n - 1, 1), (1 + level) / 2) * spread / np.sqrt(some)
    return np.where(n > 0, mean, np.nan), np.where(n > 1, half, np.nan)
