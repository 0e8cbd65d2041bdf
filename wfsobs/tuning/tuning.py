"""Tuning: the settings of an observer that are best on a record which is neither the training nor the test record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Any

from wfsobs.evaluation.scores import PREDICTION
from wfsobs.observers import OBSERVERS
from wfsobs.pipeline import as_stated
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError
from wfsobs.tuning.judge import Errors, Judge, target_of
from wfsobs.tuning.likelihood import likelihood
from wfsobs.tuning.records import DESIGN, MEASURES, Records, cut_record, simulate_records, stream
from wfsobs.tuning.search import NoEvaluationLeft, minimise
from wfsobs.tuning.space import Space, space
from wfsobs.typing import Array

EVALUATIONS = 40
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


@dataclass(frozen=True)
class TuningResult:
    """What a tuning gives.

    target  : what the errors are those of: "turbulence", "vibration", or "next z" where there is no truth
    against : what stood for the truth, in words
    paths   : the settings that were searched
    start   : dotted path -> number before, of these and of those set by hand with them; of matched ones what that stands for
    history : every evaluation in its order, the scenario as it was first
    """

    observer: str
    target: str
    against: str
    paths: tuple[str, ...]
    start: dict[str, float]
    before: Stage
    after: Stage
    history: tuple[Evaluation, ...]

    @property
    def scenario(self) -> Scenario:
        """The scenario with the tuned settings: the one before where nothing was better."""
        return self.after.scenario

    @property
    def measure(self) -> str:
        """What the numbers are, in words."""
        return MEASURES[self.against]

    @property
    def best(self) -> Evaluation:
        """The evaluation with the smallest error, the earliest of equals."""
        return min(self.history, key=lambda e: e.rms)


def tune(
    scenario: Scenario,
    observer: str,
    names: Sequence[str] | None = None,
    *,
    evaluations: int = EVALUATIONS,
    record: Record | None = None,
    target: str | None = None,
    validation: float | None = None,
    on_evaluation: Callable[[Evaluation], None] | None = None,
    watch: Watch = QUIET,
) -> TuningResult:
    """Search for the settings of an observer with the minimum error on a validation record.

    The test record is scored after that.

    Parameters
    ----------
    scenario : Scenario
        Settings to start from.
    observer : str
        Id of the observer.
    names : sequence of str, optional
        Dotted paths of the settings; by default the observer's usual ones.
    evaluations : int
        Maximum runs of the observer on the validation record; repeated settings cost none.
    record : Record, optional
        Telemetry, cut into pieces; by default the records are simulated.
    target : {"turbulence", "vibration"}, optional
        Target of the errors; by default vibration where the observer estimates it.
    validation : float, optional
        Length of the simulated validation record [s]; by default that of the scenario.
    on_evaluation : callable, optional
        Receives every evaluation as it is done: what remains of a tuning that is cancelled.
    watch : Watch, optional
        Receives the progress, and is asked at every block of work whether to stop.

    Returns
    -------
    TuningResult
        The observer before and after, with the history of the search.

    Raises
    ------
    SettingError
        A setting or the observer cannot be tuned.
    RecordError
        The observer has no estimate whatever its settings.
    Cancelled
        `watch` asks to stop.

    See Also
    --------
    wfsobs.run : Run observers with given settings.
    """
    if evaluations < 1:
        raise SettingError(f"evaluations = {evaluations}: takes a whole number from 1")
    if record is not None:
        scenario = as_stated(record, scenario)
    scenario.validate()
    searched, target = space(scenario, observer, names), target_of(observer, target)
    if record is None:
        records = simulate_records(scenario, searched, target, validation, watch)
    else:
        records = cut_record(record, scenario, observer, target)
    trials = _Trials(scenario, searched, records, Judge(observer, records.target), evaluations, watch, on_evaluation)
    trials.run({})
    minimise(trials.at, searched.start(scenario), evaluations, stream(scenario, DESIGN))
    first, best = trials.history[0], min(trials.history, key=lambda e: e.rms)
    if not isfinite(best.rms):
        raise RecordError(first.reason)
    before, after = (trials.stage(e) for e in (first, best))
    watch.step(1.0)
    start = {path: v for path, v in {**searched.by_hand, **searched.values(scenario)}.items() if not isinstance(v, str)}
    return TuningResult(
        observer,
        records.target,
        records.against,
        tuple(a.path for a in searched.axes),
        start,
        before,
        after,
        tuple(trials.history),
    )


@dataclass
class _Trials:
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
