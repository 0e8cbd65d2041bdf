"""What a table of errors says, in one or two sentences per target: who is best, by how much, and who does harm and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import t as student

from wfsobs.evaluation.budget import Budget, error_budget
from wfsobs.evaluation.evidence import LEVEL, Evidence, differ_in_pairs, rank_observers
from wfsobs.evaluation.known_lines import given_lines, is_near
from wfsobs.evaluation.rows import NO_ESTIMATE, can_be_best
from wfsobs.evaluation.scores import BOUNDS, Score
from wfsobs.evaluation.verdict_words import best_sentence, harm_sentences
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.observers.estimates import Estimate
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.signal.welch import welch_psd
from wfsobs.simulation.disturbance import vibration_lines
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.result import Result

BATCHES = 20
"""Pieces of the record whose mean squared errors are compared."""


@dataclass(frozen=True)
class Harm:
    """An observer whose error is as large as the disturbance itself, or larger.

    worse               : whether it is significantly larger
    at_known, at_others : shares of its error's variance at the lines that it is told, and at those that it is not
    cause, share        : largest term of its error budget, and its part of the whole; empty where the budget is not known
    """

    observer: str
    worse: bool
    at_known: float
    at_others: float
    cause: str = ""
    share: float = 0.0


@dataclass(frozen=True)
class Verdict:
    """What the scores of one target and mode amount to.

    best  : the score with the least error of those that can be compared
    ties  : observers whose error is larger, but not significantly so on this record
    bounds : row -> the least error possible [um], of the rows of the table
    lines : how many lines the vibration has
    harms : observers that are worse than no estimate, the worst first
    seeds : over how many records of the scenario, whose mean error is that of `best`
    """

    best: Score
    ties: tuple[str, ...]
    bounds: Mapping[str, float]
    lines: int
    harms: tuple[Harm, ...]
    seeds: int = 1

    def sentences(self, scale: float = 1e3, unit: str = "nm") -> list[str]:
        """Return the verdict in words; scale: from micrometres to the unit."""
        return [best_sentence(self, scale, unit), *harm_sentences(self)]


def verdict(
    scenario: Scenario,
    record: Record,
    estimates: Sequence[Estimate],
    scores: Sequence[Score],
    target: str,
    mode: str,
    *,
    simulation: Scenario | None = None,
    evidence: Evidence | None = None,
    budgets: Sequence[Budget] = (),
) -> Verdict | None:
    """Return the verdict on one target and mode, None where nothing can be compared or there is no truth.

    scenario   : what the observers' priors were made from
    simulation : what the record was made from, so that the lines of the vibration are known
    evidence   : errors over several seeds, on which the verdict then rests; where the errors lie is that of the record
    budgets    : error budgets of the record, from which it is said why an observer does harm (`explain_harm`)
    """
    of = [s for s in scores if (s.target, s.mode) == (target, mode)]
    rivals = {s.observer: s for s in of if can_be_best(s.observer, s.apart) and s.observer != NO_ESTIMATE}
    ranked = [rivals[name] for name in rank_observers({name: s.rms for name, s in rivals.items()})]
    truth = record.truth(target)
    if not ranked or truth is None or not ranked[0].truth_rms > 0:
        return None
    column = [m.name for m in scenario.modes].index(mode)
    values = {e.observer: e.values[:, column] for e in estimates if e.target == target}
    errors = {s.observer: _keep_scored(record, values[s.observer] - truth[:, column], s) for s in ranked}
    lines = () if simulation is None else tuple(line[0] for line in vibration_lines(simulation, column))
    causes = {b.observer: _largest_term(b) for b in budgets if (b.target, b.mode) == (target, mode) and b.terms}
    first = ranked[0]
    found = Verdict(
        first,
        tuple(s.observer for s in ranked[1:] if not differs(errors[first.observer], errors[s.observer])),
        {s.observer: s.rms for s in of if s.observer in BOUNDS},
        len(lines),
        tuple(
            Harm(
                s.observer,
                differs(_keep_scored(record, truth[:, column], s), errors[s.observer]),
                *_shares(errors[s.observer], record.dt, lines, given_lines(scenario, s.observer, column, lines)),
                *causes.get(s.observer, ("", 0.0)),
            )
            for s in reversed(ranked)
            if s.rms >= s.truth_rms
        ),
    )
    return found if evidence is None else _over_seeds(found, evidence, {s.observer: s for s in ranked})


def _over_seeds(one: Verdict, evidence: Evidence, scores: dict[str, Score]) -> Verdict:
    """Return a verdict that rests on the errors of several seeds; as it was where they say nothing."""
    target, mode = one.best.target, one.best.mode
    leaders = evidence.leaders(target, mode)
    if not leaders or leaders[0] not in scores:
        return one
    keys = {harm: (harm.observer, target, mode) for harm in one.harms if (harm.observer, target, mode) in evidence.errors}
    errors, truths = evidence.errors, evidence.truths
    mean = evidence.mean((leaders[0], target, mode))
    assert mean is not None
    return replace(
        one,
        best=replace(scores[leaders[0]], rms=mean),
        ties=leaders[1:],
        harms=tuple(
            replace(harm, worse=differ_in_pairs(truths[key], errors[key]))
            for harm, key in keys.items()
            if errors[key].mean() >= truths[key].mean()
        ),
        seeds=evidence.n_seeds,
    )


def differs(one: Array, other: Array) -> bool:
    """Whether two errors (n,), step by step of one record, differ significantly in their mean squares.

    The difference of the squares is averaged over BATCHES pieces and compared with the scatter of their means by a t-test (batch
    means: Law and Kelton, Simulation Modeling and Analysis, ch. 9). Slow errors make neighbouring means alike, which counts as
    fewer of them, those of a first-order autoregression with their correlation. NaN where a step does not count.
    """
    difference = other**2 - one**2
    pieces = np.array_split(difference[~np.isnan(difference)], BATCHES)
    means = np.array([piece.mean() for piece in pieces if piece.size])
    deviation = means - means.mean() if means.size else means
    power = float(deviation @ deviation)
    if means.size < 3:
        return False
    if not power > 0:
        return bool(means[0] != 0.0)
    # The estimate of a correlation from n values is low by about 1 / n.
    alike = max(float(deviation[1:] @ deviation[:-1]) / power + 1.0 / means.size, 0.0)
    independent = max(means.size * (1.0 - alike) / (1.0 + alike), 2.0)
    scatter = means.std(ddof=1) / sqrt(independent)
    return bool(abs(means.mean()) > student.ppf(1.0 - LEVEL / 2.0, independent - 1.0) * scatter)


def _largest_term(budget: Budget) -> tuple[str, float]:
    """Return the largest term of an error budget, and its part of the total."""
    name = max(budget.terms, key=budget.terms.__getitem__)
    return name, budget.terms[name] / budget.total


def explain_harm(result: Result, mode: str | None = None, watch: Watch = QUIET) -> list[Budget]:
    """Return the error budgets of the observers that do harm, of those that are as fast as a Kalman filter.

    result : of a record that was simulated from its scenario; mode : by default all. Raises Cancelled.
    """
    of = [s for s in result.scores if s.target in TARGETS and mode in (None, s.mode)]
    harmful = {s.observer for s in of if s.rms >= s.truth_rms}
    chosen = [o.id for o in OBSERVERS.values() if o.id in harmful and o.linear and o.seconds is None]
    try:
        return error_budget(result, observers=chosen, mode=mode, watch=watch)
    except ValueError:
        return []


def _keep_scored(record: Record, error: Array, score: Score) -> Array:
    """Return a signal where it was scored, NaN elsewhere."""
    assert score.start is not None and score.stop is not None
    out = np.full_like(error, np.nan)
    scored = slice(round(score.start / record.dt), round(score.stop / record.dt))
    out[scored] = error[scored]
    return out


def _shares(error: Array, dt: float, lines: Sequence[float], given_lines: Sequence[float]) -> tuple[float, float]:
    """Shares of an error's variance at the lines [Hz] that an observer is given, and at the others."""
    frequency, density = welch_psd(error[~np.isnan(error)][:, None], dt)
    total = density.sum()
    if not total > 0:
        return 0.0, 0.0
    at_lines = is_near(frequency, lines)
    at_given = at_lines & is_near(frequency, given_lines)
    at_others = at_lines & ~at_given
    return float(density[at_given].sum() / total), float(density[at_others].sum() / total)
