"""A controller one frame at a time, as a real loop calls it: a measurement in, the command out.

It knows its own commands, so it makes the pseudo-open-loop z of a measurement itself; the rest is its law, and perhaps a
prediction of the vibration beside it. Over a frame it does what `Controller.commands` does over a record.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.control.mirror import Law, Mirror, Plant
from wfsobs.observers.base import TARGETS
from wfsobs.observers.baselines import online_filters
from wfsobs.observers.kalman.step import KalmanEstimator
from wfsobs.observers.missing import Bridge
from wfsobs.observers.step import Estimator, StepBase, StepError, take_state
from wfsobs.observers.stepping import FilterBank, StateArrays, Stateful
from wfsobs.prior import Bands, Prior
from wfsobs.record import Sampling
from wfsobs.signal.gate import GateSettings
from wfsobs.typing import Array

StepPredict = Callable[[Prior, Plant, Any, Sampling], Estimator]
"""(prior, plant, settings, sampling) -> predictor of the vibration while the command of the frame acts."""

MakeStepLaw = Callable[[Prior, Plant, Any, Sampling], "StepLaw"]
"""(prior, plant, settings, sampling) -> laws of all modes. Raises ValueError saying why there are none."""


DECIMALS = 9
"""Of z [um] where a model is identified from it: it is then the same in whichever order commands were added."""


class StepLaw(StateArrays, ABC):
    """The laws of all modes, one frame at a time; by default commands sent do not matter to them."""

    def see_stars(self, count: int | None) -> None:
        """Take the LGS measurement of the next frame for the mean over so many stars; None for all."""

    @abstractmethod
    def command(self, z: Array, ngs: Array | None, forward: Array) -> Array:
        """Return the commands (n_modes,) [um] that the laws want, `forward` included."""

    def tell(self, command: Array, forward: Array) -> None:
        """Tell what the mirror took of them."""

    def amend(self, difference: Array) -> None:
        """Go on from a command that differs by this from the one told last."""

    def take_over(self, old: Any) -> None:
        """Go on from the state of other laws. Raises StepError."""
        take_state(self, old)


class LinearLaws(StepLaw):
    """Laws as filters of z."""

    state_names: tuple[str, ...] = ("bank",)

    def __init__(self, laws: Sequence[Law]):
        self.laws: tuple[Law, ...] = tuple(laws)
        self.bank: FilterBank = FilterBank([law.cycle for law in laws])
        self._v = np.zeros((len(laws), laws[0].cycle.steps[0][1].shape[1]))
        self.mark_start()

    def command(self, z: Array, ngs: Array | None, forward: Array) -> Array:
        """Return what the filters give."""
        v = self._v
        v[:, 0] = z
        if v.shape[1] > 1:
            v[:, 1] = 0.0 if ngs is None else ngs
        return self.bank.step(v)[:, 0] + forward

    def take_over(self, old: Any) -> None:
        """Go on from filters of as many states and of a cycle as long. Raises StepError."""
        if isinstance(old, LinearLaws) and len(old.bank.maps) != len(self.bank.maps):
            raise StepError("the laws have cycles of another length")
        super().take_over(old)


class KalmanLaws(StepLaw):
    """Laws as rows of what Kalman filters estimate; a measurement that is missing, NaN, is none to them."""

    laws: tuple[Law, ...]

    state_names: tuple[str, ...] = ("filters",)

    def __init__(self, laws: Sequence[Law]):
        self.laws = tuple(laws)
        self.filters: KalmanEstimator = KalmanEstimator([law.filter for law in laws if law.filter is not None])
        self._rows = np.zeros_like(self.filters.bank.x)
        for row, law in zip(self._rows, laws, strict=True):
            assert law.row is not None
            row[: len(law.row)] = law.row
        self.mark_start()

    def see_stars(self, count: int | None) -> None:
        """Take the LGS measurement of the next frame for the mean over so many stars; None for all."""
        self.filters.see_stars(count)

    def command(self, z: Array, ngs: Array | None, forward: Array) -> Array:
        """Return the commands of the estimates."""
        self.filters.advance(z, ngs, None)
        return np.sum(self._rows * self.filters.bank.x, axis=1) + forward

    def take_over(self, old: Any) -> None:
        """Go on where the disturbance is in the old filters' states."""
        if not isinstance(old, KalmanLaws) or len(old.filters.bank.maps) != len(self.filters.bank.maps):
            raise StepError("the laws are of another kind")
        self.filters.take_over(old.filters)


class Integrators(StepLaw):
    """Integrators whose state are their own commands, so that a limit of the mirror stops them (anti-windup)."""

    state_names: tuple[str, ...] = ("_own",)

    def __init__(self, laws: Sequence[Law], mirror: Mirror):
        self.laws: tuple[Law, ...] = tuple(laws)
        self._gain = np.array([law.gain for law in laws])
        self._leak = np.array([law.leak for law in laws])
        self._taps = mirror.taps[1:]
        self._own = np.zeros((len(self._taps), len(laws)))  # newest first
        self.mark_start()

    def command(self, z: Array, ngs: Array | None, forward: Array) -> Array:
        """Return leak u - g y, y the measurement with the integrator's own commands alone; none where it is missing."""
        return self._leak * self._own[0] - self._gain * np.nan_to_num(z + self._taps @ self._own) + forward

    def tell(self, command: Array, forward: Array) -> None:
        """Go on from what the mirror took."""
        push_row(self._own, command - forward)

    def amend(self, difference: Array) -> None:
        """Go on from a command that differs by this from the one told last."""
        self._own[0] += difference


class BesideIntegrators(StepLaw):
    """Laws beside which integrators run, which a limit of the mirror stops."""

    integrators: Integrators

    def tell(self, command: Array, forward: Array) -> None:
        """Have the integrators go on from what the mirror took."""
        self.integrators.tell(command, forward)

    def amend(self, difference: Array) -> None:
        """Go on from a command that differs by this from the one told last."""
        self.integrators.amend(difference)


class MixedLaws(BesideIntegrators):
    """Integrators in some modes, which a limit of the mirror stops, and filters of z in the others."""

    state_names: tuple[str, ...] = ("filters", "integrators")

    def __init__(self, laws: Sequence[Law], mirror: Mirror):
        self._integrates = np.array([law.gain is not None for law in laws])
        self.filters = LinearLaws(laws)
        self.integrators = Integrators([law if law.gain is not None else replace(law, gain=0.0) for law in laws], mirror)
        self.mark_start()

    def command(self, z: Array, ngs: Array | None, forward: Array) -> Array:
        """Return the commands of each mode's own law."""
        of_filters = self.filters.command(z, ngs, forward)
        return np.where(self._integrates, self.integrators.command(z, ngs, forward), of_filters)

    def take_over(self, old: Any) -> None:
        """Go on from laws of the same kinds."""
        if not isinstance(old, MixedLaws) or not np.array_equal(old._integrates, self._integrates):
            raise StepError("the laws are of another kind")
        self.filters.take_over(old.filters)
        self.integrators.take_over(old.integrators)


class PredictionLaws(BesideIntegrators):
    """Minus what an observer predicts that needs time until it does; until then integrators."""

    state_names: tuple[str, ...] = ("estimator", "integrators")

    def __init__(self, estimator: Estimator, integrators: Integrators, mirror: Mirror):
        self.estimator, self.integrators = estimator, integrators
        self._taps = [(steps, tap) for steps, tap in enumerate(mirror.taps[1:].tolist()) if tap]
        self.mark_start()

    def command(self, z: Array, ngs: Array | None, forward: Array) -> Array:
        """Return minus the mean of the prediction while the command acts."""
        self.estimator.advance(np.round(z, DECIMALS), None if ngs is None else np.round(ngs, DECIMALS), None)
        ahead = sum((tap * self.estimator.predict(k, target)[0] for k, tap in self._taps for target in TARGETS), -forward)
        return np.where(np.isnan(ahead), self.integrators.command(z, ngs, forward), -ahead)

    def take_over(self, old: Any) -> None:
        """Go on from what the old observer knows."""
        if not isinstance(old, PredictionLaws):
            raise StepError("the laws are of another kind")
        self.estimator.take_over(old.estimator)
        self.integrators.take_over(old.integrators)


def take_missing(laws: Sequence[Law]) -> bool:
    """Return whether a measurement that is missing can be none to all these laws."""
    return bool(laws) and all(law.filter is not None and law.row is not None for law in laws)


def step_law(laws: Sequence[Law], mirror: Mirror) -> StepLaw | None:
    """Return the laws of all modes, one frame at a time; None for no laws."""
    if take_missing(laws):
        return KalmanLaws(laws)
    if all(one.gain is not None for one in laws):
        return Integrators(laws, mirror) if laws else None
    is_mixed = mirror.has_limits and any(one.gain is not None for one in laws)
    return MixedLaws(laws, mirror) if is_mixed else LinearLaws(laws)


class VibrationAhead:
    """What the vibration will be while the command of a frame acts, and the part of z that this corrects (`control.base`)."""

    def __init__(self, estimator: Estimator, bands: Bands, sampling: Sampling):
        self.estimator = estimator
        self.bank: FilterBank = online_filters(bands, sampling)
        self.parts: dict[str, Stateful] = {"estimator": estimator, "bank": self.bank}

    def split(self, z: Array) -> tuple[Array, Array]:
        """Return z without the vibration, and the command against the vibration, both (n_modes,) [um]."""
        self.estimator.advance(z, None, None)
        horizon = self.estimator.horizon
        ahead, _ = self.estimator.predict(0.0 if horizon is None else horizon, "vibration")
        known = ~np.isnan(ahead)
        now = self.bank.step(z[:, None])[:, 0]
        return z - np.where(known, now, 0.0), -np.where(known, ahead, 0.0)


def push_row(last: Array, newest: Array) -> None:
    """Put the newest row in front; the oldest one goes."""
    last[1:] = last[:-1].copy()
    last[0] = newest


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
            A wrong shape, an infinite number, an NGS frame that is not due: the frame is then not taken, and no command is given.
            Or an error of the law or the prediction.
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

    def amend(self, command: ArrayLike) -> None:
        """Take what the mirror was sent, (n_modes,) [um], where that is another command than the one of the last frame.

        Raises StepError for a wrong shape, or a number that is infinite or NaN: the command of the frame then stays.
        """
        command, is_known = self._check_frame(command, "amend: command", ago=1)
        if not is_known:
            raise StepError(f"{self.id}: amend: command has NaN; takes what the mirror was sent, finite numbers")
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
        forward, u = self._none, self._none.copy()
        with self._naming:
            if self.ahead is not None:
                z, forward = self.ahead.split(z)
            if self.law is not None:
                self.law.see_stars(stars)
                u = self.plant.mirror.clip_commands(self.law.command(z, slow, forward), self._commands[0])
                self.law.tell(u, forward)
        push_row(self._commands, u)
        self.frame += 1
        return u

    def settle(self) -> None:
        """Do what does not need to be done before the command is out; the next `update` does it otherwise."""
        if self.ahead is not None:
            with self._naming:
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
