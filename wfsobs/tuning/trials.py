"""Runs of an observer with trial settings on a validation record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

from wfsobs.evaluation.scores import PREDICTION
from wfsobs.observers import OBSERVERS
from wfsobs.progress import Watch
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.tuning.judge import Errors, Judge
from wfsobs.tuning.likelihood import likelihood
from wfsobs.tuning.records import Records
from wfsobs.tuning.search import NoEvaluationLeft
from wfsobs.tuning.space import Space
from wfsobs.typing import Array

LEARNING, LATEST = 0.25, 0.5
"""Part of the validation record that counts for nothing, so that slow starters are compared with others on the same steps; and
part by which the scores begin at the latest."""


@dataclass(frozen=True)
class Evaluation:
    """Settings that were tried on the validation record.

    changes : dotted path -> value, on top of the scenario; nothing for the scenario itself
    errors  : per mode, or None where the observer failed, with the reason in one line
    """

    changes: dict[str, Any]
    errors: Errors | None
    reason: str = ""

    @property
    def rms(self) -> float:
        """What is made as small as possible [um]: root of the mean square over the modes, infinite for a failure."""
        return self.errors.rms if self.errors else inf


@dataclass(frozen=True)
class Stage:
    """An observer before or after tuning.

    validation, test : its errors on either record, None where it fails
    other            : on the test record, its errors in the target that it was not tuned for, if it has another
    likelihood       : of a GPR, the log marginal likelihood of its training targets, a number per mode
    """

    scenario: Scenario
    validation: Errors | None
    test: Errors | None
    other: Errors | None
    likelihood: tuple[float, ...] | None


@dataclass
class Trials:
    """Runs of the observer on the validation record, each once."""

    scenario: Scenario
    space: Space
    records: Records
    judge: Judge
    most: int
    watch: Watch
    on_evaluation: Callable[[Evaluation], None] | None
    history: list[Evaluation] = field(default_factory=list)
    errors: dict[tuple[Any, ...], float] = field(default_factory=dict)
    warm_up: float = field(init=False)

    def __post_init__(self) -> None:
        record = self.records.validation
        self.warm_up = max(self.scenario.run.warm_up, LEARNING * record.n_steps * record.dt)

    def at(self, point: Array) -> float:
        """Return the error at a point of the unit cube. Raises NoEvaluationLeft where evaluations are used up, Cancelled."""
        changes = self.space.changes(point)
        key = tuple(changes.values())
        if not self.space.by_hand and changes == self.space.values(self.scenario):
            self.errors[key] = self.history[0].rms  # the scenario itself
        if key not in self.errors:
            if len(self.history) >= self.most:
                raise NoEvaluationLeft
            self.errors[key] = self.run(changes).rms
        return self.errors[key]

    def run(self, changes: dict[str, Any]) -> Evaluation:
        """One evaluation; scores begin where the first has its estimates, if that is later. Raises Cancelled."""
        errors, reason = None, ""
        try:
            errors = self._errors(self.scenario.replace(changes))
        except ValueError as error:
            reason = str(error)
        done = Evaluation(changes, errors, reason)
        self.history.append(done)
        if self.on_evaluation:
            self.on_evaluation(done)
        return done

    def _errors(self, scenario: Scenario) -> Errors:
        record = self.records.validation
        estimates = self.judge.estimates(record, scenario, self._inner())
        begins = self.judge.begins(estimates) * record.dt
        if not self.history and begins <= LATEST * record.n_steps * record.dt:
            self.warm_up = max(self.warm_up, begins)
        if begins > self.warm_up:
            raise RecordError(
                f"{self.judge.observer} has its first estimate after {begins:g} s; the scores begin at {self.warm_up:g} s"
            )
        return self.judge.errors(record, scenario, estimates, self.warm_up)

    def stage(self, evaluation: Evaluation) -> Stage:
        """Score the scenario of an evaluation on the test record."""
        scenario = self.scenario.replace(evaluation.changes)
        record, judge, errors, other = self.records.test(scenario), self.judge, None, None
        others = {*OBSERVERS[judge.observer].targets} - {judge.target} if judge.target != PREDICTION else set[str]()
        try:
            estimates = judge.estimates(record, scenario, self._inner())
            errors = judge.errors(record, scenario, estimates, scenario.run.warm_up)
            for target in others:
                other = replace(judge, target=target).errors(record, scenario, estimates, scenario.run.warm_up)
        except ValueError:
            pass  # of the scenario as it was: the reason is in the history
        return Stage(scenario, evaluation.errors, errors, other, likelihood(judge.observer, record, scenario, self.watch))

    def _inner(self) -> Watch:
        """Return the watch of one run, a part of the whole progress."""
        done, all_of_it = len(self.history), self.most + 2
        return Watch(lambda f: self.watch.progress((done + f) / all_of_it), self.watch.is_cancelled)
