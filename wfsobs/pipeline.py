"""The whole path: Scenario -> Record -> Estimates -> Scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.dependence import RecordMemo
from wfsobs.evaluation.bound import Bound, bound_scores, record_bounds
from wfsobs.evaluation.result import Failure, Result
from wfsobs.evaluation.scores import SCORED, Derive, make_anew, score
from wfsobs.execution import each_estimate
from wfsobs.observers import OBSERVERS
from wfsobs.prior import GIVEN, IDENTIFIED, TRUE, PriorSource
from wfsobs.priors_from.scenario import as_sampled
from wfsobs.priors_from.telemetry import told_by, trained_until, with_training
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Estimate, Record
from wfsobs.scenario import Scenario
from wfsobs.sensors.zernike import HIGHEST_ORDER, order_of
from wfsobs.settings.values import check_kind
from wfsobs.simulation.loop import simulate
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.identification.result import Identification


def run(scenario: Scenario, *, observers: Sequence[str] | None = None, watch: Watch = QUIET) -> Result:
    """Simulate a record and run observers on it.

    Parameters
    ----------
    scenario : Scenario
        Settings of the run.
    observers : sequence of str, optional
        Ids of the observers; by default all that the scenario has something for.
    watch : Watch, optional
        Receives the progress, and is asked at every block of work whether to stop.

    Returns
    -------
    Result
        Record, estimates and scores.

    Raises
    ------
    SettingError
        Two settings exclude each other, or an observer is unknown.
    Cancelled
        `watch` asks to stop.

    See Also
    --------
    simulate : The record alone.
    observe : The observers alone, on any record.

    Examples
    --------
    >>> import wfsobs
    >>> scenario = wfsobs.PRESETS["paper"]().replace({"run.duration": 2.0})
    >>> wfsobs.run(scenario, observers=["kf-lgs"])
    Result(1 observers, ...)
    """
    check_kind("run", scenario, Scenario)
    return observe(simulate(scenario, watch=watch), scenario, observers=observers, watch=watch, is_simulated=True)


def observe(
    record: Record,
    scenario: Scenario | None = None,
    *,
    observers: Sequence[str] | None = None,
    prior: Identification | Scenario | None = None,
    train: Record | float | None = None,
    watch: Watch = QUIET,
    is_simulated: bool = False,
    memo: RecordMemo | None = None,
    gate: bool = True,
) -> Result:
    """Run observers on a record.

    The time step and the exposure ratio of the record replace those of the scenario, as do its modes where they are more.

    Parameters
    ----------
    record : Record
        Measurements, and the truth where there is one.
    scenario : Scenario, optional
        Settings; the models of the observers are made from it unless there is a `prior`. By default those of `Scenario()`.
    observers : sequence of str, optional
        Ids of the observers; by default all that the scenario has something for.
    prior : Identification or Scenario, optional
        What observers are told: what `identify` found, or the settings that were made of it. Their own settings stay those of
        `scenario`.
    train : Record or float, optional
        Training data in place of the record's own, for observers that learn: another record of the same loop; or the duration
        [s] of the first part of this one. There are then estimates and scores only after it.
    watch : Watch, optional
        Receives the progress, and is asked at every block of work whether to stop.
    is_simulated : bool
        Whether the record was simulated from the scenario, so that its Wiener bounds are known.
    memo : RecordMemo, optional
        Estimates of this record that are known by what they depend on; they do not run, the others are noted there.
    gate : bool
        Whether outliers are kept from the observers as `scenario.sensors.gate` says; `run` does not test its own simulation.

    Returns
    -------
    Result
        Record, estimates and scores.

    Raises
    ------
    SettingError
        Two settings exclude each other, or an observer is unknown.
    RecordError
        The training data does not fit the record, or is too short.
    Cancelled
        `watch` asks to stop.
    """
    check_kind("observe", record, Record)
    scenario = as_stated(record, scenario or Scenario())
    if prior is not None:
        scenario = as_stated(record, told_by(prior, scenario))
    scenario.validate()
    record = with_gate(record, scenario) if gate and not is_simulated else record
    start = 0.0
    if train is not None:
        record, start = with_training(record, train, scenario), trained_until(train)
    estimates: list[Estimate] = []
    failures: list[Failure] = []
    for item in each_estimate(record, scenario, watch, observers, memo=memo):
        if isinstance(item, Failure):
            failures.append(item)
        else:
            estimates.append(_from(item, round(start / record.dt)))
    least = record_bounds(scenario, record, {e.observer for e in estimates}) if is_simulated else []
    source = IDENTIFIED if prior is not None else TRUE if is_simulated else GIVEN
    return collect(scenario, record, estimates, failures, watch, least, start, source)


def _from(estimate: Estimate, first: int) -> Estimate:
    """Return the estimate without its first steps."""
    if first == 0:
        return estimate

    def cut(x: Array) -> Array:
        return np.vstack([np.full_like(x[:first], np.nan), x[first:]])

    sd, of_sum = None if estimate.sd is None else cut(estimate.sd), {name: cut(x) for name, x in estimate.sd_of_sum.items()}
    return replace(estimate, values=cut(estimate.values), sd=sd, sd_of_sum=of_sum)


def as_stated(record: Record, scenario: Scenario) -> Scenario:
    """Return the scenario with the time step, the exposure ratio and at least the modes of the record. Raises SettingError."""
    if record.n_modes > len(scenario.modes):
        scenario = scenario.replace({"telescope.radial_order": order_of(record.n_modes) or HIGHEST_ORDER + 1})
    return as_sampled(scenario, record.sampling)


def with_gate(record: Record, scenario: Scenario) -> Record:
    """Return a record that is not a simulation of the scenario with the gate of its settings."""
    return record if record.gate == scenario.gate else replace(record, gate=scenario.gate)


def collect(
    scenario: Scenario,
    record: Record,
    estimates: Sequence[Estimate],
    failures: Sequence[Failure],
    watch: Watch = QUIET,
    least: Sequence[Bound] = (),
    start: float = 0.0,
    source: PriorSource = TRUE,
    derive: Derive = make_anew,
) -> Result:
    """Score estimates, and return a Result in the order of the registry, the bounds last. Raises Cancelled.

    start  : from which samples count [s], or from the end of the warm-up
    source : where the prior of the observers comes from
    derive : recalls scores that are known
    """
    warm_up = max(scenario.run.warm_up, start)
    order = {name: i for i, name in enumerate(OBSERVERS)}
    names = [m.name for m in scenario.modes][: record.n_modes]
    ordered = sorted(estimates, key=lambda e: (order[e.observer], e.target))
    watch.check()
    known = record.turbulence is not None or record.vibration is not None
    scores = score(record, ordered, warm_up=warm_up, mode_names=names, derive=derive)
    if known:
        scores.sort(key=lambda s: (order[s.observer], SCORED.index(s.target)))
    scores += bound_scores(least, record, scores, warm_up)
    failed = tuple(sorted(failures, key=lambda f: order[f.observer]))
    return Result(scenario, record, tuple(ordered), tuple(scores), failed, source)
