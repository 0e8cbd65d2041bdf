"""Kalman filters on NGS frames, one fast step at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.mode_filter import ModeFilter
from wfsobs.observers.kalman.spread import FrameErrors
from wfsobs.observers.kalman.step import LinearEstimator, Plan, plan
from wfsobs.observers.step_checks import whole_frames
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.stepping import Saved
from wfsobs.typing import Array

Spread = Callable[[int, str, int], Array]


class FrameEstimator(LinearEstimator):
    """Kalman filters on NGS frames, their estimates spread over the fast steps between them.

    Parameters
    ----------
    modes : sequence of ModeFilter
        The slow filters, one per mode.
    truths : sequence of DisturbanceModel
        The models at the fast step.
    errors : sequence of FrameErrors
        Of the slow filters.
    spread : callable
        (mode, target, fast steps since the frame) -> row of the slow filter's state.
    holds : bool
        Whether an estimate is held until the next frame, so that any fraction of a frame is defined.
    """

    uses_ngs = True

    def __init__(
        self,
        modes: Sequence[ModeFilter],
        truths: Sequence[DisturbanceModel],
        errors: Sequence[FrameErrors],
        spread: Spread,
        holds: bool,
    ):
        super().__init__(modes)
        self.truths, self.errors, self._spread, self._holds = truths, errors, spread, holds
        self._since = -1
        self._pairs = [one.steady for one in errors]
        self._frame_plans: dict[tuple[int, float, str], Plan] = {}
        self._unknown = np.full(len(self.modes), np.nan)

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        if ngs is not None:
            self.bank.step(ngs[:, None])
            self._since = 0
            found = zip(self.errors, self._pairs, self.bank.near, strict=True)
            self._pairs = [one.steady if near is None else one.after(S, near.update) for one, S, near in found]
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
            return one.mean, self._unknown
        return one.mean, self._sd(one.rows, since + frames, target, self._pairs) if self.bank.is_near else one.sd[0]

    def estimate(self) -> tuple[Array, Array]:
        """Return the estimates (2, n_modes) of the last frame, and their standard deviations, (2, n_modes)."""
        values, sd = np.array([self.predict(0, target) for target in TARGETS]).swapaxes(0, 1)
        return values, sd

    def _plan(self, since: int, frames: float, ahead: int, target: str) -> Plan:
        n_modes, n = self.bank.x.shape
        rows = [self._spread(mode, target, since + ahead) for mode in range(n_modes)]
        self._frame_plans[since, frames, target] = out = plan(rows, n, np.zeros((1, n_modes)))
        out.sd[0] = self._sd(out.rows, since + frames, target, [one.steady for one in self.errors])
        return out

    def _sd(self, rows: Array, since: float, target: str, pairs: Sequence[Array]) -> Array:
        found = zip(self.errors, self.truths, self.modes, rows[:, 0], pairs, strict=True)
        return np.array([one.sd(m.outputs[target], row[: len(f.model.A)], since, S) for one, m, f, row, S in found])

    def reset(self) -> None:
        """Set the state back to before the first NGS frame."""
        super().reset()
        self._since = -1
        self._pairs = [one.steady for one in self.errors]

    def save(self) -> Saved:
        """Return a copy of the state."""
        return {**super().save(), "since": np.array(self._since), "pairs": np.array(self._pairs)}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        super().load(state)
        self._since = int(state["since"])
        self._pairs = list(np.array(state["pairs"]))

    def take_over(self, old: Any) -> None:
        """Go on from another design."""
        super().take_over(old)
        self._since = old._since
        self._pairs = [
            now.steady if near is None else was for now, was, near in zip(self.errors, old._pairs, self.bank.near, strict=True)
        ]
