"""A controller in the place of an observer of the whole disturbance: minus its command is what it expects while that acts."""

from __future__ import annotations

import numpy as np

from wfsobs.control.step import StepController
from wfsobs.typing import Array


class CommandAhead:
    """Predicts `delay` frames after the last measurement, by the controller of a loop with that delay.

    Parameters
    ----------
    controller : StepController
        Designed for a mirror with this delay and without limits.
    n_modes : int
        Its modes.
    delay : int
        Frames from a command to the first measurement that sees it.
    """

    targets = ("disturbance",)

    def __init__(self, controller: StepController, n_modes: int, delay: int):
        self._controller, self._commands = controller, np.zeros((delay, n_modes))

    @property
    def frame(self) -> int:
        """Frames that it has taken."""
        return self._controller.frame

    def update(self, z: Array) -> None:
        """Take a pseudo-open-loop measurement, (n_modes,) [um]: of its own loop it would be the residual. Raises StepError."""
        u = self._controller.update(z + self._commands[-1])
        self._commands[1:] = self._commands[:-1].copy()
        self._commands[0] = u

    def predict(self, frames: float = 0.0, target: str = "disturbance") -> tuple[Array, Array]:
        """Return mean and standard deviation, which it does not know, (n_modes,) [um] each."""
        return -self._commands[0], np.full(self._commands.shape[1], np.nan)

    def reset(self) -> None:
        """Go back to before the first frame."""
        self._controller.reset()
        self._commands[:] = 0.0
