"""Tuning: the settings of an observer, or of a controller, that are best on what it is not scored on in the end.

On an uncertain plant a controller is tuned for the least residual at the worst of its plants, or below which 95 % of them are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import inf, isfinite, nan
from typing import TYPE_CHECKING, Literal

import numpy as np

from wfsobs.closed_loop.envelope import (
    POINTS,
    PlantEnvelope,
    Plants,
    Spread,
    Uncertainty,
    known_spectra,
    plant_envelope,
    spread_of,
    uncertain_plants,
    with_laws,
)
from wfsobs.closed_loop.rows import label
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.rows import row_label
from wfsobs.notebook import import_extra
from wfsobs.pipeline import as_stated
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError
from wfsobs.simulation.true_spectra import TrueSpectra
from wfsobs.tuning.records import DESIGN, MEASURES, P95, WORST, cut_record, simulate_records, space, stream
from wfsobs.tuning.trials import Errors, Evaluation, RecordTrials, Stage, Trials, minimise, target_of

if TYPE_CHECKING:
    import pandas


EVALUATIONS = 40


@dataclass(frozen=True)
class TuningResult:
    """What a tuning gives.

    observer : its id, or that of a controller
    target  : what the errors are those of: "turbulence", "vibration", "next z" where there is no truth, or "residual"
    against : what stood for the truth, in words; of a controller the plants
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
    def label(self) -> str:
        """The label of the observer or controller."""
        return (row_label if self.after.spreads is None else label)(self.observer)

    @property
    def measure(self) -> str:
        """What the numbers are, in words."""
        return MEASURES[self.against]

    @property
    def best(self) -> Evaluation:
        """The evaluation with the smallest error, the earliest of equals."""
        return min(self.history, key=lambda e: e.rms)

    def to_dataframe(self) -> pandas.DataFrame:
        """Return `history` as a pandas table: a row per evaluation, NaN for what stayed as it was and for failures.

        Raises ImportError without pandas.
        """
        rows = [{**e.changes, "rms_um": e.rms if e.errors else nan, "reason": e.reason} for e in self.history]
        return import_extra("pandas", "arrays").DataFrame(rows)


def tune(
    scenario: Scenario,
    observer: str,
    names: Sequence[str] | None = None,
    *,
    evaluations: int = EVALUATIONS,
    record: Record | None = None,
    target: str | None = None,
    validation: float | None = None,
    envelope: EnvelopeGoal | None = None,
    on_evaluation: Callable[[Evaluation], None] | None = None,
    watch: Watch = QUIET,
) -> TuningResult:
    """Search for the settings of an observer with the minimum error on a validation record, or of a controller on an envelope.

    The test record, or plants that the search has not seen, are scored after that.

    Parameters
    ----------
    scenario : Scenario
        Settings to start from.
    observer : str
        Id of the observer; with `envelope`, of the controller.
    names : sequence of str, optional
        Dotted paths of the settings; by default the observer's usual ones.
    evaluations : int
        Maximum runs of the observer on the validation record, or designs of the controller; repeated settings cost none.
    record : Record, optional
        Telemetry, cut into pieces; by default the records are simulated.
    target : {"turbulence", "vibration"}, optional
        Target of the errors; by default vibration where the observer estimates it.
    validation : float, optional
        Length of the simulated validation record [s]; by default that of the scenario.
    envelope : EnvelopeGoal, optional
        Tune a linear controller for an uncertain plant, by theory, without a record: what for.
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
    wfsobs.plant_envelope : What controllers with given settings leave over an uncertain plant.
    """
    if evaluations < 1:
        raise SettingError(f"evaluations = {evaluations}: takes a whole number from 1")
    if envelope is not None:
        if not (record is None and target is None and validation is None):
            raise SettingError("envelope: is by theory, and takes no record, target or validation")
        scenario.validate()
        of_plants = space(scenario, observer, names, CONTROLLERS)
        trials = EnvelopeTrials(scenario, of_plants, evaluations, watch, on_evaluation, observer, envelope)
        return _search(trials, observer, "residual", WORST if envelope.by == "worst" else P95)
    if record is not None:
        scenario = as_stated(record, scenario)
    scenario.validate()
    searched, target = space(scenario, observer, names), target_of(observer, target)
    if record is None:
        records = simulate_records(scenario, searched, target, validation, watch)
    else:
        records = cut_record(record, scenario, observer, target)
    trials = RecordTrials(scenario, searched, evaluations, watch, on_evaluation, records, observer)
    return _search(trials, observer, records.target, records.against)


def _search(trials: Trials, observer: str, target: str, against: str) -> TuningResult:
    scenario, searched = trials.scenario, trials.space
    trials.run({})
    minimise(trials.at, searched.start(scenario), trials.most, stream(scenario, DESIGN))
    first, best = trials.history[0], min(trials.history, key=lambda e: e.rms)
    if not isfinite(best.rms):
        raise RecordError(first.reason)
    before, after = (trials.stage(e) for e in (first, best))
    trials.watch.step(1.0)
    start = {path: v for path, v in {**searched.by_hand, **searched.values(scenario)}.items() if not isinstance(v, str)}
    paths = tuple(a.path for a in searched.axes)
    return TuningResult(observer, target, against, paths, start, before, after, tuple(trials.history))


CAUTION_EVALUATIONS = 20
"""Designs of each controller in `tuned_envelope`."""


def tuned_envelope(
    scenario: Scenario,
    *,
    controllers: Sequence[str] | None = None,
    goal: EnvelopeGoal | None = None,
    points: int = POINTS,
    watch: Watch = QUIET,
) -> PlantEnvelope:
    """Return `plant_envelope` of controllers each tuned by `tune`, by its usual settings. Raises SettingError, Cancelled."""
    goal = goal or EnvelopeGoal()
    names, parts = with_laws(controllers), list[PlantEnvelope]()
    for i, name in enumerate(names):
        inner, tuned = Watch(is_cancelled=watch.is_cancelled), scenario
        if CONTROLLERS[name].tunable.usual:
            with suppress(RecordError):  # nothing that was tried is stable at every plant
                tuned = tune(scenario, name, envelope=goal, evaluations=CAUTION_EVALUATIONS, watch=inner).scenario
        parts.append(plant_envelope(tuned, controllers=[name], uncertainty=goal.uncertainty, points=points, watch=inner))
        watch.step((i + 1) / len(names))
    spreads, notes = sum((part.spreads for part in parts), ()), {k: x for part in parts for k, x in part.notes.items()}
    return replace(parts[0], scenario=scenario, spreads=spreads, notes=notes)


SEARCHED, HELD_OUT = 64, 256
"""Points of the envelope that the search sees, beside all corners, and others that the result is scored on."""


@dataclass(frozen=True)
class EnvelopeGoal:
    """What a controller is tuned for on an uncertain plant.

    Attributes
    ----------
    uncertainty : Uncertainty
        Largest errors of the plant.
    by : {"worst", "p95"}
        Residual that is made small: at the worst of points and corners, or the 95 % quantile of the points.
    loss : float
        How much more the controller may leave at the nominal plant than with the settings before.
    """

    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    by: Literal["worst", "p95"] = "worst"
    loss: float = 0.1


@dataclass
class EnvelopeTrials(Trials):
    """What a controller leaves of some plants with trial settings."""

    controller: str
    goal: EnvelopeGoal
    most_nominal: float = field(default=inf, init=False)
    spectra: list[TrueSpectra] = field(init=False)
    search_plants: Plants = field(init=False)
    other_plants: Plants = field(init=False)

    def __post_init__(self) -> None:
        self.spectra = known_spectra(self.scenario)
        _, _, plants = uncertain_plants(self.scenario, self.goal.uncertainty, SEARCHED + HELD_OUT)
        self.search_plants = replace(plants, points=plants.points[:SEARCHED])
        self.other_plants = replace(plants, points=plants.points[SEARCHED:], corners=())

    def errors_of(self, scenario: Scenario) -> Errors:
        """Return the residuals that count, of the plants of the search."""
        spread = self._spread(scenario, self.search_plants)
        nominal = float(np.sqrt(np.mean(spread.nominal**2)))
        if not self.history:
            self.most_nominal = (1.0 + self.goal.loss) * nominal
        if nominal > self.most_nominal or not isfinite(nominal):
            raise ValueError(f"{1e3 * nominal:.2f} nm at the nominal plant, above {1e3 * self.most_nominal:.2f}")
        errors = self._errors(spread)
        if not isfinite(errors.rms):
            raise ValueError("not stable at every plant")
        return errors

    def stage(self, evaluation: Evaluation) -> Stage:
        """Return the controller on plants that the search has not seen."""
        scenario = self.scenario.replace(evaluation.changes)
        seen, held_out = (self._spread(scenario, plants) for plants in (self.search_plants, self.other_plants))
        errors = self._errors(held_out)
        return Stage(scenario, evaluation.errors, errors if isfinite(errors.rms) else None, spreads=(seen, held_out))

    def _spread(self, scenario: Scenario, plants: Plants) -> Spread:
        scenario.validate()
        watch = self.inner()
        watch.check()
        spread = spread_of(self.controller, scenario, plants, self.spectra, watch)
        watch.step(1.0)
        return spread

    def _errors(self, spread: Spread) -> Errors:
        left = spread.worst if self.goal.by == "worst" else spread.p95
        return Errors({mode.name: float(x) for mode, x in zip(self.scenario.modes, left, strict=True)})
