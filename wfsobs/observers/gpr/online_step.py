"""The online GPR of several modes one frame at a time, for the vibration now or a number of frames ahead.

The target of a window is the vibration h frames later as the causal bank on z gives it, one frame late: at step k that of window
k - 1 - h is known. What it learns from a frame it learns in `settle`, after the estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from wfsobs.observers.gpr.kernels import SquaredExponential
from wfsobs.observers.gpr.late_regression import LateRegression
from wfsobs.observers.gpr.sliding_regression import SlidingRegression
from wfsobs.observers.step_checks import StepError
from wfsobs.observers.windows import Windows
from wfsobs.prior import Bands
from wfsobs.record import Sampling
from wfsobs.signal.bandpass import bandpass_bank, bank_recursion
from wfsobs.signal.stepping import FilterBank, Saved, load_parts, save_parts
from wfsobs.typing import Array


class OnlineEstimator:
    """Online GPR of all modes.

    Parameters
    ----------
    windows : Windows
        The channels of a sample; of depth 1.
    bands : Bands
        Of the bank that gives the targets.
    sampling : Sampling
        Of the loop.
    depth, m : int
        Samples in a window, windows in the training set.
    kernel : SquaredExponential
        The covariance.
    weights : Array
        Of the vibration now, one frame ahead and so on in what it learns; fewer than m.
    """

    def __init__(
        self, windows: Windows, bands: Bands, sampling: Sampling, depth: int, m: int, kernel: SquaredExponential, weights: Array
    ):
        self.windows, self.weights, self.needs_command = windows, weights, windows.needs_command
        self.horizon = float(len(weights) - 1)
        self._band_signals = np.zeros((len(weights), sampling.n_modes))  # oldest first
        self._size = depth, m, 2 if windows.needs_command else 1, kernel
        bank = bandpass_bank(bands.frequencies, bands.bandwidth_online, bands.order, sampling.dt)
        self.bank = FilterBank([bank_recursion(bank)] * sampling.n_modes)
        self._mean, self._sd = np.full(sampling.n_modes, np.nan), np.full(sampling.n_modes, np.nan)
        self._pending = False
        self.regression = self._start()

    def _start(self) -> SlidingRegression:
        late, n = len(self.weights) - 1, len(self._mean)
        return LateRegression(*self._size, late, n) if late else SlidingRegression(*self._size, n)

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self.settle()
        self._band_signals[:-1] = self._band_signals[1:].copy()
        self._band_signals[-1] = self.bank.step(z[:, None])[:, 0]
        targets = self.weights @ self._band_signals
        samples = self.windows.push(z, u).reshape(len(z), -1)
        self._mean[...] = self.regression.predict(samples, targets)
        self._pending = True

    def settle(self) -> None:
        """Learn from the last frame. Raises ConditionError where the precision is not enough."""
        if self._pending:
            self._pending = False
            self.regression.update()

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return the mean of the vibration; NaN until the training set is full."""
        return self._mean, self._sd

    def reset(self) -> None:
        """Set the state back to the start."""
        self.windows.reset()
        self.bank.reset()
        self.regression, self._pending = self._start(), False
        self._mean[...], self._band_signals[...] = np.nan, 0.0

    def save(self) -> Saved:
        """Return a copy of the state."""
        self.settle()
        parts = {"windows": self.windows, "bank": self.bank}
        own = {"mean": self._mean.copy(), "filtered": self._band_signals.copy()}
        return save_parts(parts) | own | self.regression.save()

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        load_parts({"windows": self.windows, "bank": self.bank}, state)
        self._mean[...], self._band_signals[...], self._pending = state["mean"], state["filtered"], False
        self.regression.load(state)

    def take_over(self, old: Any) -> None:
        """Go on from a design with the same windows, training set, kernel and horizon. Raises StepError."""
        if old._size != self._size or not np.array_equal(old.weights, self.weights) or old.bank.x.shape != self.bank.x.shape:
            raise StepError("the designs have other windows, training sets, kernels or horizons: one of them has to learn anew")
        self.load(old.save())
