"""Which observers run where none is named: those that a scenario has something for.

An observer that is told what modes, or stars, tell of one another is the copy of another where they tell nothing; named there, it
refuses.
"""

from __future__ import annotations

from collections.abc import Container, Iterable

from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Observer
from wfsobs.prior import Asterism, Flow, FlowOfBoth
from wfsobs.priors_from.flow import has_stars_apart
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.mode_spectra import are_coupled


def has_prior(observer: Observer, scenario: Scenario, n_modes: int | None = None) -> bool:
    """Return whether a scenario has what an observer is told; n_modes : of the record, by default those of the scenario."""
    n = len(scenario.modes) if n_modes is None else n_modes
    is_alone = Asterism in observer.prior and not has_stars_apart(scenario)
    is_joint = not {Flow, FlowOfBoth}.isdisjoint(observer.prior)
    return not is_alone and (not is_joint or (are_coupled(scenario) and n > 1))


def is_usual(observer: Observer, scenario: Scenario, record: Record | None = None) -> bool:
    """Return whether an observer runs on a record of a scenario, or on its own, though it is not named."""
    is_without_stars = record is not None and record.y_stars is None and "y_stars" in observer.needs
    return not is_without_stars and has_prior(observer, scenario, None if record is None else record.n_modes)


def usual_observers(scenario: Scenario, record: Record | None = None) -> list[str]:
    """Return the ids of the observers that run where none is named."""
    return [o.id for o in OBSERVERS.values() if is_usual(o, scenario, record)]


def common_observers(scenarios: Iterable[Scenario]) -> tuple[str, ...]:
    """Return the ids of the observers that every scenario has something for."""
    found = list(OBSERVERS)
    for scenario in scenarios:
        found = [name for name in found if has_prior(OBSERVERS[name], scenario)]
    return tuple(found)


def quick_observers(scenario: Scenario, groups: Container[str | None] = ()) -> list[str]:
    """Return the ids of `usual_observers` but for those that learn during the run.

    groups : of settings; those that learn and have one of them as their own stay
    """
    return [name for name in usual_observers(scenario) if not (o := OBSERVERS[name]).slow or o.group in groups]
