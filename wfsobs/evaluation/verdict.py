"""What a table of errors says of a target: the best with each kind of prior knowledge, the limit, and who does harm and why."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.evaluation.budget import Budget, error_budget
from wfsobs.evaluation.evidence import Evidence, gather_evidence
from wfsobs.evaluation.known_lines import given_lines, is_near, prior_knowledge
from wfsobs.evaluation.rows import JOINT_BOUNDS, above_bound
from wfsobs.evaluation.scores import BOUND_BOTH, BOUNDS, PREDICTION, Score
from wfsobs.evaluation.verdict_words import verdict_sentences
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
    from wfsobs.evaluation.result import Result


@dataclass(frozen=True)
class Contender:
    """An observer that can be the best.

    rms, interval : mean of its error over the seeds, or its error on the record, and the interval of that [um]
    is_tie        : whether the error does not differ significantly from the smallest
    knowledge     : of `prior_knowledge`
    n_peaks       : peaks in its model: of those of the vibration where they are known
    limit         : the least error possible [um], and of which row of BOUNDS; None where it is not known
    label         : what it is called, where it is a controller
    """

    observer: str
    rms: float
    interval: tuple[float, float] | None
    is_tie: bool
    knowledge: str
    n_peaks: int
    limit: tuple[float, str] | None = None
    label: str = ""

    @property
    def above_limit(self) -> float | None:
        """By which share the error is above the limit: 0 where its interval has the limit in it."""
        return above_bound(self.rms, self.interval, self.limit[0] if self.limit else None)


@dataclass(frozen=True)
class Harm:
    """An observer whose error is as large as the disturbance itself, or larger.

    worse               : whether it is significantly larger
    at_known, at_others : shares of its error's variance at the lines that it is told, and at those that it is not
    cause, share        : largest term of its error budget, and its part of the whole; empty where the budget is not known
    """

    place: Contender
    worse: bool
    at_known: float
    at_others: float
    cause: str = ""
    share: float = 0.0

    @property
    def observer(self) -> str:
        """Whose it is."""
        return self.place.observer


@dataclass(frozen=True)
class Verdict:
    """What the scores of one target and mode amount to.

    places : observers that can be the best, the smallest error first
    lines  : how many lines the vibration has; 0 where that is not known
    harms  : observers that are worse than no estimate, the worst first
    seeds  : over how many records of the scenario
    """

    target: str
    mode: str
    places: tuple[Contender, ...]
    lines: int
    harms: tuple[Harm, ...]
    seeds: int = 1

    @property
    def best(self) -> Contender:
        """The one with the smallest error."""
        return self.places[0]

    @property
    def ties(self) -> tuple[str, ...]:
        """Observers whose error is larger, but not significantly so."""
        return tuple(place.observer for place in self.places[1:] if place.is_tie)

    def best_with(self, *knowledge: str) -> Contender | None:
        """Return the best of those with these kinds of prior knowledge (`prior_knowledge`); None where there is none."""
        return next((place for place in self.places if place.knowledge in knowledge), None)

    def sentences(self, scale: float = 1e3, unit: str = "nm") -> list[str]:
        """Return the verdict in words; scale: from micrometres to the unit."""
        return verdict_sentences(self, scale, unit)


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

    Of a record without truth the target PREDICTION has one: on errors of predicting the next measurement.

    scenario   : what the observers' priors were made from
    simulation : what the record was made from, so that the lines of the vibration are known
    evidence   : errors over several seeds, on which the verdict then rests; where the errors lie is that of the record
    budgets    : error budgets of the record, from which it is said why an observer does harm (`explain_harm`)
    """
    found, truth = evidence or gather_evidence([scores]), None if target == PREDICTION else record.truth(target)
    ranked = found.ranking(target, mode)
    if not ranked or (truth is None and target != PREDICTION) or not found.truths[ranked[0], target, mode].mean() > 0:
        return None
    column = [m.name for m in scenario.modes].index(mode)
    lines = () if simulation is None else tuple(line[0] for line in vibration_lines(simulation, column))
    of = {s.observer: s for s in scores if (s.target, s.mode) == (target, mode)}
    places = {place.observer: place for place in contenders(scenario, found, scores, target, mode, lines)}
    given = {name: given_lines(scenario, name, column) for name in ranked}
    causes = {b.observer: _largest_term(b) for b in budgets if (b.target, b.mode) == (target, mode) and b.terms}
    values = {e.observer: e.values[:, column] for e in estimates if e.target == target}
    harms = (
        ()
        if truth is None
        else (
            Harm(
                places[name],
                worse,
                *_shares(_keep_scored(record, values[name] - truth[:, column], of[name]), record.dt, lines, given[name]),
                *causes.get(name, ("", 0.0)),
            )
            for name, worse in found.harmful(target, mode).items()
        )
    )
    return Verdict(target, mode, tuple(places.values()), len(lines), tuple(harms), found.n_seeds)


def contenders(
    scenario: Scenario, evidence: Evidence, scores: Iterable[Score], target: str, mode: str, lines: Sequence[float] = ()
) -> tuple[Contender, ...]:
    """Return the observers that can be the best, the smallest error first.

    scores : of one record, which have the bounds;  lines : frequencies of the vibration [Hz], empty where they are not known
    """
    column = [m.name for m in scenario.modes].index(mode)
    bounds = {s.observer: s.rms for s in scores if (s.target, s.mode) == (target, mode) and s.observer in BOUNDS}
    leaders, out = evidence.leaders(target, mode), []
    for name in evidence.ranking(target, mode):
        given, bound = given_lines(scenario, name, column), JOINT_BOUNDS.get(name, BOUND_BOTH)
        n_peaks = min(int(is_near(np.array(lines), given).sum()), len(given)) if lines else len(given)
        mean, interval = float(evidence.errors[name, target, mode].mean()), evidence.interval((name, target, mode))
        limit = (bounds[bound], bound) if bound in bounds else None
        out.append(Contender(name, mean, interval, name in leaders, prior_knowledge(name), n_peaks, limit))
    return tuple(out)


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
