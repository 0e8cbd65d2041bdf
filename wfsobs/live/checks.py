"""What a live loop can run, and how fast."""

from __future__ import annotations

from typing import Any

from wfsobs.live.board import SLOTS
from wfsobs.observers.step import StepObserver
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.simulation.loop import record_settings
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


def needs_new_frames(before: Scenario, now: Scenario) -> bool:
    """Return whether the open-loop frames of two scenarios differ in more than their random numbers."""
    trees = [record_settings(scenario) for scenario in (before, now)]
    for tree in trees:
        tree.pop("loop", None)
    return trees[0] != trees[1]


def loss_line(lgs: bool, ngs: bool, loss: float) -> str:
    """Say what of the frames does not arrive.

    >>> loss_line(False, True, 0.1), loss_line(True, True, 0.0)
    ('lasers out, 10% of frames lost', 'all frames arrive')
    """
    parts = [(not lgs, "lasers out"), (not ngs, "no NGS frames"), (loss > 0, f"{loss:.0%} of frames lost")]
    return ", ".join(line for holds, line in parts if holds) or "all frames arrive"
