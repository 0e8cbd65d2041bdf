"""Responses of an observer to each source of its measurements: what its estimate has of noise, signal, lines and cone effect."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from math import factorial
from typing import Any

import numpy as np

from wfsobs.evaluation.sources import SIGNAL, Source, sum_sources
from wfsobs.observers.base import Observer
from wfsobs.priors_from.scenario import arguments
from wfsobs.progress import QUIET, Watch, detach_watch
from wfsobs.record import Measurements, Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import measure_closed_loop
from wfsobs.simulation.sensing import OpenLoop
from wfsobs.typing import Array

Estimates = dict[str, Array]


def observer_responses(
    observer: Observer, scenario: Scenario, record: Record, sources: dict[str, Source], watch: Watch = QUIET
) -> tuple[dict[str, Estimates], Estimates]:
    """Split an observer's estimate into its responses to each source.

    Parameters
    ----------
    observer : Observer
        The observer.
    scenario : Scenario
        Settings.
    record : Record
        The record, for what the observer is given of it.
    sources : dict of str to Source
        The sources, by name.
    watch : Watch
        Asked between runs whether to stop.

    Returns
    -------
    tuple of dict
        Source -> target -> response; and the estimate from nothing. Their sum is the estimate.
    """
    _, prior, settings = arguments(observer, record, scenario.before_events)

    def estimate(names: Iterable[str]) -> Estimates:
        watch.check()
        chosen = [sources[name] for name in names]
        measured = measure_closed_loop(scenario, sum_sources(chosen) if chosen else _nothing(sources))
        return _estimate(observer, measured, prior, settings, watch)

    rest = estimate(())
    share = _linear_share if observer.linear else _shapley_share
    return share(tuple(sources), estimate, rest), rest


def _estimate(observer: Observer, measurements: Measurements, prior: Any, settings: Any, watch: Watch) -> Estimates:
    """Return an observer's estimate, zero where there is none."""
    own = measurements if "open_loop_y" in observer.needs else replace(measurements, open_loop_y=None)
    with detach_watch(replace(watch, progress=lambda _: None, partial=lambda *_: None)) as alone:
        return {target: np.nan_to_num(values) for target, values in observer.estimate(own, prior, settings, alone).items()}


def _nothing(sources: dict[str, Source]) -> OpenLoop:
    seen = sources[SIGNAL].measurement
    return OpenLoop(0.0 * seen.lgs, 0.0 * seen.ngs)


def _linear_share(names: Sequence[str], estimate: Callable[[Iterable[str]], Estimates], rest: Estimates) -> dict[str, Estimates]:
    return {name: {target: values - rest[target] for target, values in estimate((name,)).items()} for name in names}


def _shapley_share(names: Sequence[str], estimate: Callable[[Iterable[str]], Estimates], rest: Estimates) -> dict[str, Estimates]:
    """Return the mean over all orders of what a source adds to the estimate from those before it."""
    n = len(names)
    found = {frozenset(of): estimate(of) if of else rest for size in range(n + 1) for of in combinations(names, size)}
    out = {}
    for name in names:
        others = [of for of in found if name not in of]
        weight = {of: factorial(len(of)) * factorial(n - len(of) - 1) / factorial(n) for of in others}
        out[name] = {
            target: sum(weight[of] * (found[of | {name}][target] - found[of][target]) for of in others) for target in rest
        }
    return out
