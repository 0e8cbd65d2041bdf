"""What a live loop can run, and how fast."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.step import StepController
from wfsobs.live.board import ADAPTIVE, LONG_STEPS, SLOTS
from wfsobs.live.crew import SEATS, Beside
from wfsobs.live.source import STREAM, LiveSource
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.observers.step import StepObserver
from wfsobs.prior import Training
from wfsobs.priors_from.controllers import full_plant_of, supervision_of
from wfsobs.priors_from.scenario import has_prior, observer_settings
from wfsobs.record import Sampling
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.stepping import design

SLOWEST, FASTEST = 0.1, 20.0
"""Limits of the speed."""


def make_design(name: str, settings: dict[str, Any], sampling: Sampling) -> StepObserver | Beside:
    """Design an observer or a controller for a scenario; in another process. Raises ValueError."""
    scenario = Scenario.from_dict(settings)
    made = design(name, scenario, sampling=sampling)
    if not isinstance(made, StepController):
        return made
    plant, n = full_plant_of(scenario), sampling.n_modes
    of_modes = replace(plant, matrix=plant.matrix[:n, :n])
    return Beside(made, of_modes, np.random.default_rng(scenario.run.seed), supervision_of(CONTROLLERS[name], scenario))


def check_slot(name: str) -> None:
    """Raise SettingError for an observer or controller that is unknown or does not run frame by frame."""
    if name in SLOTS or name in SEATS:
        return
    if name not in OBSERVERS and name not in CONTROLLERS:
        raise SettingError(f"{name!r}: no such observer or controller; there are {', '.join((*SLOTS, *SEATS))}")
    kind, known = ("controller", SEATS) if name in CONTROLLERS else ("observer", SLOTS)
    is_of_stars = name in OBSERVERS and "y_stars" in OBSERVERS[name].needs
    why = "takes every LGS by itself, which no live source sends" if is_of_stars else "does not run frame by frame"
    raise SettingError(f"{kind} {name!r}: {why}; there are {', '.join(known)}")


def observers_on(source: LiveSource, scenario: Scenario) -> list[str]:
    """Return the ids of the observers that run frame by frame on a source, but for those whose step may be longer than a frame.

    Where a scenario has events the adaptive ones run nevertheless. Without NGS frames those that take them are left out; on a
    stream also those that learn beforehand: there is no record of it.
    """
    welcome = ADAPTIVE if scenario.events else ()
    return [name for name in SLOTS if (name not in LONG_STEPS or name in welcome) and can_run(name, source, scenario)]


def can_run(observer: str, source: LiveSource, scenario: Scenario) -> bool:
    """Return whether a source has what an observer needs."""
    it = OBSERVERS[observer]
    has_frames = source.sampling.ratio is not None or "y_ngs" not in it.needs
    return (
        has_frames
        and has_prior(it, scenario, source.sampling.n_modes)
        and (source.name != STREAM or Training not in it.parts(observer_settings(it, scenario)))  # there is no record of it
    )


def has_error(observer: str, source: LiveSource) -> bool:
    """Return whether errors of an observer are known: without truth those of the next measurement, the sum of both targets."""
    return source.has_truth or set(TARGETS) <= set(OBSERVERS[observer].targets)


def can_control(controller: str, source: LiveSource) -> bool:
    """Return whether a source has what a controller needs."""
    return source.sampling.ratio is not None or not CONTROLLERS[controller].ngs


def speed_of(text: str) -> float:
    """Read a speed. Raises SettingError.

    >>> speed_of("0.25")
    0.25
    """
    try:
        return check_speed(float(text))
    except ValueError:
        raise SettingError(f"speed = {text[:80]}: takes a number from {SLOWEST:g} to {FASTEST:g}") from None


def check_speed(speed: float) -> float:
    """Return a speed. Raises SettingError."""
    if not SLOWEST <= speed <= FASTEST:
        raise SettingError(f"speed = {speed:g}: takes a number from {SLOWEST:g} to {FASTEST:g}")
    return speed
