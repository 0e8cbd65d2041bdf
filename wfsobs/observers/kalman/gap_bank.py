"""Kalman filters of several modes, one frame at a time, of which measurements may be missing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from wfsobs.signal.gap_gains import GapGains, GapStep, SensorMean
from wfsobs.signal.stepping import FilterBank, GainCycle, Saved
from wfsobs.typing import Array

STEADY, OPEN, CLOSED = range(3)
"""A mode after a step: in its steady state, near a gap, in the last step of that."""


class GapBank(FilterBank):
    """A bank of Kalman filters; NaN in `v` is a measurement that is missing.

    Attributes
    ----------
    stars : int or None
        Sensors that the first measurement of the next step is the mean over; None for all.

    Parameters
    ----------
    gains : sequence of GainCycle
        Of the modes, in their steady state.
    make_gaps : callable
        Mode -> its gains near gaps; called when there is one.
    means : sequence of SensorMean
        The sensors of the first measurement, by mode.
    """

    def __init__(self, gains: Sequence[GainCycle], make_gaps: Callable[[int], GapGains], means: Sequence[SensorMean]):
        super().__init__([one.estimator() for one in gains])
        self._sizes = [len(one.steps[0].A) for one in gains]
        self.stars: int | None = None
        self._all = [len(one.noise) for one in means]
        self._beside = np.zeros((len(gains), max(len(one.A) for one in means)))  # states that the mean over all does not see
        self._wide = [n + len(one.A) for n, one in zip(self._sizes, means, strict=True)]
        self.has_first, self._repeat = gains[0].first is not None, len(gains[0].steps)
        self._make_gaps = make_gaps
        self._gaps: dict[int, GapGains] = {}
        self.near: list[GapStep | None] = [None] * len(gains)
        self.is_near = False

    def advance(self) -> Array:
        """Take the inputs that have been written to `v`, NaN where there is none."""
        if self.is_near or self.stars is not None or np.isnan(self.v).any():
            self._advance_near()
            return self._e
        return super().advance()

    def _advance_near(self) -> None:
        there, stars = (~np.isnan(self.v)).astype(int), self.stars
        self.v[there == 0] = 0.0
        is_first = self.has_first and self.phase == 0
        if is_first:
            there[:, 1:] = 0  # it has no NGS frame, and is the step of the cycle before the first one
        others, j = [int(not is_first)] * (there.shape[1] - 1), (self.phase - self.has_first) % self._repeat
        before, v = self.x.copy(), self.v.copy()
        super().advance()
        for mode, (n, seen) in enumerate(zip(self._sizes, there, strict=True)):
            last, most, extra = self.near[mode], self._all[mode], self._wide[mode] - n
            last = None if last is None or last.is_last else last
            seen[0] *= most if stars is None else min(stars, most)
            if last is None:
                self._beside[mode] = 0.0
                if seen.tolist() == [most, *others]:
                    self.near[mode] = None
                    continue
            if mode not in self._gaps:
                self._gaps[mode] = self._make_gaps(mode)
            step = self.near[mode] = self._gaps[mode].after(last, j, tuple(seen.tolist()))
            after = step.update @ np.concatenate([before[mode, :n], self._beside[mode, :extra], v[mode]])
            self.x[mode, :n], self._beside[mode, :extra] = after[:n], after[n:]
        self.is_near = any(one is not None for one in self.near)

    @property
    def last_in_cycle(self) -> int:
        """Which step of the cycle came last."""
        return (self.last - self.has_first) % self._repeat

    def take_near(self, mode: int, old: GapBank | None) -> None:
        """Go on near a gap as another bank, of the same model in this mode; None for a steady state."""
        self.near[mode] = None if old is None else old.near[mode]
        self._beside[mode] = 0.0 if old is None else old._beside[mode]
        self.is_near = any(one is not None for one in self.near)

    def reset(self) -> None:
        """Set the state back to rest."""
        super().reset()
        self._settle()

    def _settle(self) -> None:
        self.near[:] = [None] * len(self.near)
        self.is_near, self.stars = False, None
        self._beside[...] = 0.0

    def save(self) -> Saved:
        """Return a copy of the state."""
        n = max(self._wide)
        kind, covariance = np.zeros(len(self.near), dtype=int), np.zeros((len(self.near), n, n))
        for mode, step in enumerate(self.near):
            if step is not None:
                kind[mode] = CLOSED if step.is_last else OPEN
                covariance[mode, : self._wide[mode], : self._wide[mode]] = step.posterior
        beside = {"beside": self._beside.copy()} if self._beside.size else {}
        return {**super().save(), "near": kind, "covariance": covariance, **beside}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        super().load(state)
        self._settle()
        if self._beside.size:
            self._beside[...] = state["beside"]
        for mode, (kind, covariance) in enumerate(zip(state["near"], state["covariance"], strict=True)):
            if kind != STEADY:
                n = self._wide[mode]
                self.near[mode], self.is_near = GapStep(covariance[:n, :n].copy(), np.zeros((n, 0)), kind == CLOSED), True
