"""What a live loop can run, and how fast."""

from __future__ import annotations

from typing import Any

from wfsobs.live.board import SLOTS
from wfsobs.observers.step import StepObserver
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.stepping import design

SLOWEST, FASTEST = 0.1, 20.0
"""Limits of the speed."""


def make_design(name: str, settings: dict[str, Any]) -> StepObserver:
    """Design an observer for a scenario; in another process. Raises ValueError."""
    return design(name, Scenario.from_dict(settings))


def check_slot(name: str) -> None:
    """Raise SettingError for an observer that is unknown or does not run frame by frame."""
    if name not in SLOTS:
        raise SettingError(f"observer {name!r}: does not run frame by frame; there are {', '.join(SLOTS)}")


def check_speed(speed: float) -> float:
    """Return a speed. Raises SettingError."""
    if not SLOWEST <= speed <= FASTEST:
        raise SettingError(f"speed = {speed:g}: takes a number from {SLOWEST:g} to {FASTEST:g}")
    return speed
