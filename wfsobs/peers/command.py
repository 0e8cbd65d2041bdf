"""A controller in the place of an observer of the whole disturbance: minus its command is what it expects while that acts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from wfsobs.control.step import StepController
from wfsobs.record import Sampling
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
        self._mirror = np.zeros((controller.sampling.ratio or 1, n_modes))

    @property
    def frame(self) -> int:
        """Frames that it has taken."""
        return self._controller.frame

    @property
    def sampling(self) -> Sampling:
        """That of the controller."""
        return self._controller.sampling

    def update(self, z: Array, ngs: Array | None = None) -> None:
        """Take pseudo-open-loop measurements, (n_modes,) [um]: of its own loop they would be residuals. Raises StepError."""
        seen = self._commands[-1].copy()
        self._mirror[1:] = self._mirror[:-1].copy()
        self._mirror[0] = seen
        u = self._controller.update(z + seen, None if ngs is None else ngs + self._mirror.mean(axis=0))
        self._commands[1:] = self._commands[:-1].copy()
        self._commands[0] = u

    def predict(self, frames: float = 0.0, target: str = "disturbance") -> tuple[Array, Array]:
        """Return mean and standard deviation, which it does not know, (n_modes,) [um] each."""
        return -self._commands[0], np.full(self._commands.shape[1], np.nan)

    def reset(self) -> None:
        """Go back to before the first frame."""
        self._controller.reset()
        self._commands[:] = self._mirror[:] = 0.0

    def state_dict(self) -> dict[str, Array]:
        """Return a copy of the state."""
        own = {"ahead.commands": self._commands.copy(), "ahead.mirror": self._mirror.copy()}
        return own | self._controller.state_dict()

    def load_state_dict(self, state: Mapping[str, Array]) -> None:
        """Go on from a state of `state_dict`. Raises StepError where it is that of another design."""
        rest = dict(state)
        self._commands[:], self._mirror[:] = rest.pop("ahead.commands"), rest.pop("ahead.mirror")
        self._controller.load_state_dict(rest)
