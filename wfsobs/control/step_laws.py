"""The laws of a controller one frame at a time, and the prediction of the vibration beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from wfsobs.control.law import Law
from wfsobs.control.mirror import Mirror, Plant
from wfsobs.observers.kalman.step import carry_state
from wfsobs.observers.step import Estimator
from wfsobs.observers.step_checks import StepError
from wfsobs.prior import Bands, Prior
from wfsobs.record import Sampling
from wfsobs.signal.bandpass import bandpass_bank, bank_recursion
from wfsobs.signal.stepping import FilterBank, Recursion, Saved, Stateful
from wfsobs.typing import Array

StepPredict = Callable[[Prior, Plant, Any, Sampling], Estimator]
"""(prior, plant, settings, sampling) -> predictor of the vibration while the command of the frame acts."""


class StepLaw(Stateful, Protocol):
    """The laws of all modes, one frame at a time."""

    def command(self, z: Array, ngs: Array | None, forward: Array) -> Array:
        """Return the commands (n_modes,) [um] that the laws want, `forward` included."""
        ...

    def tell(self, command: Array, forward: Array) -> None:
        """Tell what the mirror took of them."""
        ...

    def take_over(self, old: Any) -> None:
        """Go on from the state of other laws. Raises StepError."""
        ...


class LinearLaws:
    """Laws as filters of z."""

    def __init__(self, laws: Sequence[Law]):
        self.laws = tuple(laws)
        self.bank = FilterBank([Recursion(law.cycle.steps, law.first) for law in laws])
        self._v = np.zeros((len(laws), laws[0].cycle.steps[0][1].shape[1]))

    def command(self, z: Array, ngs: Array | None, forward: Array) -> Array:
        """Return what the filters give."""
        v = self._v
        v[:, 0] = z
        if v.shape[1] > 1:
            v[:, 1] = 0.0 if ngs is None else ngs
        return self.bank.step(v)[:, 0] + forward

    def tell(self, command: Array, forward: Array) -> None:
        """Take no notice: z holds none of the commands."""

    def take_over(self, old: Any) -> None:
        """Go on where the disturbance is in the old laws' states; laws of no model take over a state of the same size."""
        if not isinstance(old, LinearLaws) or len(old.bank.maps) != len(self.bank.maps):
            raise StepError("the laws are of another kind")
        self.bank.phase, self.bank.last = old.bank.phase, old.bank.last
        for x, was, law, before in zip(self.bank.x, old.bank.x, self.laws, old.laws, strict=True):
            if law.model is not None and before.model is not None:
                n, m = len(law.model.A), len(before.model.A)
                x[:n] = carry_state(law.model, before.model, was[:m])
                if len(x) - n == len(was) - m:
                    x[n:] = was[m:]
            elif x.shape == was.shape:
                x[...] = was
            else:
                raise StepError("the laws have states of another size")

    def reset(self) -> None:
        """Set the state back to rest."""
        self.bank.reset()

    def save(self) -> Saved:
        """Return a copy of the state."""
        return self.bank.save()

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        self.bank.load(state)


class Integrators:
    """Integrators whose state are their own commands, so that a limit of the mirror stops them (anti-windup)."""

    def __init__(self, laws: Sequence[Law], mirror: Mirror):
        self.laws = tuple(laws)
        self._gain = np.array([law.gain for law in laws])
        self._leak = np.array([law.leak for law in laws])
        self._taps = mirror.taps[1:]
        self._own = np.zeros((len(self._taps), len(laws)))  # newest first

    def command(self, z: Array, ngs: Array | None, forward: Array) -> Array:
        """Return leak u - g y, y the measurement with the integrator's own commands alone."""
        return self._leak * self._own[0] - self._gain * (z + self._taps @ self._own) + forward

    def tell(self, command: Array, forward: Array) -> None:
        """Go on from what the mirror took."""
        push_row(self._own, command - forward)

    def take_over(self, old: Any) -> None:
        """Go on from the last commands."""
        if not isinstance(old, Integrators) or old._own.shape != self._own.shape:
            raise StepError("the laws are of another kind")
        self._own[...] = old._own

    def reset(self) -> None:
        """Set the state back to rest."""
        self._own[...] = 0.0

    def save(self) -> Saved:
        """Return a copy of the state."""
        return {"own": self._own.copy()}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        self._own[...] = state["own"]


class VibrationAhead:
    """What the vibration will be while the command of a frame acts, and the part of z that this corrects (`control.base`)."""

    def __init__(self, estimator: Estimator, bands: Bands, sampling: Sampling):
        self.estimator = estimator
        self.bank = FilterBank(
            [bank_recursion(bandpass_bank(bands.frequencies, bands.bandwidth_online, bands.order, sampling.dt))]
            * sampling.n_modes
        )
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
