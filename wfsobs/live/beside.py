"""A controller beside a live loop, perhaps supervised, and the plant that it acts on."""

from __future__ import annotations

import numpy as np

from wfsobs.control.step import StepController
from wfsobs.control.supervisor import SupervisedController, Supervision
from wfsobs.control.true_plant import ActingLoop, TruePlant
from wfsobs.observers.step import StepError
from wfsobs.typing import Array


class Beside:
    """One loop on the frames of a source.

    Parameters
    ----------
    controller : StepController
        Before its first frame.
    plant : TruePlant
        As it is, its optical gain aside.
    rng : numpy.random.Generator
        Of delays and losses of commands.
    supervision : Supervision, optional
        When an integrator takes over.
    """

    controller: StepController
    supervisor: SupervisedController | None

    def __init__(
        self, controller: StepController, plant: TruePlant, rng: np.random.Generator, supervision: Supervision | None = None
    ):
        self.controller, self._rng = controller, rng
        self.supervisor = SupervisedController(controller, supervision) if supervision else None
        self._plant = plant
        self._loop = self._at_rest()

    def _at_rest(self) -> ActingLoop:
        return ActingLoop(self.supervisor or self.controller, self._plant, self.controller.sampling.ratio)

    @property
    def id(self) -> str:
        """Id of the controller."""
        return self.controller.id

    @property
    def reason(self) -> str:
        """Why an integrator closes the loop; "" while the controller does."""
        return self.supervisor.reason if self.supervisor else ""

    @property
    def has_diverged(self) -> bool:
        """Whether the command is so large that the loop is unstable."""
        return self._loop.has_diverged

    @property
    def correction(self) -> Array:
        """What the mirror does in the last frame, phi_corr, (n_modes,) [um]."""
        return self._loop.correction

    def take(self, z: Array, ngs: Array | None) -> None:
        """Take the measurements of the disturbance alone of a frame, (n_modes,) [um]."""
        late, is_lost = self._plant.jitter * self._rng.uniform(-1.0, 1.0), self._rng.uniform() < self._plant.loss
        self._loop.take(z, ngs if self.controller.frame else None, late=late, is_lost=is_lost)
        self.controller.settle()

    def take_over(self, old: Beside) -> None:
        """Go on where another design of the same controller is, with the mirror where that has it. Raises StepError."""
        if self.supervisor and old.supervisor:
            self.supervisor.take_over(old.supervisor)
        elif self.supervisor or old.supervisor:
            raise StepError("its supervision is another")
        else:
            self.controller.take_over(old.controller)
        self._loop.go_on(old._loop)

    def reset(self) -> None:
        """Start anew, the mirror at rest."""
        (self.supervisor or self.controller).reset()
        self._loop = self._at_rest()
