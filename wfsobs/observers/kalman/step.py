"""Kalman filters one frame at a time: prediction by their model, any number of frames ahead, fractions included.

A process of poles exp(s_i T) with the continuous-time s_i goes on for f frames by A^f, the matrix power. With S the covariance of
the model and P that of the estimate after a measurement, the error of the prediction has the covariance

    A^f P A^f' + S - A^f S A^f'.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import fractional_matrix_power

from wfsobs.observers.missing import expected_rows
from wfsobs.observers.step_checks import StepError, whole_frames
from wfsobs.signal.filter_covariance import lyapunov
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.stepping import FilterBank, GainCycle, Saved
from wfsobs.typing import Array

Spread = Callable[[int, str, int], Array]
SpreadSd = Callable[[int, str, float, Array], float]


class ModeFilter(NamedTuple):
    """The filter of one mode.

    model    : of the disturbance, the first states of the filter
    gains    : of the filter
    posterior : covariance after the measurement, of every step that repeats; empty where it is not known
    """

    model: DisturbanceModel
    gains: GainCycle
    posterior: tuple[Array, ...] = ()


class Plan(NamedTuple):
    """A prediction of every mode: rows (n_modes, 1, n) of the state, mean (n_modes,) and sd (maps, n_modes), and their views."""

    rows: Array
    mean: Array
    product: Array
    sd: Array


def plan(rows: Sequence[Array], n: int, sd: Array) -> Plan:
    """Return the plan of rows of the states of the modes, padded to n states."""
    padded = np.zeros((len(rows), 1, n))
    for one, row in zip(padded, rows, strict=True):
        one[0, : len(row)] = row
    mean = np.zeros(len(rows))
    return Plan(padded, mean, mean[:, None, None], sd)


class LinearEstimator:
    """What Kalman filters share: a bank of filters in the state after the measurement, and rows of it per prediction."""

    horizon: float | None = None
    needs_command = False
    bridges = False

    def __init__(self, modes: Sequence[ModeFilter]):
        self.modes = tuple(modes)
        self.bank = FilterBank([mode.gains.estimator() for mode in modes])
        self._state = self.bank.x[:, :, None]
        self._expected = expected_rows([mode.gains for mode in modes])

    def settle(self) -> None:
        """Have nothing left to do."""

    def expectation(self) -> Array:
        """Return the expected next measurement of the LGS, (n_modes,) [um]."""
        return np.sum(self._expected * self.bank.x, axis=1)

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


class KalmanEstimator(LinearEstimator):
    """Kalman filters of all modes, of the LGS or of both sensors.

    Parameters
    ----------
    modes : sequence of ModeFilter
        One per mode.
    bridges : bool
        Whether missing LGS measurements are what the filter itself expects.
    """

    def __init__(self, modes: Sequence[ModeFilter], bridges: bool = False):
        super().__init__(modes)
        self.bridges = bridges
        self._plans: dict[tuple[float, str], Plan] = {}
        v = self.bank.v
        self._lgs, self._ngs = v[:, 0], v[:, 1] if v.shape[1] > 1 else None

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self._lgs[...] = z
        if self._ngs is not None:
            self._ngs[...] = 0.0 if ngs is None else ngs
        self.bank.advance()

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return (mean, sd) of the target."""
        one = self._plans.get((frames, target)) or self._plan(frames, target)
        np.matmul(one.rows, self._state, out=one.product)
        return one.mean, one.sd[self.bank.last]

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
    n, now = len(mode.model.A), mode.model.outputs[target]
    S = lyapunov(mode.model.A, mode.model.Q)
    return [float(np.sqrt(max(now @ S @ now - row @ (S - P[:n, :n]) @ row, 0.0))) for P in mode.posterior]


def matrix_power(A: Array, frames: float) -> Array:
    """Return A^frames, for a fraction by its continuous-time model. Raises StepError where it has none."""
    if frames == int(frames):
        return np.linalg.matrix_power(A, int(frames))
    out = fractional_matrix_power(A, frames)
    if np.iscomplexobj(out) and np.abs(out.imag).max() > 1e-9 * np.abs(out.real).max():
        raise StepError(f"frames = {frames:g}: the model has no continuous-time form; takes a whole number")
    return np.real(out)


class FrameEstimator(LinearEstimator):
    """Kalman filters on NGS frames, their estimates spread over the fast steps between them.

    Parameters
    ----------
    modes : sequence of ModeFilter
        The slow filters, one per mode.
    spread : callable
        (mode, target, fast steps since the frame) -> row of the slow filter's state.
    sd : callable
        (mode, target, fast steps from the frame to what is estimated, row) -> standard deviation of that estimate [um].
    held : bool
        Whether an estimate is held until the next frame, so that any fraction of a frame is defined.
    """

    def __init__(self, modes: Sequence[ModeFilter], spread: Spread, sd: SpreadSd, holds: bool):
        super().__init__(modes)
        self._spread, self._sd, self._holds = spread, sd, holds
        self._since = -1
        self._frame_plans: dict[tuple[int, float, str], Plan] = {}
        self._unknown = np.full(len(self.modes), np.nan)

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        if ngs is not None:
            self.bank.step(ngs[:, None])
            self._since = 0
        elif self._since >= 0:
            self._since += 1

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return the mean of the target; NaN before the first NGS frame."""
        ahead = 0 if self._holds else whole_frames(frames, "an estimate between NGS frames")
        since = max(self._since, 0)
        one = self._frame_plans.get((since, frames, target)) or self._plan(since, frames, ahead, target)
        np.matmul(one.rows, self._state, out=one.product)
        if self._since < 0:
            one.mean[...] = np.nan
        return one.mean, self._unknown if self._since < 0 else one.sd[0]

    def _plan(self, since: int, frames: float, ahead: int, target: str) -> Plan:
        n_modes, n = self.bank.x.shape
        rows = [self._spread(mode, target, since + ahead) for mode in range(n_modes)]
        sd = np.array([[self._sd(mode, target, since + frames, row) for mode, row in enumerate(rows)]])
        self._frame_plans[since, frames, target] = out = plan(rows, n, sd)
        return out

    def reset(self) -> None:
        """Set the state back to before the first NGS frame."""
        super().reset()
        self._since = -1

    def save(self) -> Saved:
        """Return a copy of the state."""
        return {**super().save(), "since": np.array(self._since)}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        super().load(state)
        self._since = int(state["since"])

    def take_over(self, old: Any) -> None:
        """Go on from another design."""
        super().take_over(old)
        self._since = old._since
