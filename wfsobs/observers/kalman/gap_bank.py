"""Kalman filters of several modes, one frame at a time, of which measurements may be missing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from wfsobs.signal.gap_gains import GapGains, GapStep
from wfsobs.signal.stepping import FilterBank, GainCycle, Saved
from wfsobs.typing import Array

STEADY, OPEN, CLOSED = range(3)
"""A mode after a step: in its steady state, near a gap, in the last step of that."""


class GapBank(FilterBank):
    """A bank of Kalman filters; NaN in `v` is a measurement that is missing.

    Parameters
    ----------
    gains : sequence of GainCycle
        Of the modes, in their steady state.
    make_gaps : callable
        Mode -> its gains near gaps; called when there is one.
    """

    def __init__(self, gains: Sequence[GainCycle], make_gaps: Callable[[int], GapGains]):
        super().__init__([one.estimator() for one in gains])
        self._sizes = [len(one.steps[0].A) for one in gains]
        self.has_first, self._repeat = gains[0].first is not None, len(gains[0].steps)
        self._make_gaps = make_gaps
        self._gaps: dict[int, GapGains] = {}
        self.near: list[GapStep | None] = [None] * len(gains)
        self.is_near = False

    def advance(self) -> Array:
        """Take the inputs that have been written to `v`, NaN where there is none."""
        if self.is_near or np.isnan(self.v).any():
            self._advance_near()
            return self._e
        return super().advance()

    def _advance_near(self) -> None:
        there = ~np.isnan(self.v)
        self.v[~there] = 0.0
        is_first = self.has_first and self.phase == 0
        if is_first:
            there[:, 1:] = False  # it has no NGS frame, and is the step of the cycle before the first one
        due, j = np.array([not (is_first and i) for i in range(there.shape[1])]), (self.phase - self.has_first) % self._repeat
        before, v = self.x.copy(), self.v.copy()
        super().advance()
        for mode, (n, seen) in enumerate(zip(self._sizes, there, strict=True)):
            last = self.near[mode]
            last = None if last is None or last.is_last else last
            if last is None and (seen == due).all():
                self.near[mode] = None
                continue
            if mode not in self._gaps:
                self._gaps[mode] = self._make_gaps(mode)
            step = self.near[mode] = self._gaps[mode].after(last, j, tuple(map(bool, seen)))
            self.x[mode, :n] = step.update @ np.concatenate([before[mode, :n], v[mode]])
        self.is_near = any(one is not None for one in self.near)

    @property
    def last_in_cycle(self) -> int:
        """Which step of the cycle came last."""
        return (self.last - self.has_first) % self._repeat

    def set_near(self, mode: int, step: GapStep | None) -> None:
        """Go on from a step near a gap, of the same model."""
        self.near[mode] = step
        self.is_near = any(one is not None for one in self.near)

    def reset(self) -> None:
        """Set the state back to rest."""
        super().reset()
        self._settle()

    def _settle(self) -> None:
        self.near[:] = [None] * len(self.near)
        self.is_near = False

    def save(self) -> Saved:
        """Return a copy of the state."""
        n = self.x.shape[1]
        kind, covariance = np.zeros(len(self.near), dtype=int), np.zeros((len(self.near), n, n))
        for mode, step in enumerate(self.near):
            if step is not None:
                kind[mode] = CLOSED if step.is_last else OPEN
                covariance[mode, : self._sizes[mode], : self._sizes[mode]] = step.posterior
        return {**super().save(), "near": kind, "covariance": covariance}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        super().load(state)
        self._settle()
        for mode, (kind, covariance) in enumerate(zip(state["near"], state["covariance"], strict=True)):
            if kind != STEADY:
                n = self._sizes[mode]
                self.set_near(mode, GapStep(covariance[:n, :n].copy(), np.zeros((n, 0)), kind == CLOSED))
