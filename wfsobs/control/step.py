"""A controller one frame at a time, as a real loop calls it: a measurement in, the command out.

It knows its own commands, so it makes the pseudo-open-loop z of a measurement itself; the rest is its law, and perhaps a
prediction of the vibration beside it. Over a frame it does what `Controller.commands` does over a record.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.control.mirror import Plant
from wfsobs.control.step_laws import StepLaw, VibrationAhead, push_row
from wfsobs.observers.missing import Bridge
from wfsobs.observers.step import StepError, check_frame, check_ngs, check_stars, check_state, make_gates, pass_gate
from wfsobs.observers.stepping import Stateful, load_parts, save_parts
from wfsobs.record import Sampling
from wfsobs.signal.gate import GateSettings
from wfsobs.typing import Array


class StepController:
    """A controller of several modes, one frame at a time; made by `wfsobs.design`.

    Attributes
    ----------
    id : str
        Of the controller.
    plant : Plant
        Mirror, step and NGS ratio that it was designed for.
    sampling : Sampling
        Number of modes, step and NGS ratio.
    bridges : tuple of Bridge or None
        What completes LGS measurements and NGS frames; None where missing ones are none to its law.
    frame : int
        Frames that it has taken.
    """

    id: str
    plant: Plant
    sampling: Sampling
    law: StepLaw | None
    ahead: VibrationAhead | None
    frame: int
    uses_ngs: bool
    bridges: tuple[Bridge, Bridge] | None

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
        self.id, self.plant, self.sampling, self.law, self.ahead = id, plant, sampling, law, ahead
        self.frame = 0
        n = sampling.n_modes
        self.uses_ngs, self._ratio = uses_ngs, sampling.ratio or 0
        self.bridges, (self._lgs, self._ngs) = bridges, bridges or (None, None)
        if not uses_ngs:
            self._ngs = None
        self._taps = plant.mirror.taps[1:]
        self._commands = np.zeros((len(self._taps), n))  # commands, newest first
        self._mirror = np.zeros((max(self._ratio, 1), n))  # the mirror in the last measurements, newest first
        self._none = np.zeros(n)
        found = {"lgs": self._lgs, "law": law, "ngs": self._ngs}
        self._parts: dict[str, Stateful] = {name: part for name, part in found.items() if part is not None}
        self._parts |= {} if ahead is None else ahead.parts
        self._gates = make_gates(gate, sampling, uses_ngs)
        self._parts |= self._gates

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

    @property
    def correction(self) -> Array:
        """What the mirror does in the last frame, phi_corr, (n_modes,) [um]: the residual is the disturbance and this."""
        return self._taps @ self._commands

    def _take(self, x: ArrayLike, ngs: ArrayLike | None, stars: int | None, name: str, is_open: bool) -> Array:
        x, is_whole = check_frame(self.id, x, name, self.sampling.n_modes, self.frame)
        check_stars(self.id, stars)
        due = self.uses_ngs and self.frame > 0 and self.frame % self._ratio == 0
        slow = check_ngs(self.id, ngs, due, self.sampling.n_modes, self._ratio, self.frame) if self.uses_ngs else None
        seen = self.correction
        z = x if is_open else x - seen
        if self._gates:
            z = pass_gate(self._gates, "gate_lgs", z, self.frame, self.sampling)
            is_whole = is_whole and not np.isnan(z).any()
        if self._lgs is not None:
            z = self._lgs.complete(z, is_whole)
        if self.uses_ngs:
            push_row(self._mirror, seen)
        if slow is not None:
            slow = slow if is_open else slow - self._mirror.mean(axis=0)
            slow = pass_gate(self._gates, "gate_ngs", slow, self.frame, self.sampling)
            slow = slow if self._ngs is None else self._ngs.complete(slow)
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

    def reset(self) -> None:
        """Go back to before the first frame, the mirror at rest."""
        self.frame = 0
        self._commands[...] = self._mirror[...] = 0.0
        for part in self._parts.values():
            part.reset()

    def state_dict(self) -> dict[str, Array]:
        """Return a copy of the state: name -> array, plain numbers that `numpy.savez` can keep."""
        own = {"frame": np.array(self.frame), "sent": self._commands.copy(), "mirror": self._mirror.copy()}
        return own | save_parts(self._parts)

    def load_state_dict(self, state: Mapping[str, ArrayLike]) -> None:
        """Go on from a state of `state_dict`. Raises StepError where it is that of another design."""
        given = check_state(self.id, state, self.state_dict())
        self.frame = int(given["frame"])
        self._commands[...], self._mirror[...] = given["sent"], given["mirror"]
        load_parts(self._parts, given)

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
        for bridge, was in ((self._lgs, old._lgs), (self._ngs, old._ngs)):
            if bridge is not None and was is not None:
                bridge.take_over(was)
        for name in self._gates.keys() & old._gates.keys():
            self._gates[name].load(old._gates[name].save())
        self._commands[...], self._mirror[...], self.frame = old._commands, old._mirror, old.frame

    def _clip(self, command: Array) -> Array:
        """Return the commands nearest to these within the limits of the mirror."""
        mirror = self.plant.mirror
        if not mirror.has_limits:
            return command
        last = self._commands[0]
        return np.clip(np.clip(command, last - mirror.slew, last + mirror.slew), -mirror.stroke, mirror.stroke)
