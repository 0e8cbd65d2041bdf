"""Tuning: the settings of an observer, or of a controller, that are best on what it is not scored on in the end.

On an uncertain plant a controller is tuned for the least residual at the worst of its plants, or below which 95 % of them are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import inf, isfinite, nan
from typing import TYPE_CHECKING, Any, Literal

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
from wfsobs.closed_loop.run import label
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.result import row_label
from wfsobs.notebook import import_extra
from wfsobs.pipeline import as_stated
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import add_comments, changed_settings, to_toml
from wfsobs.settings.values import SettingError, check_kind
from wfsobs.simulation.true_spectra import TrueSpectra
from wfsobs.tuning.records import DESIGN, MEASURES, P95, TRUTH, WORST, cut_record, simulate_records, space, stream
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
    check_kind("tune", scenario, Scenario)
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


Rows = list[tuple[str, str, float | str | None, float | str | None]]
"""(section, name, before, after)."""

SETTING, VALIDATION, TEST, OTHER, LIKELIHOOD = "setting", "validation", "test", "other target", "likelihood"

TOGETHER = "rms over modes"


def tuning_dict(result: TuningResult) -> dict[str, Any]:
    """Return the output of `wfsobs tune --json`.

    Errors in um, null where the observer failed; likelihoods in nats, null where there is no GPR. Of a controller, `envelope` has
    what it leaves of the plants of the search and of others, null where it is not stable.
    """

    def stage(s: Stage) -> dict[str, Any]:
        return {
            "validation_rms_um": s.validation and s.validation.rms,
            "validation_um": s.validation and dict(s.validation.modes),
            "test_rms_um": s.test and s.test.rms,
            "test_um": s.test and dict(s.test.modes),
            "other_target_test_um": s.other and dict(s.other.modes),
            "log_marginal_likelihood": s.likelihood and list(s.likelihood),
            "envelope": s.spreads and dict(zip(("searched", "others"), map(_spread, s.spreads), strict=True)),
        }

    return {
        "controller" if result.after.spreads else "observer": result.observer,
        "target": result.target,
        "against": result.against,
        "settings": changed_settings(result.scenario, result.before.scenario),
        "start": result.start,
        "before": stage(result.before),
        "after": stage(result.after),
        "evaluations": [
            {"settings": e.changes, "rms_um": e.errors and e.errors.rms, "reason": e.reason or None} for e in result.history
        ],
    }


def _spread(of: Spread) -> dict[str, Any]:
    left = {f"{name}_um": getattr(of, name) for name in ("nominal", "p95", "worst")}
    known = {name: x.tolist() if np.isfinite(x).all() else None for name, x in left.items()}
    return {**known, "unstable": of.unstable, "plants": len(of.points)}


def settings(result: TuningResult) -> list[tuple[str, str, str]]:
    """(dotted path, before, after) of every setting that was searched or set by hand."""
    changed = [path for path in changed_settings(result.scenario, result.before.scenario) if path not in result.start]
    before = {path: _before(result, path) for path in (*changed, *result.start)}
    if result.scenario == result.before.scenario:
        return [(path, text, text) for path, text in before.items()]
    return [(path, text, _format(result.scenario.lookup(path))) for path, text in before.items()]


def _before(result: TuningResult, path: str) -> str:
    return _format(result.start.get(path, result.before.scenario.lookup(path)))


def _scores(result: TuningResult) -> list[tuple[str, Errors | None, Errors | None]]:
    """(section, before, after) of either record."""
    return [(name, getattr(result.before, name), getattr(result.after, name)) for name in (VALIDATION, TEST)]


def _format(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def nm(rms: float) -> str:
    """Format an error in [nm], to two digits."""
    return f"{rms * 1e3:.2f}"


def tuning_remarks(result: TuningResult) -> list[str]:
    """Return one line on each fact that is not in the tables."""
    out = [] if result.against in (TRUTH, WORST, P95) else [f"compared with {result.against}, no truth being known"]
    known = [s.likelihood for s in (result.before, result.after)]
    if all(known):
        text = " -> ".join(", ".join(f"{x:.1f}" for x in values) for values in known if values)
        out.append(f"log marginal likelihood of the training targets (information only), per mode: {text}")
    if result.scenario == result.before.scenario:
        out.append("nothing that was tried is better than the settings as they were")
    failed = [e for e in result.history if not e.errors]
    if failed:
        out.append(f"{len(failed)} of {len(result.history)} evaluations failed, the last of them: {failed[-1].reason}")
    return out


def tuning_toml(result: TuningResult) -> str:
    """Return the tuned scenario as TOML, with the former values beside changed settings."""
    base = result.before.scenario
    notes = {
        path: f"{'tuned' if path in result.paths else 'with it'}, {_before(result, path)} before"
        for path in changed_settings(result.scenario, base)
    }
    evaluations, where = len(result.history), "at" if result.after.spreads else "against"
    head = [
        f"{result.label} tuned for {result.target}, {where} {result.against}, in {evaluations} evaluations.",
        *(f"{result.measure}, {name}: {_of(before)} before, {_of(after)} after" for name, before, after in _scores(result)),
    ]
    return "\n".join(f"# {line}" for line in head) + "\n\n" + add_comments(to_toml(result.scenario), notes)


def _of(errors: Errors | None) -> str:
    return f"{nm(errors.rms)} nm" if errors else "fails"


def best_so_far(history: Sequence[Evaluation]) -> list[float]:
    """Compute the least error after every evaluation [um], infinite until one has succeeded."""
    return np.minimum.accumulate([evaluation.rms for evaluation in history]).tolist()


def tuning_rows(result: TuningResult) -> Rows:
    """List settings as text, errors [um] by mode and together, a GPR's log marginal likelihoods by mode; None for failures."""
    out: Rows = [(SETTING, *row) for row in settings(result)]
    stages = result.before, result.after
    for section, before, after in _scores(result):
        out += [(section, name, _error(before, name), _error(after, name)) for name in (*_mode_names(stages), TOGETHER)]
    if any(s.other for s in stages):
        before, after = stages
        out.append((OTHER, TOGETHER, _error(before.other, TOGETHER), _error(after.other, TOGETHER)))
    if any(s.likelihood for s in stages):
        values = [s.likelihood or (None,) * len(_mode_names(stages)) for s in stages]
        out += [(LIKELIHOOD, *row) for row in zip(_mode_names(stages), *values, strict=True)]
    return out


def _error(errors: Errors | None, name: str) -> float | None:
    return None if errors is None else errors.rms if name == TOGETHER else errors.modes[name]


def _mode_names(stages: Sequence[Stage]) -> tuple[str, ...]:
    return tuple(next(e.modes for s in stages for e in (s.validation, s.test) if e))
