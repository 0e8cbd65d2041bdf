"""What several seeds of a scenario say that one record cannot: intervals of errors, and differences that are significant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy.stats import t as student

from wfsobs.evaluation.rows import NO_ESTIMATE, can_be_best
from wfsobs.evaluation.scores import BOUNDS, Score
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
    """Errors over several seeds of a scenario.

    Attributes
    ----------
    errors, truths : mapping
        (observer, target, mode) -> rms error, and rms of the truth, of every seed, (n_seeds,) [um].
    n_seeds : int
        Number of seeds.
    """

    errors: Mapping[Key, Array]
    truths: Mapping[Key, Array]
    n_seeds: int

    def mean(self, key: Key) -> float | None:
        """Return the mean over the seeds of an rms error [um]; None where it is not known of all."""
        return float(self.errors[key].mean()) if key in self.errors else None

    def interval(self, key: Key) -> tuple[float, float] | None:
        """Return the interval that has the mean over all records in 95 % of cases [um]; None where it is not known."""
        if key not in self.errors or self.n_seeds < FEWEST:
            return None
        values = self.errors[key]
        reach = float(student.ppf(1.0 - LEVEL / 2.0, values.size - 1) * values.std(ddof=1) / sqrt(values.size))
        return max(float(values.mean()) - reach, 0.0), float(values.mean()) + reach

    def ranking(self, target: str, mode: str) -> list[str]:
        """Return the observers that can be best, the smallest mean error first."""
        of = [key for key in self.errors if key[1:] == (target, mode) and can_be_best(key[0], False) and key[0] != NO_ESTIMATE]
        return rank_observers({key[0]: float(self.errors[key].mean()) for key in of})

    def leaders(self, target: str, mode: str) -> tuple[str, ...]:
        """Return the observer with the smallest mean error, and all whose errors do not differ significantly from its own."""
        ranked = self.ranking(target, mode)
        if not ranked or self.n_seeds < FEWEST:
            return ()
        first = self.errors[ranked[0], target, mode]
        return (ranked[0], *(name for name in ranked[1:] if not differ_in_pairs(first, self.errors[name, target, mode])))


def rank_observers(errors: Mapping[str, float]) -> list[str]:
    """Order observers by their errors, the smallest first; of those that are the SAME as the smallest the first in the tables.

    >>> rank_observers({"gp-both": 15.10, "kf-lgs": 40.0, "multirate-multi": 15.11})
    ['multirate-multi', 'gp-both', 'kf-lgs']
    """
    ranked = sorted(errors, key=errors.__getitem__)
    same = [name for name in OBSERVERS if name in errors and errors[name] <= errors[ranked[0]] * (1.0 + SAME)]
    return [*same[:1], *(name for name in ranked if name not in same[:1])]


def gather_evidence(seeds: Sequence[Iterable[Score]]) -> Evidence:
    """Gather the scores of several seeds, one sequence each: of rows that all of them have and that can be compared."""
    known = [{(s.observer, s.target, s.mode): s for s in scores if not s.apart and s.observer not in BOUNDS} for scores in seeds]
    keys = [key for key in known[0] if all(key in of for of in known)] if known else []
    return Evidence(
        {key: np.array([of[key].rms for of in known]) for key in keys},
        {key: np.array([of[key].truth_rms for of in known]) for key in keys},
        len(known),
    )


def differ_in_pairs(one: Array, other: Array) -> bool:
    """Whether two sets of values (n,), pair by pair of the same records, differ significantly: a paired t-test.

    >>> differ_in_pairs(np.array([10.0, 12.0, 11.0]), np.array([10.5, 12.4, 11.5]))
    True
    >>> differ_in_pairs(np.array([10.0, 12.0, 11.0]), np.array([11.0, 11.0, 11.5]))
    False
    """
    difference = other - one
    scatter = float(difference.std(ddof=1)) / sqrt(difference.size)
    return bool(abs(difference.mean()) > student.ppf(1.0 - LEVEL / 2.0, difference.size - 1) * scatter)
