"""Running observers on a record, one after the other."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np

from wfsobs.dependence import RecordMemo
from wfsobs.evaluation.result import Failure
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Observer
from wfsobs.priors_from.scenario import PriorParts, arguments, prior_and_settings, usual_observers
from wfsobs.progress import QUIET, Cancelled, Watch, detach_watch
from wfsobs.record import NEXT_Z, TOTAL, Estimate, Estimates, Record
from wfsobs.registry import name_list
from wfsobs.scenario import Scenario
from wfsobs.scenario.scenario import used_settings
from wfsobs.settings.values import Plain, error_line
from wfsobs.typing import Array

log: logging.Logger = logging.getLogger(__name__)


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

    observers  : ids; by default those of `usual_observers`
    on_partial : receives (observer, target, values so far) from observers that compute in blocks
    memo       : estimates that are known by what they depend on; they come first, without a run
    """
    scenario = scenario.before_events  # no observer is told
    observers = name_list(observers)
    OBSERVERS.check_ids(observers or ())
    names_of = usual_observers(scenario, record) if observers is None else dict.fromkeys(observers)
    chosen = [OBSERVERS[name] for name in names_of]
    names: dict[str, str] = {}
    parts: PriorParts = {}
    if memo is not None:
        used = used_settings(scenario)
        for observer in tuple(chosen):
            watch.check()
            name, found = _recall(observer, record, scenario, used.get(observer.group or ""), memo, parts)
            if found:
                yield from found
                chosen.remove(observer)
            elif name:
                names[observer.id] = name
    total = sum(o.weight for o in chosen) or 1.0
    done = 0.0
    forward = replace(watch, progress=_only_forward(watch.progress))
    for observer in sorted(chosen, key=lambda o: o.weight):
        inner = replace(
            forward.part(done / total, observer.weight / total),
            partial=lambda target, values, o=observer: on_partial(o.id, target, values) if on_partial else None,
        )
        for item in _one(observer, record, scenario, inner, parts):
            if memo is not None and isinstance(item, Estimate) and observer.id in names:
                memo.note(names[observer.id], item)
            yield item
        done += observer.weight
        watch.check()
        forward.progress(done / total)


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
    observer: Observer, record: Record, scenario: Scenario, own: Plain | None, memo: RecordMemo, parts: PriorParts
) -> tuple[str, list[Estimate]]:
    """Return the name of an observer's estimates, empty where there are none, and those that are known."""
    if observer.missing(record):
        return "", []
    try:
        prior, settings = prior_and_settings(observer, record, scenario, parts)
        return memo.find(observer, prior, own if observer.counts is None else observer.counts(prior, settings))
    except (Exception, SystemExit):  # it says so when it runs
        return "", []


def _one(observer: Observer, record: Record, scenario: Scenario, watch: Watch, parts: PriorParts) -> list[Estimate | Failure]:
    missing = observer.missing(record)
    if missing:
        return [Failure(observer.id, f"{observer.id} left out: the record has no {', '.join(missing)}")]
    try:
        given = arguments(observer, record, scenario, parts)
        start = perf_counter()
        with detach_watch(watch) as alone:
            values = observer.estimate(*given, alone)
        for target in observer.targets:
            if np.isnan(values[target]).all():
                sensors = " or ".join(sensor.upper() for sensor in observer.sensors)
                raise ValueError(f"{target} is NaN in every step, perhaps for too few measurements of the {sensors}")
    except (Cancelled, MemoryError):  # which pass: nothing to be kept of the observer
        raise
    except (Exception, SystemExit) as error:  # by an observer of another package, perhaps: the others keep their results
        if not isinstance(error, ValueError):
            log.info("%s failed", observer.id, exc_info=True)
        return [Failure(observer.id, f"{observer.id} left out: {error_line(error)}")]
    seconds = (perf_counter() - start) / max(record.n_steps * record.n_modes, 1)
    of_sum = {name: values.sd[name] for name in (TOTAL, NEXT_Z) if name in values.sd}
    return [Estimate(observer.id, target, values[target], seconds, values.sd.get(target), of_sum) for target in observer.targets]
