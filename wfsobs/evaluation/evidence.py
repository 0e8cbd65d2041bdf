"""What several seeds of a scenario say that one record cannot: intervals of errors, and differences that are significant.

Of many observers the best is found by comparing all with each other. Pairs are tested together (`holm`), so that of equals any is
called different in at most LEVEL of cases.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit

from wfsobs.evaluation.result import EQUAL, NO_ESTIMATE, can_be_best
from wfsobs.evaluation.scores import BOUNDS, Score, scatter_of_mean
from wfsobs.observers import OBSERVERS
from wfsobs.typing import Array

LEVEL = 0.05
"""Share of wrong calls of a difference between observers that are equally good, and of intervals without the mean."""

FEWEST = 3
"""Least number of seeds that say anything."""

SAME = 1e-3
"""Errors that differ by a smaller share of them are the same: two ways of one filter, or the third digit of a table."""

Key = tuple[str, str, str]
"""Observer, target, mode."""


@dataclass(frozen=True)
class Evidence:
    """Errors over several seeds of a scenario, or over the pieces of one record.

    Attributes
    ----------
    errors, truths : mapping
        (observer, target, mode) -> rms error, and rms of the truth, of every seed, (n_seeds,) [um].
    n_seeds : int
        Number of seeds.
    record : mapping
        (observer, target, mode) -> score of the first of them.
    """

    errors: Mapping[Key, Array]
    truths: Mapping[Key, Array]
    n_seeds: int
    record: Mapping[Key, Score] = field(default_factory=dict)

    def mean(self, key: Key) -> float | None:
        """Return the mean over the seeds of an rms error [um]; None where it is not known of all."""
        return float(self.errors[key].mean()) if key in self.errors else None

    def interval(self, key: Key) -> tuple[float, float] | None:
        """Return the interval that has the mean over all records in 95 % of cases [um]; None where it is not known."""
        if key not in self.errors:
            return None
        return self.record[key].interval if self.n_seeds == 1 and self.record else seeds_interval(self.errors[key])

    def over_seeds(self, score: Score) -> Score:
        """Return a score with mean error, its interval and the mean truth of all seeds; as it was where these are not known."""
        key, is_bound = (score.observer, score.target, score.mode), score.observer in BOUNDS
        truth = next((float(of.mean()) for other, of in self.truths.items() if other[1:] == key[1:]), 0.0)
        if score.apart or not truth > 0 or not (is_bound or key in self.errors):
            return score
        error = score.rms if is_bound else float(self.errors[key].mean())
        interval = score.interval if is_bound else self.interval(key)
        return replace(score, rms=error, truth_rms=truth, normalised_rms=error / truth, interval=interval)

    def ranking(self, target: str, mode: str) -> list[str]:
        """Return the observers that can be best, the smallest mean error first."""
        means = {name: float(x.mean()) for (name, *of), x in self.errors.items() if of == [target, mode]}
        return rank_observers({name: x for name, x in means.items() if can_be_best(name, False) and name != NO_ESTIMATE})

    def leaders(self, target: str, mode: str) -> tuple[str, ...]:
        """Return the observer with the smallest mean error, and all whose errors do not differ significantly from its own."""
        ranked = self.ranking(target, mode)
        if not ranked or 1 < self.n_seeds < FEWEST:
            return ()
        mean = np.array([self.errors[name, target, mode].mean() for name in ranked])
        worse = self._differ(ranked, target, mode, False)[0] & (mean > mean[0] * (1.0 + SAME))
        return tuple(name for name, is_worse in zip(ranked, worse, strict=True) if not is_worse)

    def harmful(self, target: str, mode: str) -> dict[str, bool]:
        """Return the observers whose mean error is not below that of no estimate, the worst first, and if significantly above."""
        ranked = self.ranking(target, mode)
        if not ranked:
            return {}
        apart = self._differ(ranked, target, mode, True)[-1].tolist()
        known = {name: (name, target, mode) for name in reversed(ranked)}
        return {
            name: apart[ranked.index(name)] for name, key in known.items() if self.errors[key].mean() >= self.truths[key].mean()
        }

    def _differ(self, names: Sequence[str], target: str, mode: str, with_truth: bool) -> NDArray[np.bool_]:
        """Return which errors of observers, and the truth after them, differ significantly: over the seeds, or in pieces."""
        keys = [(name, target, mode) for name in names]
        columns = [*(self.errors[key] for key in keys), self.truths[keys[0]]]
        if self.n_seeds == 1:
            pieces = [np.array(self.record[key].pieces).reshape(-1, 2).T for key in keys]
            columns = [*(error for error, _ in pieces), pieces[0][1]]
        columns = columns[: len(keys) + with_truth]
        if self.n_seeds == 1 and min(of.size for of in columns) < 3:
            return np.zeros((len(columns), len(columns)), dtype=bool)
        return means_differ(np.column_stack(columns), self.n_seeds == 1)


def means_differ(values: Array, in_order: bool = False) -> NDArray[np.bool_]:
    """Return which columns of positive values (n, k) differ significantly in their means, bool (k, k): `pairs_differ`.

    The logarithm of the ratio of two means has the variance of the mean of their influences, value / mean (the delta method).

    values : rows are seeds, or with `in_order` pieces of one record, which may be correlated
    """
    one, other = all_pairs(values.shape[1])
    mean = np.maximum(values.mean(axis=0), np.finfo(float).tiny)
    influence = values[:, other] / mean[other] - values[:, one] / mean[one]
    _, error, freedom = scatter_of_mean(influence, independent=not in_order)
    return pairs_differ(t_probability(np.log(mean[other] / mean[one]), error, freedom))


def seeds_interval(errors: Array) -> tuple[float, float] | None:
    """Return the interval that has the mean of values (n_seeds,) over all records, by Student's t; None of too few."""
    if errors.size < FEWEST:
        return None
    reach = float(stdtrit(errors.size - 1, 1.0 - LEVEL / 2.0) * errors.std(ddof=1) / sqrt(errors.size))
    return max(float(errors.mean()) - reach, 0.0), float(errors.mean()) + reach


def rank_observers(errors: Mapping[str, float]) -> list[str]:
    """Order observers by their errors, the smallest first; of those that are the SAME as the smallest the first in the tables.

    >>> rank_observers({"gp-both": 15.10, "kf-lgs": 40.0, "multirate-multi": 15.11})
    ['multirate-multi', 'gp-both', 'kf-lgs']
    """
    ranked = sorted(errors, key=errors.__getitem__)
    same = [name for name in OBSERVERS if name in errors and errors[name] <= errors[ranked[0]] * (1.0 + SAME)]
    return [*same[:1], *(name for name in ranked if name not in same[:1])]


def marks_of(errors: Mapping[str, tuple[float, bool]], leaders: Sequence[str]) -> dict[str, str]:
    """Mark the best, which differs significantly from all others over the seeds, those equal to it, or the smallest alone.

    Equal are errors that do not differ significantly and by no more than a share of EQUAL, as in the verdict.

    errors : observer -> error [um], and whether it stands apart, on samples of its own
    leaders : from `Evidence.leaders`; empty for one record
    Returns observer -> "best", "tied" or "smallest".
    """
    rivals = {name: rms for name, (rms, apart) in errors.items() if can_be_best(name, apart)}
    first = rank_observers(rivals)[:1]
    equal = [name for name in leaders if name in rivals and rivals[name] <= (1.0 + EQUAL) * rivals[first[0]]]
    if len(equal) > 1:
        return dict.fromkeys(equal, "tied")
    return dict.fromkeys(first, "best" if len(leaders) == 1 else "smallest")


def gather_evidence(seeds: Sequence[Iterable[Score]]) -> Evidence:
    """Gather the scores of several seeds, one sequence each: of rows that all of them have and that can be compared."""
    known = [{(s.observer, s.target, s.mode): s for s in scores if not s.apart and s.observer not in BOUNDS} for scores in seeds]
    keys = [key for key in known[0] if all(key in of for of in known)] if known else []
    errors, truths = ({key: np.array([getattr(of[key], name) for of in known]) for key in keys} for name in ("rms", "truth_rms"))
    return Evidence(errors, truths, len(known), {key: known[0][key] for key in keys})


def columns_differ(values: Array, level: float = LEVEL) -> Array:
    """Return which columns of values (n, k) differ significantly in their means, bool (k, k).

    Rows are of the same records: paired t-tests of all pairs of columns, and `holm`. NaN where a column has no result.

    >>> columns_differ(np.array([[10.0, 10.5, 11.0], [12.0, 12.4, 11.0], [11.0, 11.5, 11.5]])).astype(int)
    array([[0, 1, 0],
           [1, 0, 0],
           [0, 0, 0]])
    """
    one, other = all_pairs(values.shape[1])
    difference = np.ma.masked_invalid(values[:, other] - values[:, one])
    n = difference.count(axis=0)
    mean = np.where(n > 1, difference.mean(axis=0).filled(0.0), 0.0)
    error = difference.std(axis=0, ddof=1).filled(0.0) / np.sqrt(np.maximum(n, 1))
    return pairs_differ(t_probability(mean, error, np.maximum(n - 1.0, 1.0)), level)


def all_pairs(k: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and the second of every pair of k things."""
    return np.triu_indices(k, 1)


def t_probability(mean: Array, error: Array, freedom: Array) -> Array:
    """Return the probability of as large a mean, by chance, of what is zero; error : its standard deviation, estimated."""
    t = np.divide(np.abs(mean), error, out=np.where(mean != 0, np.inf, 0.0), where=error > 0)
    return 2.0 * stdtr(freedom, -t)


def pairs_differ(p: Array, level: float = LEVEL) -> Array:
    """Return which of k things differ, bool (k, k), by the probabilities of `all_pairs` and Holm's correction."""
    k = round(0.5 + sqrt(0.25 + 2.0 * p.size))
    out = np.zeros((k, k), dtype=bool)
    out[all_pairs(k)] = holm(p, level)
    return out | out.T


def holm(p: Array, level: float = LEVEL) -> Array:
    """Return which of many tests are significant: any of those without an effect is in at most `level` of cases.

    S. Holm, Scand. J. Statist. 6 (1979) 65.

    >>> holm(np.array([0.03, 0.01, 0.02]))
    array([ True,  True,  True])
    >>> holm(np.array([0.04, 0.01, 0.03]))
    array([False,  True, False])
    """
    order, out = np.argsort(p, kind="stable"), np.zeros(p.size, dtype=bool)
    out[order] = np.logical_and.accumulate(p[order] <= level / np.arange(p.size, 0, -1))
    return out
