"""One filter of all modes on the LGS, each by itself or together, and on the NGS frames: its states, frame by frame.

The weights are those of the LGS that are there, of the NGS alone where none is, and what is stated of the errors is by them. They
are made when a set of LGS first occurs. The states of one that is out go on with the measurements that the others predict for it,
so that it can come back at any time. One of which a mode is missing is out. While an NGS frame is lost the weights are those of
the frames before it; when the next comes, or after several, the filter of the frames takes for it what all states told of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from wfsobs.observers.kalman.asterism_filters import Beginning
from wfsobs.observers.kalman.asterism_model import AsterismModel
from wfsobs.observers.step_checks import StepError
from wfsobs.signal.present_inputs import Present
from wfsobs.signal.stepping import Saved
from wfsobs.typing import Array

PLANS = 64
"""Weights that are kept, of a target, a horizon and a set of LGS each; others are computed anew."""

AWAITED = 4
"""NGS frames that may be lost in a row until what was told of the first of them is taken for it."""

FIRST, WITHOUT = -2, -1
"""Phases of the filter before its first step, and before its first NGS frame."""


class _Bank:
    """Filters of several modes, padded to the longest: F (n_modes, n, n), G, first and is_state (n_modes, n)."""

    def __init__(self, modes: Sequence[Beginning]):
        sizes = np.array([len(one.first) for one in modes])
        n = int(sizes.max())
        self.is_state = np.arange(n) < sizes[:, None]
        self.F, self.G, self.first = np.zeros((len(modes), n, n)), np.zeros((len(modes), n)), np.zeros((len(modes), n))
        for i, (one, first) in enumerate(modes):
            self.F[i, : sizes[i], : sizes[i]], self.G[i, : sizes[i]], self.first[i, : sizes[i]] = *one, first

    def begin(self, y: Array) -> Array:
        """Return the state after a first measurement (..., n_modes), (..., n_modes, n)."""
        x = self.first * y[..., None]
        return x + np.where(self.first == 0.0, self.G * y[..., None], 0.0)

    def advance(self, x: Array, y: Array) -> Array:
        """Return the state after a measurement."""
        return (self.F @ x[..., None])[..., 0] + self.G * y[..., None]


class JointEstimator:
    """The filter one frame at a time.

    Attributes
    ----------
    x : Array
        States of the LGS: of their mean, then of each difference, (n_lgs, n_modes, n).
    frames : Array
        States of the NGS, (n_modes, n).
    present : tuple of bool
        Which LGS are in the last measurement, (n_lgs,).
    stand_in_frames : Array
        What the states tell of the last NGS frames, where these are lost, the first of them first, (AWAITED, n_modes) [um].
    phase : int
        Steps since the last NGS frame, or what stands for one; WITHOUT before the first that came, FIRST before the first step.
    """

    horizon: float | None = None
    needs_command = False

    def __init__(self, model: AsterismModel):
        self.model = model
        self._fast, self._slow = _Bank(model.fast), _Bank(model.slow)
        self.x = np.zeros((model.n_stars, *self._slow.first.shape[:1], self._fast.first.shape[1]))
        self.frames, self.stand_in_frames = np.zeros(self._slow.first.shape), np.zeros((AWAITED, len(self._slow.first)))
        late = lru_cache(AWAITED)(model.late)

        def compute(n_lost: int, name: str, *details: Any) -> Any:
            return getattr(late(n_lost) if n_lost else model, name)(*details)

        self._of_model = lru_cache(PLANS)(compute)
        self.present: Present = ()
        self.reset()

    def advance_each(self, each: Array, ngs: Array | None) -> None:
        """Take the measurement of every LGS, (n_lgs, n_modes) [um], and the NGS frame that is due; NaN is missing."""
        missing = np.isnan(each)
        each = self._complete(each, missing) if missing.any() else each
        self.present = _as_set(missing)
        seen = self.model.basis @ each
        if self.phase == FIRST:
            self.x, self.phase = self._fast.begin(seen), WITHOUT
        else:
            self.x = self._fast.advance(self.x, seen)
        if ngs is not None:
            self._take_frame(ngs)
        elif self.phase >= 0:
            self.phase += 1

    def _take_frame(self, ngs: Array) -> None:
        """Take the NGS frame that is due, (n_modes,) [um]."""
        is_lost = bool(np.isnan(ngs).any())
        if self.phase < 0:
            if not is_lost:
                self.frames, self.phase = self._slow.begin(ngs), 0
            return
        given_up = max(self.n_lost - AWAITED + 1, 0) if is_lost else self.n_lost
        for one in self.stand_in_frames[:given_up]:
            self.frames = self._slow.advance(self.frames, one)
        if is_lost:
            n, self.stand_in_frames = self.n_lost - given_up, np.roll(self.stand_in_frames, -given_up, axis=0)
            self.stand_in_frames[n] = self._of_model(n + 1, "frame", self.present) @ self.state()
            self.phase = (n + 1) * self.model.ratio
        else:
            self.frames, self.phase = self._slow.advance(self.frames, ngs), 0

    @property
    def n_lost(self) -> int:
        """Number of NGS frames that were due last and did not come, and for which nothing has been taken yet."""
        return max(self.phase, 0) // self.model.ratio

    def _now(self, name: str, *details: Any) -> Any:
        """Return what the model has of that name in this step, for the LGS that are there."""
        found, at = self._of_model(self.n_lost, name, *details, self.present), self.phase - self.n_lost * self.model.ratio
        return (found[0][at], found[1][at]) if isinstance(found, tuple) else found[at]

    def _complete(self, each: Array, missing: Array) -> Array:
        """Return the measurements with what the last frame predicts in the place of those that are missing.

        In the first frame that is the mean of the other LGS, or zero.
        """
        if self.phase == FIRST:
            there = np.maximum(np.count_nonzero(~missing, axis=0), 1)
            return np.where(missing, np.where(missing, 0.0, each).sum(axis=0) / there, each)
        return np.where(missing, self._now("stand_ins") @ self.state(), each)

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return (mean, sd) of the target."""
        weights, sd = self._now("plan", frames, target)
        return weights @ self.state(), sd

    def next_z_sd(self) -> Array:
        """Return the standard deviation of the next z less the sum of both estimates, (n_modes,) [um]."""
        return self._now("next_z_sd")

    def state(self) -> Array:
        """Return all states in the order of the weights, (n_states,)."""
        return np.concatenate([self.x[:, self._fast.is_state].ravel(), self.frames[self._slow.is_state]])

    def settle(self) -> None:
        """Have nothing left to do."""

    def reset(self) -> None:
        """Set the state back to rest."""
        self.x[...], self.frames[...], self.stand_in_frames[...], self.phase = 0.0, 0.0, 0.0, FIRST
        self.present = (True,) * self.model.n_stars

    def save(self) -> Saved:
        """Return a copy of the state."""
        return {
            "x": self.x.copy(),
            "frames": self.frames.copy(),
            "stand_in_frames": self.stand_in_frames.copy(),
            "phase": np.array(self.phase),
            "present": np.array(self.present, dtype=float),
        }

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        self.x[...], self.frames[...], self.stand_in_frames[...] = state["x"], state["frames"], state["stand_in_frames"]
        self.phase, self.present = int(state["phase"]), _as_set(state["present"][:, None] == 0.0)

    def take_over(self, old: Any) -> None:
        """Go on from another design. Raises StepError where that has other states."""
        if old.x.shape != self.x.shape or old.frames.shape != self.frames.shape:
            raise StepError("its states are not those of the other design")
        self.load(old.save())


def _as_set(missing: Array) -> Present:
    """Return the LGS of which no mode is missing, from (n_lgs, n_modes)."""
    return tuple(not any(one) for one in missing)
