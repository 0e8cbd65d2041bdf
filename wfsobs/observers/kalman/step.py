"""Kalman filters one frame at a time: prediction by their model, any number of frames ahead, fractions included.

A process of poles exp(s_i T) with the continuous-time s_i goes on for f frames by A^f, the matrix power. With S the covariance of
the model and P that of the estimate after a measurement, the error of the prediction has the covariance

    A^f P A^f' + S - A^f S A^f'.

A measurement that is missing is NaN. Near it the gains are those of the covariance as it is there (`wfsobs.signal.gap_gains`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import fractional_matrix_power

from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.gap_bank import GapBank
from wfsobs.observers.kalman.mode_filter import ModeFilter, StatedErrors
from wfsobs.observers.step_checks import StepError
from wfsobs.signal.filter_covariance import lyapunov
from wfsobs.signal.gap_gains import GapGains
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.stepping import Saved
from wfsobs.typing import Array


class Plan(NamedTuple):
    """A prediction of every mode: rows (n_modes, 1, n) of the state, mean (n_modes,) and sd (maps, n_modes)."""

    rows: Array
    mean: Array
    sd: Array

    @property
    def product(self) -> Array:
        """The mean as products of rows and states have it, (n_modes, 1, 1): a view."""
        return self.mean[:, None, None]


def plan(rows: Sequence[Array], n: int, sd: Array) -> Plan:
    """Return the plan of rows of the states of the modes, padded to n states."""
    padded = np.zeros((len(rows), 1, n))
    for one, row in zip(padded, rows, strict=True):
        one[0, : len(row)] = row
    return Plan(padded, np.zeros(len(rows)), sd)


class LinearEstimator:
    """What Kalman filters share: a bank of filters in the state after the measurement, and rows of it per prediction."""

    horizon: float | None = None
    needs_command = False

    def __init__(self, modes: Sequence[ModeFilter]):
        self.modes = tuple(modes)
        self.bank = GapBank([mode.gains for mode in modes], self._gaps, [mode.mean for mode in modes])
        self._of_equal: dict[bytes, GapGains] = {}

    @property
    def _state(self) -> Array:
        return self.bank.x[:, :, None]

    def _gaps(self, mode: int) -> GapGains:
        """Return the gains near gaps of a mode; modes of equal models share them."""
        model = self.modes[mode].digest()
        return self._of_equal.setdefault(model, self._of_equal.get(model) or self.modes[mode].gaps())

    def settle(self) -> None:
        """Have nothing left to do."""

    def reset(self) -> None:
        """Set the state back to rest."""
        self.bank.reset()

    def save(self) -> Saved:
        """Return a copy of the state."""
        return self.bank.save()

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        self.bank.load(state)

    def take_over(self, old: Any) -> None:
        """Go on from another design."""
        self.bank.phase, self.bank.last = old.bank.phase, old.bank.last
        for mode, (new, was) in enumerate(zip(self.modes, old.modes, strict=True)):
            x = old.bank.x[mode, : len(was.model.A)]
            self.bank.x[mode, : len(new.model.A)] = carry_state(new.model, was.model, x)
            self.bank.take_near(mode, old.bank if new.digest() == was.digest() else None)


class KalmanEstimator(LinearEstimator):
    """Kalman filters of all modes, of the LGS or of both sensors.

    Parameters
    ----------
    modes : sequence of ModeFilter
        One per mode.
    """

    def __init__(self, modes: Sequence[ModeFilter]):
        super().__init__(modes)
        self._plans: dict[tuple[float, str], Plan] = {}
        self._variances: dict[int, Array] = {}
        self._record: tuple[Array, Array, list[StatedErrors]] | None = None

    @property
    def uses_ngs(self) -> bool:
        """Whether it takes NGS frames."""
        return self.bank.v.shape[1] > 1

    def see_stars(self, count: int | None) -> None:
        """Take the LGS measurement of the next frame for the mean over so many stars; None for all."""
        self.bank.stars = count

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        v = self.bank.v
        v[:, 0] = z
        if v.shape[1] > 1:
            v[:, 1] = 0.0 if ngs is None else ngs
        self.bank.advance()

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return (mean, sd) of the target."""
        one = self._plans.get((frames, target)) or self._plan(frames, target)
        np.matmul(one.rows, self._state, out=one.product)
        sd = one.sd[self.bank.last]
        return one.mean, self._near_gap(one, sd, target) if self.bank.is_near else sd

    def estimate(self) -> tuple[Array, Array]:
        """Return the estimates of the last frame, (2, n_modes), and what `StatedErrors` says of them, (4, n_modes)."""
        if self._record is None:
            n = self.bank.x.shape[1]
            rows = [np.pad(one.rows(TARGETS), ((0, 0), (0, n - len(one.gains.steps[0].A)))) for one in self.modes]
            steady = np.stack([one.steady_sd() for one in self.modes], axis=-1)
            self._record = np.array(rows), steady, [one.stated_errors() for one in self.modes]
        rows, steady, stated = self._record
        j = self.bank.last_in_cycle
        sd = steady[j].copy() if self.bank.last or not self.bank.has_first else np.full(steady[j].shape, np.nan)
        for mode, near in enumerate(self.bank.near):
            if near is not None:
                if near.sd is None:
                    near.sd = stated[mode].sd(near.posterior, j)
                sd[:, mode] = near.sd
        return (rows @ self._state)[:, :, 0].T, sd

    def _near_gap(self, plan: Plan, steady: Array, target: str) -> Array:
        """Return the standard deviations where some modes are near a gap."""
        out = steady.copy()
        for mode, (near, row) in enumerate(zip(self.bank.near, plan.rows[:, 0], strict=True)):
            if near is not None:
                model = self.modes[mode].model
                if mode not in self._variances:
                    self._variances[mode] = lyapunov(model.A, model.Q)
                out[mode] = prediction_sd(model.outputs[target], row[: len(model.A)], self._variances[mode], near.posterior)
        return out

    def _plan(self, frames: float, target: str) -> Plan:
        powers = [matrix_power(mode.model.A, frames) for mode in self.modes]
        rows = [mode.model.outputs[target] @ power for mode, power in zip(self.modes, powers, strict=True)]
        sd = np.full((len(self.bank.maps), len(rows)), np.nan)
        if self.modes[0].posterior:
            repeat = len(self.modes[0].posterior)
            sd[-repeat:] = np.array([_prediction_sd(m, row, target) for m, row in zip(self.modes, rows, strict=True)]).T
        self._plans[frames, target] = out = plan(rows, self.bank.x.shape[1], sd)
        return out

    def take_over(self, old: Any) -> None:
        """Go on from another design; the states of LGS error and NGS frame stay as they are."""
        super().take_over(old)
        for mode, (new, was) in enumerate(zip(self.modes, old.modes, strict=True)):
            rest = self.bank.x[mode, len(new.model.A) :]
            others = old.bank.x[mode, len(was.model.A) :]
            if rest.shape == others.shape:
                rest[...] = others


def carry_state(new: DisturbanceModel, old: DisturbanceModel, x: Array) -> Array:
    """Return the state of another model in which the disturbance is what it is in the state x (n,) of the old one.

    With as many processes each has the same phi[k] and phi[k-1], else turbulence and vibration have as a whole. Of all such
    states it is the most likely one: coordinates are uncorrelated and of unit variance.
    """
    rows = [one.pairs if new.pairs.shape == old.pairs.shape else _sums(one) for one in (new, old)]
    return np.linalg.lstsq(rows[0], rows[1] @ x, rcond=1e-12)[0]


def _sums(model: DisturbanceModel) -> Array:
    """Rows (4, n) that give turbulence and vibration now and one step ago."""
    now, before = model.pairs[::2], model.pairs[1::2]
    is_turbulence = (now @ model.outputs["turbulence"] > 0.0).astype(float)
    return np.array([weight @ rows for weight in (is_turbulence, 1.0 - is_turbulence) for rows in (now, before)])


def _prediction_sd(mode: ModeFilter, row: Array, target: str) -> list[float]:
    """Return the standard deviation [um] of the prediction `row` of the model's state, for every step that repeats."""
    S = lyapunov(mode.model.A, mode.model.Q)
    return [prediction_sd(mode.model.outputs[target], row, S, P) for P in mode.posterior]


def prediction_sd(now: Array, row: Array, S: Array, P: Array) -> float:
    """Return the standard deviation of row x_hat for now x.

    now, row : (n,)
    S        : covariance of the disturbance, (n, n)
    P        : covariance after the measurement, (n, n) or of a longer state
    """
    n = len(S)
    return float(np.sqrt(max(now @ S @ now - row @ (S - P[:n, :n]) @ row, 0.0)))


def matrix_power(A: Array, frames: float) -> Array:
    """Return A^frames, for a fraction by its continuous-time model. Raises StepError where it has none."""
    if frames == int(frames):
        return np.linalg.matrix_power(A, int(frames))
    out = fractional_matrix_power(A, frames)
    if np.iscomplexobj(out) and np.abs(out.imag).max() > 1e-9 * np.abs(out.real).max():
        raise StepError(f"frames = {frames:g}: the model has no continuous-time form; takes a whole number")
    return np.real(out)
