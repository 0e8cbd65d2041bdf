"""Controllers beside a live loop: what each would have left of the same disturbance."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.step import StepController
from wfsobs.live.paced import Command
from wfsobs.live.ring import LiveFrame
from wfsobs.observers.step_checks import StepError
from wfsobs.record import Sampling
from wfsobs.typing import Array

SEATS = tuple(c.id for c in CONTROLLERS.values() if c.predict is None or c.step_predict is not None)
"""Controllers that run frame by frame; each has its place in a row."""

USUAL = ("none", "integrator", "lqg-kf-multi", "lqg-multirate-multi")
"""Controllers that run unless others are named."""


def row_width(n_modes: int) -> int:
    """Return the width of a row: number of the frame, and what each controller has."""
    return 1 + len(SEATS) * seat_width(n_modes)


def seat_width(n_modes: int) -> int:
    """Return the width of what a controller has in a row: residuals [um], sums of their squares since its start, their number."""
    return 2 * n_modes + 1


class ControlCrew:
    """The controllers of one process.

    Parameters
    ----------
    sampling : Sampling
        Modes, step and NGS ratio of the source.
    warm_up : int
        Frames of a controller before the first that counts.
    say : callable
        Receives (number of the frame, one line) about what happens.
    """

    def __init__(self, sampling: Sampling, warm_up: int, say: Callable[[tuple[int, str]], None]):
        m = sampling.n_modes
        self.ratio, self._warm_up, self._say = sampling.ratio or 1, warm_up, say
        self._row = np.full(row_width(m), np.nan)
        seats = self._row[1:].reshape(len(SEATS), seat_width(m))
        self._left, self._squares, self._counts = seats[:, :m], seats[:, m:-1], seats[:, -1]  # views of the row
        self._active: dict[str, StepController] = {}
        self._waiting: dict[str, StepController] = {}

    @property
    def is_idle(self) -> bool:
        """Whether there is no controller."""
        return not (self._active or self._waiting)

    def take(self, frame: LiveFrame, number: int) -> Array:
        """Have every controller take a frame; return the row of what they leave."""
        if self._waiting and number % self.ratio == 0:
            for name, controller in self._waiting.items():
                self._start(name, controller, number)
            self._waiting.clear()
        ngs = None if np.isnan(frame.ngs[0]) else frame.ngs
        disturbance = frame.turbulence + frame.vibration
        self._row[0] = number
        for name, controller in self._active.items():
            seat = SEATS.index(name)
            measured = frame.z + controller.correction
            controller.update_open_loop(frame.z, ngs if controller.frame else None)
            controller.settle()
            left = disturbance + controller.correction
            # without truth, what its sensor would have seen
            self._left[seat] = left = np.where(np.isnan(left), measured, left)
            if controller.frame > self._warm_up and not np.isnan(left).any():
                self._squares[seat] += left * left
                self._counts[seat] += 1
        return self._row

    def reset(self) -> None:
        """Start anew: frames were overwritten."""
        for controller in self._active.values():
            controller.reset()

    def follow(self, command: Command, number: int) -> None:
        """Switch a controller off, or a new design on, which goes on where the one before is."""
        name, controller = command["controller"], command["design"]
        if controller is None:
            self._waiting.pop(name, None)
            if self._active.pop(name, None) is not None:
                self._clear(name, np.nan)
                self._say((number, f"{name} off"))
        elif (before := self._active.get(name)) is None:
            self._waiting[name] = controller
        else:
            try:
                controller.take_over(before)
            except StepError as error:
                self._waiting[name] = controller
                self._say((number, f"{error}: restarted"))
            else:
                self._active[name] = controller
                self._say((number, f"{name} has a new design"))

    def _start(self, name: str, controller: StepController, number: int) -> None:
        self._clear(name, 0.0)
        self._active[name] = controller
        self._say((number, f"{name} on"))

    def _clear(self, name: str, value: float) -> None:
        seat = SEATS.index(name)
        self._left[seat] = np.nan
        self._squares[seat] = self._counts[seat] = value
