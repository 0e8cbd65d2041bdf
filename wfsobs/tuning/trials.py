"""Runs of an observer with trial settings on a validation record.

Log marginal likelihood of a GPR's training targets: what Gaussian processes are usually tuned by, here as information.

    log p(f) = -1/2 f' C^-1 f - 1/2 log det C - m/2 log 2 pi,    C = K + sigma_n^2 I

With M of `gpr.windows`, C = (M + sigma_n^2 I) + s2 delta delta', a rank-one border: with a = f' N f, b = f' N delta,
c = delta' N delta, N = (M + sigma_n^2 I)^-1,

    f' C^-1 f = a - b^2 / (1 / s2 + c),    log det C = log det (M + sigma_n^2 I) + log(1 + s2 c).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Any

import numpy as np
import scipy
from scipy.optimize import minimize

from wfsobs.closed_loop.envelope import Spread
from wfsobs.evaluation.result import Failure
from wfsobs.evaluation.scores import PREDICTION, supervised_scores, unsupervised_scores
from wfsobs.execution import each_estimate
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS, VIBRATION
from wfsobs.observers.gpr.offline import eliminated_covariance, training_targets
from wfsobs.observers.gpr.online import online_targets
from wfsobs.observers.gpr.windows import SquaredExponential, kernel_of, scale_of, window_signals
from wfsobs.observers.missing import fill_missing
from wfsobs.prior import Bands
from wfsobs.priors_from.scenario import bands_of, prior_of
from wfsobs.priors_from.telemetry import training_of
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Estimate, Record, RecordError, pseudo_open_loop
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError, error_line
from wfsobs.tuning.records import Records, Space
from wfsobs.typing import Array


@dataclass(frozen=True)
class Errors:
    """Mode -> rms error [um]."""

    modes: dict[str, float]

    @property
    def rms(self) -> float:
        """Root of the mean square over the modes [um]."""
        return float(np.sqrt(np.mean(np.square([*self.modes.values()]))))


def target_of(observer: str, target: str | None) -> str:
    """Return the given target, by default vibration where the observer estimates it. Raises SettingError."""
    known = OBSERVERS[observer].targets
    if target is None:
        return VIBRATION if VIBRATION in known else known[0]
    if target not in TARGETS:
        raise SettingError(f"target {target!r}: takes one of {', '.join(TARGETS)}")
    if target not in known:
        raise SettingError(f"target {target!r}: {observer} estimates {' and '.join(known)}")
    return target


DESIGN = 3
"""One evaluation in so many goes to the hypercube."""
SIMPLEX = (0.15, 0.03)
"""Sizes of the first simplex, of one descent and of a second from where that ends."""
CLOSE, LEVEL = 2e-3, 1e-4
"""Where a descent ends: simplex of this size, values this near to each other (relative)."""


class NoEvaluationLeft(Exception):
    """No evaluation is left."""


def minimise(f: Callable[[Array], float], start: Array, evaluations: int, rng: np.random.Generator) -> None:
    """Ask f at points (d,) of the unit cube, `start` first, until it raises Spent or nothing is left to gain.

    f gives infinity where it fails; it keeps what it was asked.
    """
    try:
        points = [start, *scipy.stats.qmc.LatinHypercube(len(start), seed=rng).random(evaluations // DESIGN)]
        values = [f(point) for point in points]
        for size in SIMPLEX:
            i = int(np.argmin(values))
            if not np.isfinite(values[i]):
                return
            found = minimize(
                f,
                points[i],
                method="Nelder-Mead",
                bounds=[(0.0, 1.0)] * len(start),
                options={"initial_simplex": _simplex(points[i], size), "xatol": CLOSE, "fatol": LEVEL * values[i]},
            )
            points.append(found.x)
            values.append(float(found.fun))
    except NoEvaluationLeft:
        return


def _simplex(point: Array, size: float) -> Array:
    """Return the point, and one beside it along every axis, on the side with more room."""
    return np.vstack([point, point + size * np.diag(np.where(point < 0.5, 1.0, -1.0))])


GPRS = ("gpr-offline", "gpr-online")


def log_marginal_likelihood(
    signals: Array, targets: Array, depth: int, first: int, m: int, kernel: SquaredExponential, watch: Watch = QUIET
) -> float:
    """Of the targets (n,) [um] of the m windows of signals (n, channels) that end at first ... first + m - 1.

    Raises ConditionError where the precision is not enough, Cancelled.
    """
    S, _ = eliminated_covariance(signals, targets, depth, first, m, kernel, watch)
    a, b, c = -S[m, m], -S[m + 1, m], -S[m + 1, m + 1]
    quadratic = a - b**2 / (1.0 / kernel.variance + c)
    log_determinant = 2.0 * np.log(np.diagonal(S)[:m]).sum() + np.log1p(kernel.variance * c)
    return float(-0.5 * (quadratic + log_determinant + m * np.log(2.0 * np.pi)))


def likelihood(observer: str, record: Record, scenario: Scenario, watch: Watch = QUIET) -> tuple[float, ...] | None:
    """One number per mode, of a GPR on a record: the offline one's training set, or the last one of the online GPR.

    None for what is no GPR, and where the record or the numbers do not suffice.
    """
    if observer not in GPRS:
        return None
    try:
        whole = fill_missing(record.without_outliers, prior_of(scenario, record, (Bands,)))
        whole = replace(whole, training=training_of(record))  # what observers are trained on
        return tuple(_of_mode(observer, whole, scenario, mode, watch) for mode in range(record.n_modes))
    except ValueError:
        return None


def _of_mode(observer: str, record: Record, scenario: Scenario, mode: int, watch: Watch) -> float:
    g = scenario.gpr_offline if observer == "gpr-offline" else scenario.gpr_online
    bands, scale = bands_of(scenario), scale_of(g, record.training, record.delay, mode)
    if observer == "gpr-offline":
        training = record.training
        assert training is not None
        targets, first = training_targets(training, bands, record.dt, record.delay), g.depth - 1
        y, u, z = training.y_lgs, training.u, pseudo_open_loop(training.y_lgs, training.u, record.delay)
    else:
        targets, first = online_targets(record, bands), record.n_steps - 1 - g.training_size
        y, u, z = record.y_lgs, record.u, record.z
    if first < g.depth - 1 or first + g.training_size > targets.shape[0]:
        raise RecordError("the record is too short for the training set")
    signals = window_signals(g, y, u, z, mode, record.dt, scale)
    return log_marginal_likelihood(signals, targets[:, mode], g.depth, first, g.training_size, kernel_of(g), watch)


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
    spreads          : of a controller, what it leaves of the plants of the search and of others
    """

    scenario: Scenario
    validation: Errors | None
    test: Errors | None
    other: Errors | None = None
    likelihood: tuple[float, ...] | None = None
    spreads: tuple[Spread, Spread] | None = None


@dataclass
class Trials(ABC):
    """Settings that are tried, each once."""

    scenario: Scenario
    space: Space
    most: int
    watch: Watch
    on_evaluation: Callable[[Evaluation], None] | None
    history: list[Evaluation] = field(default_factory=list, init=False)
    errors: dict[tuple[Any, ...], float] = field(default_factory=dict, init=False)

    @abstractmethod
    def errors_of(self, scenario: Scenario) -> Errors:
        """Return the errors with these settings. Raises ValueError in one line where there are none, Cancelled."""

    @abstractmethod
    def stage(self, evaluation: Evaluation) -> Stage:
        """Score the scenario of an evaluation on what the search has not seen."""

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
        """One evaluation. Raises Cancelled."""
        errors, reason = None, ""
        try:
            errors = self.errors_of(self.scenario.replace(changes))
        except ValueError as error:
            reason = error_line(error)
        done = Evaluation(changes, errors, reason)
        self.history.append(done)
        if self.on_evaluation:
            self.on_evaluation(done)
        return done

    def inner(self) -> Watch:
        """Return the watch of one evaluation, a part of the whole progress."""
        done, all_of_it = len(self.history), self.most + 2
        return Watch(lambda f: self.watch.progress((done + f) / all_of_it), self.watch.is_cancelled)


@dataclass
class RecordTrials(Trials):
    """Runs of an observer on the validation record; scores begin where the first has its estimates, if that is later."""

    records: Records
    observer: str
    warm_up: float = field(init=False)

    def __post_init__(self) -> None:
        record = self.records.validation
        self.warm_up = max(self.scenario.run.warm_up, LEARNING * record.n_steps * record.dt)

    def errors_of(self, scenario: Scenario) -> Errors:
        """Return the errors on the validation record."""
        record = self.records.validation
        estimates = self._estimates(record, scenario)
        known = ~np.isnan([e.values for e in estimates]).any(axis=(0, 2))
        begins = (int(np.argmax(known)) if known.any() else record.n_steps) * record.dt
        if not self.history and begins <= LATEST * record.n_steps * record.dt:
            self.warm_up = max(self.warm_up, begins)
        if begins > self.warm_up:
            name = OBSERVERS[self.observer].label
            raise RecordError(f"{name} has its first estimate after {begins:g} s; the scores begin at {self.warm_up:g} s")
        return self._errors(record, scenario, estimates, self.warm_up, self.records.target)

    def stage(self, evaluation: Evaluation) -> Stage:
        """Score the scenario of an evaluation on the test record."""
        scenario = self.scenario.replace(evaluation.changes)
        record, own, errors, other = self.records.test(scenario), self.records.target, None, None
        others = {*OBSERVERS[self.observer].targets} - {own} if own != PREDICTION else set[str]()
        try:
            estimates = self._estimates(record, scenario)
            errors = self._errors(record, scenario, estimates, scenario.run.warm_up, own)
            for target in others:
                other = self._errors(record, scenario, estimates, scenario.run.warm_up, target)
        except ValueError:
            pass  # of the scenario as it was: the reason is in the history
        return Stage(scenario, evaluation.errors, errors, other, likelihood(self.observer, record, scenario, self.watch))

    def _estimates(self, record: Record, scenario: Scenario) -> list[Estimate]:
        """Run the observer on a record. Raises ValueError in one line where it cannot, Cancelled."""
        scenario.validate()
        out = []
        for item in each_estimate(record, scenario, self.inner(), [self.observer]):
            if isinstance(item, Failure):
                raise RecordError(item.reason)
            out.append(item)
        return out

    def _errors(self, record: Record, scenario: Scenario, estimates: list[Estimate], warm_up: float, target: str) -> Errors:
        """Over the steps after the warm-up [s] that have an estimate. Raises RecordError where there is none."""
        names = [m.name for m in scenario.modes][: record.n_modes]
        if target == PREDICTION:
            record = replace(record, y_ngs=None, ratio=None)  # the observer has the LGS alone, and no part in their slow error
            scores = [s for s in unsupervised_scores(record, estimates, warm_up, names) if s.observer == self.observer]
        else:
            scores = supervised_scores(record, [e for e in estimates if e.target == target], warm_up, names)
        modes = {s.mode: s.rms for s in scores}
        if len(modes) < len(names) or not all(map(isfinite, modes.values())):
            raise RecordError(f"{OBSERVERS[self.observer].label} has no estimate after the warm-up, {warm_up:g} s")
        return Errors(modes)
