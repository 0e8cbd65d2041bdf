"""The whole path: Scenario -> Record -> Estimates -> Scores."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.dependence import RecordMemo
from wfsobs.evaluation.record_bounds import Bound, bound_scores, record_bounds
from wfsobs.evaluation.scores import score
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Estimate, Estimates, Observer
from wfsobs.priors_from.identification import told_by
from wfsobs.priors_from.scenario import arguments, as_sampled, prior_and_settings
from wfsobs.priors_from.training import trained_until, with_training
from wfsobs.progress import QUIET, Watch, detach_watch
from wfsobs.record import Record
from wfsobs.result import Failure, Result
from wfsobs.scenario import Scenario
from wfsobs.scenario.idle import used_settings
from wfsobs.settings.errors import SettingError
from wfsobs.settings.tree import Plain
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
        Ids of the observers; by default all.
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
) -> Result:
    """Run observers on a record.

    The time step and the exposure ratio of the record replace those of the scenario.

    Parameters
    ----------
    record : Record
        Measurements, and the truth where there is one.
    scenario : Scenario, optional
        Settings; the models of the observers are made from it unless there is a `prior`. By default those of `Scenario()`.
    observers : sequence of str, optional
        Ids of the observers; by default all.
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
    scenario = as_stated(record, scenario or Scenario())
    if prior is not None:
        scenario = as_stated(record, told_by(prior, scenario))
    scenario.validate()
    if train is not None:
        record = with_training(record, train, scenario)
    start = trained_until(train)
    estimates: list[Estimate] = []
    failures: list[Failure] = []
    for item in each_estimate(record, scenario, watch, observers, memo=memo):
        if isinstance(item, Failure):
            failures.append(item)
        else:
            estimates.append(_from(item, round(start / record.dt)))
    least = record_bounds(scenario, record) if is_simulated else []
    return collect(scenario, record, estimates, failures, watch, least, start)


def _from(estimate: Estimate, first: int) -> Estimate:
    """Return the estimate without its first steps."""
    if first == 0:
        return estimate

    def cut(x: Array) -> Array:
        return np.vstack([np.full_like(x[:first], np.nan), x[first:]])

    return replace(estimate, values=cut(estimate.values), sd=None if estimate.sd is None else cut(estimate.sd))


def as_stated(record: Record, scenario: Scenario) -> Scenario:
    """Return the scenario with the time step and exposure ratio of the record."""
    return as_sampled(scenario, record.sampling)


def collect(
    scenario: Scenario,
    record: Record,
    estimates: Sequence[Estimate],
    failures: Sequence[Failure],
    watch: Watch = QUIET,
    least: Sequence[Bound] = (),
    start: float = 0.0,
) -> Result:
    """Score estimates, and return a Result in the order of the registry, the bounds last. Raises Cancelled.

    start : from which samples count [s], or from the end of the warm-up
    """
    warm_up = max(scenario.run.warm_up, start)
    order = {name: i for i, name in enumerate(OBSERVERS)}
    names = [m.name for m in scenario.modes][: record.n_modes]
    ordered = sorted(estimates, key=lambda e: (order[e.observer], e.target))
    watch.check()
    known = record.turbulence is not None or record.vibration is not None
    scores = score(record, ordered, warm_up=warm_up, mode_names=names)
    if known:
        scores.sort(key=lambda s: (order[s.observer], s.target))
    scores += bound_scores(least, record, scores, warm_up)
    return Result(scenario, record, tuple(ordered), tuple(scores), tuple(sorted(failures, key=lambda f: order[f.observer])))


def each_estimate(
    record: Record,
    scenario: Scenario,
    watch: Watch = QUIET,
    observers: Sequence[str] | None = None,
    on_partial: Callable[[str, str, Array], None] | None = None,
    memo: RecordMemo | None = None,
) -> Iterator[Estimate | Failure]:
    """Run observers, and yield the estimates of each as soon as they are done, the slow ones last.

    Each receives measurements, its prior and its settings: neither record nor scenario.

    on_partial : receives (observer, target, values so far) from observers that compute in blocks
    memo       : estimates that are known by what they depend on; they come first, without a run
    """
    scenario = scenario.before_events  # no observer is told
    unknown = set(observers or ()) - set(OBSERVERS)
    if unknown:
        raise SettingError(f"observer {sorted(unknown)[0]!r}: no such observer; there are {', '.join(OBSERVERS)}")
    chosen = list(OBSERVERS.values()) if observers is None else [OBSERVERS[name] for name in dict.fromkeys(observers)]
    names: dict[str, str] = {}
    if memo is not None:
        used = used_settings(scenario)
        for observer in tuple(chosen):
            watch.check()
            name, found = _recall(observer, record, scenario, used.get(observer.group or ""), memo)
            if found:
                yield from found
                chosen.remove(observer)
            elif name:
                names[observer.id] = name
    weights = {o.id: o.weight for o in chosen}
    total = sum(weights.values()) or 1.0
    done = 0.0
    progress = _only_forward(watch.progress)
    for observer in sorted(chosen, key=lambda o: o.weight):
        base, share = done / total, weights[observer.id] / total
        inner = Watch(
            progress=lambda f, base=base, share=share: progress(base + share * f),
            is_cancelled=watch.is_cancelled,
            partial=lambda target, values, o=observer: on_partial(o.id, target, values) if on_partial else None,
        )
        for item in _one(observer, record, scenario, inner):
            if memo is not None and isinstance(item, Estimate):
                memo.note(names[observer.id], item)
            yield item
        done += weights[observer.id]
        watch.check()
        progress(done / total)


def _only_forward(tell: Callable[[float], None]) -> Callable[[float], None]:
    """Return a progress callback that never decreases, for modes that report each their own."""
    highest = 0.0

    def told(fraction: float) -> None:
        nonlocal highest
        highest = max(highest, fraction)
        tell(highest)

    return told


def run_observer(name: str, record: Record, scenario: Scenario, watch: Watch = QUIET) -> Estimates:
    """Return {target: (n_steps, n_modes) [um]} of one observer.

    Raises ValueError with the reason where there is none, Cancelled.
    """
    with detach_watch(watch) as alone:
        return OBSERVERS[name].estimate(*arguments(OBSERVERS[name], record, scenario), alone)


def _recall(
    observer: Observer, record: Record, scenario: Scenario, own: Plain | None, memo: RecordMemo
) -> tuple[str, list[Estimate]]:
    """Return the name of an observer's estimates, empty where there are none, and those that are known."""
    if observer.missing(record):
        return "", []
    try:
        return memo.find(observer, prior_and_settings(observer, record, scenario)[0], own)
    except ValueError:
        return "", []


def _one(observer: Observer, record: Record, scenario: Scenario, watch: Watch) -> list[Estimate | Failure]:
    missing = observer.missing(record)
    if missing:
        return [Failure(observer.id, f"{observer.id} left out: the record has no {', '.join(missing)}")]
    try:
        given = arguments(observer, record, scenario)
        start = perf_counter()
        with detach_watch(watch) as alone:
            values = observer.estimate(*given, alone)
    except ValueError as error:
        return [Failure(observer.id, f"{observer.id} left out: {error}")]
    seconds = (perf_counter() - start) / max(record.n_steps * record.n_modes, 1)
    return [Estimate(observer.id, target, values[target], seconds, values.sd.get(target)) for target in observer.targets]
