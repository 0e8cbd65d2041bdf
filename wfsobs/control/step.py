"""A controller one frame at a time, as a real loop calls it: a measurement in, the command out.

It knows its own commands, so it makes the pseudo-open-loop z of a measurement itself; the rest is its law, and perhaps a
prediction of the vibration beside it. Over a frame it does what `Controller.commands` does over a record.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.control.mirror import Plant
from wfsobs.control.step_laws import StepLaw, VibrationAhead, push_row
from wfsobs.observers.missing import Bridge
from wfsobs.observers.step import StepBase, StepError
from wfsobs.record import Sampling
from wfsobs.signal.gate import GateSettings
from wfsobs.typing import Array


class StepController(StepBase):
    """A controller of several modes, one frame at a time; made by `wfsobs.design`.

    Attributes
    ----------
    plant : Plant
        Mirror, step and NGS ratio that it was designed for.
    law : StepLaw or None
        The laws of all modes; None for no command.
    ahead : VibrationAhead or None
        Prediction of the vibration beside them.
    """

    plant: Plant
    frame: int
    law: StepLaw | None
    ahead: VibrationAhead | None

    def __init__(
        self,
        id: str,
        plant: Plant,
        sampling: Sampling,
        law: StepLaw | None,
        ahead: VibrationAhead | None,
        uses_ngs: bool,
        bridges: tuple[Bridge, Bridge] | None,
        gate: GateSettings | None = None,
    ):
        super().__init__(id, sampling, uses_ngs, bridges, gate)
        self.plant, self.law, self.ahead = plant, law, ahead
        n = sampling.n_modes
        self._taps = plant.mirror.taps[1:]
        self._commands = np.zeros((len(self._taps), n))  # commands, newest first
        self._mirror = np.zeros((max(self._ratio, 1), n))  # the mirror in the last measurements, newest first
        self._arrays |= {"sent": self._commands, "mirror": self._mirror}
        self._none = np.zeros(n)
        self._parts |= {} if law is None else {"law": law}
        self._parts |= {} if ahead is None else ahead.parts

    def update(self, y: ArrayLike, ngs: ArrayLike | None = None, *, stars: int | None = None) -> Array:
        """Take the measurements of a frame and return its command.

        Parameters
        ----------
        y : array_like
            LGS measurement of every mode, residual of the loop, (n_modes,) [um]; NaN is missing.
        ngs : array_like, optional
            NGS measurement, (n_modes,) [um], in the frames that have one: k = n, 2n, ... for the ratio n. One that is due and
            not given, or NaN, is missing.
        stars : int, optional
            LGS that y is the mean over; by default all.

        Returns
        -------
        Array
            Command u[k] that the mirror is to take, its limits kept, (n_modes,) [um].

        Raises
        ------
        StepError
            A wrong shape, an infinite number, an NGS frame that is not due. The frame is then not taken, and no command is given.
        """
        return self._take(y, ngs, stars, "y", is_open=False)

    def update_open_loop(self, z: ArrayLike, ngs: ArrayLike | None = None, *, stars: int | None = None) -> Array:
        """As `update`, of measurements of the disturbance alone: those of a record, or of a loop that another controller closes.

        Parameters
        ----------
        z, ngs, stars : array_like
            Pseudo-open-loop measurements, see `StepObserver.update`.

        Returns
        -------
        Array
            Command u[k], (n_modes,) [um].

        Raises
        ------
        StepError
            As `update`.
        """
        return self._take(z, ngs, stars, "z", is_open=True)

    def amend(self, command: Array) -> None:
        """Take what the mirror was sent, (n_modes,) [um], where that is another command than the one of the last frame."""
        if self.law is not None:
            self.law.amend(command - self._commands[0])
        self._commands[0] = command

    @property
    def correction(self) -> Array:
        """What the mirror does in the last frame, phi_corr, (n_modes,) [um]: the residual is the disturbance and this."""
        return self._taps @ self._commands

    def _take(self, x: ArrayLike, ngs: ArrayLike | None, stars: int | None, name: str, is_open: bool) -> Array:
        x, is_whole, slow = self._check(x, ngs, stars, name)
        seen = self.correction
        z = self._complete_lgs(x if is_open else x - seen, is_whole)
        if self.uses_ngs:
            push_row(self._mirror, seen)
        if slow is not None:
            slow = self._complete_ngs(slow if is_open else slow - self._mirror.mean(axis=0))
        forward = self._none
        if self.ahead is not None:
            z, forward = self.ahead.split(z)
        u = self._none.copy()
        if self.law is not None:
            self.law.see_stars(stars)
            u = self._clip(self.law.command(z, slow, forward))
            self.law.tell(u, forward)
        push_row(self._commands, u)
        self.frame += 1
        return u

    def settle(self) -> None:
        """Do what does not need to be done before the command is out; the next `update` does it otherwise."""
        if self.ahead is not None:
            self.ahead.estimator.settle()

    def take_over(self, old: StepController) -> None:
        """Go on where another design of the same controller is, without a bump.

        Parameters
        ----------
        old : StepController
            Of the same controller, sampling and delay, with another prior or other settings.

        Raises
        ------
        StepError
            Another controller, sampling or delay, or a state that cannot be carried over.
        """
        if old.id != self.id or old.sampling != self.sampling or old._commands.shape != self._commands.shape:
            raise StepError(f"{self.id}: takes over from a design of the same controller, sampling and delay, not from {old.id}")
        if self.law is not None:
            self.law.take_over(old.law)
        if self.ahead is not None and old.ahead is not None:
            self.ahead.estimator.take_over(old.ahead.estimator)
            if self.ahead.bank.x.shape == old.ahead.bank.x.shape:
                self.ahead.bank.load(old.ahead.bank.save())
        self._take_over(old)

    def _clip(self, command: Array) -> Array:
        """Return the commands nearest to these within the limits of the mirror."""
        mirror = self.plant.mirror
        if not mirror.has_limits:
            return command
        last = self._commands[0]
        return np.clip(np.clip(command, last - mirror.slew, last + mirror.slew), -mirror.stroke, mirror.stroke)
