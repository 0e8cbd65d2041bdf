"""Tuning: the settings of an observer that are best on a record which is neither the training nor the test record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite

from wfsobs.pipeline import as_stated
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError
from wfsobs.tuning.records import DESIGN, MEASURES, cut_record, simulate_records, stream
from wfsobs.tuning.space import space
from wfsobs.tuning.trials import Evaluation, Judge, Stage, Trials, minimise, target_of

EVALUATIONS = 40


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
    trials = Trials(scenario, searched, records, Judge(observer, records.target), evaluations, watch, on_evaluation)
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
