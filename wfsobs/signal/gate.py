"""A gate: measurements that their own past excludes are missing, or clipped, before any observer or controller receives them.

Every mode of a sensor is predicted one step ahead by an autoregression, fitted by least squares to what has passed so far, anew
every `BLOCK` samples. A measurement further than `level` deviations from its prediction is an outlier; the deviation is the
running median of the magnitudes of the prediction errors themselves, since under a wrong model a stated one is wrong. The level
is higher where outliers are rare, since nearly all that is far out is then noise. After five
in a row the level has moved, or a vibration has appeared: the gate is open for `OPEN` samples, and all pass. No filter starves:
never more than a fifth of the samples of a mode is rejected for long. The prediction is of the measurements alone, so that one
gate serves every observer. Of a slower sensor, between two frames of which the disturbance moves far, it is the difference from a
faster one that is tested.

Least squares with a memory: Ljung, System Identification, section 11.2. The clipped innovation: Huber, Robust Statistics.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from wfsobs.typing import Array

ORDER = 64
"""Past samples that predict the next one."""
BLOCK = 128
"""Samples between two fits; in the first block all pass, and until two, rounded, are measured the last sample is the prediction:
fewer are too few for a fit of so many weights, which would reject a clean record's turbulence."""
MEMORY = 64
"""Blocks after which a sample has 1/e of its weight in the fit."""
FORGET = 0.1
"""Part of the count of rejected samples that is forgotten with every sample."""
LASTING = 4.0
"""Count beyond which the gate opens: that of RUN in a row."""
RUN = 5
"""Outliers in a row that are a new level, and missing samples in a row after which the gate is open as well: what then comes is
not known well enough."""
OPEN = 20
"""Samples that pass then, while the deviation is doubled."""
EARLY = 1.0
"""Relative increase of the level, times the square of the number of blocks fitted to: a fit to few samples predicts badly."""
EARLIEST = 3.0
"""Relative increase of the level until the first fit."""
PACE = 0.125
"""Weight of a block in the deviation, by its median, and in the part of samples that are outliers."""
USUAL, RAREST, START = 1e-2, 5e-5, 1e-3
"""Part of samples that are outliers: where the level is as stated, the least that is believed, and before the first block."""
RARITY = 0.0625
"""Power by which the level rises where outliers are rarer, without a logarithm: at the default within 4 % of the level at which
a sample is as likely an outlier as noise, sqrt(level^2 + 2 log(USUAL / part))."""
MEDIAN = 0.6745
"""Median of the magnitude of a Gaussian variable, over its standard deviation."""
RIDGE = 1e-12
"""Part of the trace that is added to the diagonal of the normal equations."""
FIRST = 2.0
"""Levels beyond which a sample of the first block is kept out of the fit."""


@dataclass(frozen=True)
class GateSettings:
    """What a gate does.

    level  : deviations of the prediction error beyond which a measurement is an outlier where 1 % are, more where fewer are
    action : "reject", it is missing, or "clip", it is taken at that level
    """

    level: float = 3.6
    action: Literal["reject", "clip"] = "reject"


class OutlierGate:
    """The gate of one sensor, one sample of all modes at a time.

    Attributes
    ----------
    outliers : Array
        Outliers so far, (n_modes,).
    count : int
        Samples so far.

    Parameters
    ----------
    n_modes : int
        Number of modes.
    settings : GateSettings
        What it does.
    """

    settings: GateSettings
    count: int
    outliers: Array

    def __init__(self, n_modes: int, settings: GateSettings):
        self.settings, self._n_modes = settings, n_modes
        self.reset()

    def reset(self) -> None:
        """Go back to before the first sample."""
        n = self._n_modes
        self.count, self.outliers = 0, np.zeros(n, dtype=int)
        self._offset = np.zeros(n)
        self._part, self._outliers_before = np.full(n, START), np.zeros(n, dtype=int)  # of outliers; those before this block
        self._past = np.zeros((n, ORDER + BLOCK))  # ORDER samples before this block, and its own, less the offset
        self._normal = np.zeros((n, ORDER + 1, ORDER + 1))
        self._rows = np.zeros(n, dtype=int)  # samples fitted to until the first fit, then all
        self._weights = np.zeros((n, ORDER))  # of the oldest sample first
        self._weights[:, -1] = 1.0  # until there is a fit the last one is held
        self._deviation, self._out_count, self._open = np.full(n, np.inf), np.zeros(n), np.zeros(n, dtype=int)
        self._gap, self._settling = np.zeros(n, dtype=int), np.zeros(n, dtype=int)  # samples missing in a row; left after a gap
        self._errors, self._is_usual = np.zeros((n, BLOCK)), np.zeros((n, BLOCK), dtype=bool)
        self._level: Array = self._find_level()

    def check(self, z: Array, *, settles: bool = True) -> Array:
        """Return z (n_modes,) [um] with outliers NaN, or clipped; NaN is missing. settles : or else `settle` has to follow."""
        if self.count == 0:
            self._offset = np.nan_to_num(z)
        k, limit = self.count % BLOCK, self._limit()
        expected = self._offset + np.einsum("mi,mi->m", self._weights, self._past[:, k : k + ORDER])
        error, is_there = z - expected, ~np.isnan(z)
        is_after_gap = is_there & (self._gap >= RUN)
        for mode in np.flatnonzero(is_after_gap).tolist():
            self._bridge(mode, k, error[mode])
        self._open = np.where(is_after_gap, OPEN, self._open)
        self._settling = np.where(is_after_gap, OPEN, np.maximum(self._settling - 1, 0))
        self._gap = np.where(is_there, 0, self._gap + 1)
        is_outlier = (np.abs(error) > limit) & (self._open == 0)
        is_clipped = self.settings.action == "clip"
        kept = np.where(is_outlier, np.clip(error, -limit, limit) if is_clipped else np.nan, error)
        self._errors[:, k], self._is_usual[:, k] = error, is_there & ~is_outlier & (self._settling == 0)
        self._past[:, ORDER + k] = expected - self._offset + np.nan_to_num(kept)
        self._count(is_outlier)
        if settles:
            self.settle()
        return np.where(is_outlier, expected + kept, z)

    def check_beside(self, z: Array, beside: Array, *, settles: bool = True) -> Array:
        """Return z (n_modes,) [um] as `check`, tested by its difference from `beside`; where that is NaN it passes."""
        passed = let_through(z, z - beside, self.check(z - beside, settles=settles))
        return np.where(np.isnan(beside), z, passed)

    def settle(self) -> None:
        """Fit after the last sample of a block: the part of the work that can wait."""
        if self.count % BLOCK == 0:
            self._fit()

    def check_all(self, z: Array) -> Array:
        """Return samples z (n, n_modes) [um] as `check` does one by one; all that pass between two outliers at once."""
        out, k = z.copy(), 0
        while k < len(z):
            n = (
                0
                if self.count == 0 or self._open.any() or (self._gap >= RUN).any()
                else self._pass(z[k : k + BLOCK - self.count % BLOCK])
            )
            if n == 0:
                out[k] = self.check(z[k])
            k += max(n, 1)
        return out

    def save(self) -> dict[str, Array]:
        """Return a copy of the state."""
        return {name.lstrip("_"): np.array(getattr(self, name)) for name in STATE}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        for name in STATE:
            setattr(self, name, np.array(state[name.lstrip("_")]))
        self.count = int(self.count)
        self._level = self._find_level()

    def _limit(self) -> Array:
        return self._level * self._deviation

    def _find_level(self) -> Array:
        """Return the limit over the deviation, (n_modes,), which stays from one fit to the next."""
        rarity = (USUAL / np.clip(self._part, RAREST, USUAL)) ** RARITY
        blocks = self._blocks()
        early = np.where(blocks > 1, EARLY / np.maximum(blocks, 1) ** 2, EARLIEST)
        return self.settings.level * rarity * (1.0 + early)

    def _blocks(self) -> Array:
        """Return the blocks that the weights are fitted to, rounded: what is missing before the first fit is none of them."""
        return (self._rows + BLOCK // 2) // BLOCK

    def _count(self, is_outlier: Array) -> None:
        """Count a sample, and open the gate where outliers last.

        Errors that last with one sign are a jump of the level, which the past has had from then on.
        """
        self.count += 1
        self.outliers = self.outliers + is_outlier
        self._out_count = (1.0 - FORGET) * self._out_count + is_outlier
        lasting = self._out_count > LASTING
        if lasting.any():
            k = (self.count - 1) % BLOCK
            errors = self._errors[:, max(k + 1 - RUN, 0) : k + 1]
            is_jump = lasting & ((errors > 0.0).all(axis=1) | (errors < 0.0).all(axis=1))
            self._offset = self._offset + np.where(is_jump, np.median(errors, axis=1), 0.0)
        self._open = np.where(lasting, OPEN, np.maximum(self._open - 1, 0))
        self._out_count = np.where(lasting, 0.0, self._out_count)
        self._deviation = np.where(lasting, 2.0, 1.0) * self._deviation

    def _bridge(self, mode: int, k: int, error: float) -> None:
        """Spread the error of the prediction after a gap over the predictions that stand for what is missing: no step is left."""
        gap = int(self._gap[mode])
        n = min(gap, ORDER + k)
        self._past[mode, ORDER + k - n : ORDER + k] += error * np.arange(gap - n + 1, gap + 1) / (gap + 1)

    def _pass(self, z: Array) -> int:
        """Take samples (n, n_modes) of one block up to the first that is an outlier or missing; return how many."""
        k = self.count % BLOCK
        x = z.T - self._offset[:, None]
        past = np.hstack([self._past[:, k : ORDER + k], x])
        error = x - np.einsum("mi,mki->mk", self._weights, sliding_window_view(past[:, :-1], ORDER, axis=1))
        is_usual = (np.abs(error) <= self._limit()[:, None]).all(axis=0)
        n = len(z) if is_usual.all() else int(np.argmin(is_usual))
        self._errors[:, k : k + n], self._is_usual[:, k : k + n] = error[:, :n], True
        self._past[:, ORDER + k : ORDER + k + n] = x[:, :n]
        self._out_count = self._out_count * (1.0 - FORGET) ** n
        self._gap = np.where(n > 0, 0, self._gap)
        self.count += n
        if n:
            self.settle()
        return n

    def _fit(self) -> None:
        """Fit the deviation to the errors of this block, the level to its outliers, the autoregression to what has passed."""
        self._part += PACE * ((self.outliers - self._outliers_before) / BLOCK - self._part)
        self._outliers_before = self.outliers.copy()
        seen = self._is_usual.sum(axis=1) > BLOCK // 4
        counted = self._is_usual | ~seen[:, None]  # their median by sorting: `nanmedian` takes ten times as long
        magnitudes = np.sort(np.where(counted, np.nan_to_num(np.abs(self._errors)), np.inf), axis=1)
        middle = (counted.sum(axis=1)[:, None] + [-1, 0]) // 2
        median = np.take_along_axis(magnitudes, middle, axis=1).mean(axis=1) / MEDIAN
        is_first = np.isinf(self._deviation) & seen
        old = np.where(np.isinf(self._deviation), median, self._deviation)
        self._deviation = np.where(seen, old ** (1.0 - PACE) * median**PACE, self._deviation)
        for mode in np.flatnonzero(is_first).tolist():
            self._clean(mode)
        rows = sliding_window_view(self._past, ORDER + 1, axis=1) * self._is_usual[:, :, None]
        self._normal = (1.0 - 1.0 / MEMORY) * self._normal + rows.swapaxes(1, 2) @ rows
        self._rows = self._rows + np.where(self._blocks() > 1, BLOCK, self._is_usual.sum(axis=1))
        square, cross = self._normal[:, :-1, :-1], self._normal[:, :-1, -1:]
        trace = np.trace(square, axis1=1, axis2=2)
        diagonal = np.where(trace > 0.0, RIDGE * trace, 1.0)[:, None, None] * np.eye(ORDER)
        fitted = np.linalg.solve(square + diagonal, cross)[:, :, 0]
        self._weights = np.where(((trace > 0.0) & (self._blocks() > 1))[:, None], fitted, self._weights)
        self._past = np.concatenate([self._past[:, BLOCK:], np.zeros((self._n_modes, BLOCK))], axis=1)
        self._level = self._find_level()

    def _clean(self, mode: int) -> None:
        """Keep what is far out of the first block, in which all pass, out of the fit."""
        is_far = np.abs(self._errors[mode]) > FIRST * self.settings.level * self._deviation[mode]
        self._is_usual[mode] &= ~is_far
        for k in np.flatnonzero(is_far):
            self._past[mode, ORDER + k] = self._past[mode, ORDER + k - 1]


def let_through(z: Array, argument: Array, result: Array) -> Array:
    """Return z without outliers; argument, result : what a gate was given of it and has returned."""
    return np.where(result == argument, z, result + (z - argument))


def frame_mean_of(z: Array) -> Array:
    """Return the mean of samples z (..., n, n_modes) [um] over a frame, of those that are there; NaN where none is."""
    is_there = ~np.isnan(z)
    count = is_there.sum(axis=-2)
    return np.where(count > 0, np.where(is_there, z, 0.0).sum(axis=-2) / np.maximum(count, 1), np.nan)


STATE = (
    "count",
    "outliers",
    "_part",
    "_outliers_before",
    "_offset",
    "_past",
    "_normal",
    "_rows",
    "_weights",
    "_deviation",
    "_out_count",
    "_open",
    "_gap",
    "_settling",
    "_errors",
    "_is_usual",
)
