"""A controller beside a live loop, perhaps supervised, and the plant that it acts on."""

from __future__ import annotations

import numpy as np

from wfsobs.control.step import StepController
from wfsobs.control.step_laws import push_row
from wfsobs.control.supervisor import SupervisedController, Supervision
from wfsobs.control.true_plant import FAR, ActingPlant, TruePlant
from wfsobs.observers.step import StepError
from wfsobs.typing import Array


class Beside:
    """One loop on the frames of a source.

    Parameters
    ----------
    controller : StepController
        Before its first frame.
    plant : TruePlant, optional
        As it is, its optical gain aside; by default the one that the controller is designed for.
    supervision : Supervision, optional
        When an integrator takes over; with it `plant` is needed.
    rng : numpy.random.Generator, optional
        Of delays and losses of commands.
    """

    controller: StepController
    supervisor: SupervisedController | None

    def __init__(
        self,
        controller: StepController,
        plant: TruePlant | None = None,
        supervision: Supervision | None = None,
        rng: np.random.Generator | None = None,
    ):
        self.controller, self._rng = controller, rng or np.random.default_rng(0)
        self.supervisor = SupervisedController(controller, supervision) if supervision else None
        self._acting = ActingPlant(plant) if plant else None
        n_modes, ratio = controller.sampling.n_modes, controller.sampling.ratio
        self._corrections = np.zeros((ratio or 1, n_modes))  # newest first

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
        """Whether the mirror is so far out that the loop is unstable."""
        return not np.abs(self.correction).max() < FAR

    @property
    def correction(self) -> Array:
        """What the mirror does in the last frame, phi_corr, (n_modes,) [um]."""
        return self._corrections[0]

    def take(self, z: Array, ngs: Array | None) -> None:
        """Take the measurements of the disturbance alone of a frame, (n_modes,) [um]."""
        controller = self.controller
        slow = ngs if controller.frame else None
        if self._acting is None:
            controller.update_open_loop(z, slow)
            push_row(self._corrections, controller.correction)
        else:
            slow = None if slow is None else slow + self._corrections.mean(axis=0)
            u = (self.supervisor or controller).update(z + self.correction, slow)
            plant = self._acting.plant
            late, lost = plant.jitter * self._rng.uniform(-1.0, 1.0), self._rng.uniform() < plant.loss
            push_row(self._corrections, self._acting.take(u, late, lost))
        controller.settle()

    def take_over(self, old: Beside) -> None:
        """Go on where another design of the same controller is, with the mirror where that has it. Raises StepError."""
        if (self.supervisor is None) != (old.supervisor is None) or (self._acting is None) != (old._acting is None):
            raise StepError("its supervision or its plant is another")
        if self.supervisor and old.supervisor:
            self.supervisor.take_over(old.supervisor)
        else:
            self.controller.take_over(old.controller)
        if self._acting and old._acting:
            self._acting.go_on(old._acting)
        self._corrections[...] = old._corrections

    def reset(self) -> None:
        """Start anew, the mirror at rest."""
        (self.supervisor or self.controller).reset()
        self._acting = ActingPlant(self._acting.plant) if self._acting else None
        self._corrections[...] = 0.0
