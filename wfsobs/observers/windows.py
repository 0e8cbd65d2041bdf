"""Observers that look at a window of the last samples, one frame at a time: what they hold, and the linear ones.

A linear predictor of the vibration h frames ahead is trained for that h, so it has no other horizon.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from wfsobs.observers.gpr.inputs import Gpr, Scale, StreamingInputs
from wfsobs.observers.step_checks import StepError
from wfsobs.record import Sampling
from wfsobs.signal.stepping import Saved
from wfsobs.typing import Array


class Windows:
    """The channels of all modes, sample by sample, and the last of them.

    Parameters
    ----------
    settings : Gpr or None
        Which channels a window has and what is done to them; None for z as it is.
    sampling : Sampling
        Of the loop.
    depth : int
        Samples in a window.
    scales : sequence of Scale
        Of standardised inputs, one per mode; empty for others.
    """

    def __init__(self, settings: Gpr | None, sampling: Sampling, depth: int, scales: Sequence[Scale] = ()):
        self.needs_command = settings is not None and settings.inputs == "u-y"
        self.depth, self.count = depth, 0
        n = sampling.n_modes * (2 if self.needs_command else 1)
        self._inputs = None
        if settings is not None and settings.inputs_filter != "raw":
            scale = Scale(*(np.concatenate(part) for part in zip(*scales, strict=True))) if scales else None
            self._inputs = StreamingInputs(settings, sampling.dt, scale)
        self._samples = np.zeros((n, 4 * depth))  # newest last; moved to the front at the end
        self._end = depth
        self._past = np.zeros((sampling.delay, sampling.n_modes))  # commands, newest first
        self._held_value = np.zeros(sampling.n_modes)
        self._sample = np.zeros(n)

    @property
    def is_full(self) -> bool:
        """Whether the window is full."""
        return self.count >= self.depth

    def push(self, z: Array, u: Array | None) -> Array:
        """Take z and, where windows hold commands, u (n_modes,) [um]; return the frame's channels (n_modes * channels,)."""
        sample = self._sample
        if self.needs_command:
            assert u is not None
            held, past = self._held_value, self._past
            np.copyto(held, u, where=~np.isnan(u))
            sample[::2] = held
            sample[1::2] = z + past[-1]
            past[1:] = past[:-1].copy()
            past[0] = held
        else:
            sample[...] = z
        out = sample if self._inputs is None else self._inputs.step(sample)
        if self._end == self._samples.shape[1]:
            self._samples[:, : self.depth] = self._samples[:, -self.depth :]
            self._end = self.depth
        self._samples[:, self._end] = out
        self._end += 1
        self.count += 1
        return out

    @property
    def window(self) -> Array:
        """The newest window, (n_modes * channels, depth), the oldest sample first; a view."""
        return self._samples[:, self._end - self.depth : self._end]

    def reset(self) -> None:
        """Set the state back to the start."""
        for x in (self._samples, self._past, self._held_value):
            x[...] = 0.0
        self.count, self._end = 0, self.depth
        if self._inputs is not None:
            self._inputs.reset()

    def save(self) -> Saved:
        """Return a copy of the state."""
        more = {} if self._inputs is None else self._inputs.save(len(self._sample))
        return {
            "window": self.window.copy(),
            "past": self._past.copy(),
            "held": self._held_value.copy(),
            "count": np.array(self.count),
            **more,
        }

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        self._end, self.count = self.depth, int(state["count"])
        self._samples[:, : self.depth] = state["window"]
        self._past[...], self._held_value[...] = state["past"], state["held"]
        if self._inputs is not None:
            self._inputs.load(state)

    def take_over(self, old: Windows) -> None:
        """Go on from other windows of the same channels; of longer ones, or of shorter ones that are then not full."""
        if self._samples.shape[0] != old._samples.shape[0] or (self._inputs is None) != (old._inputs is None):
            raise StepError("the designs have windows of other channels")
        n = min(self.depth, old.depth)
        self._end = self.depth
        self._samples[:, self.depth - n : self.depth] = old.window[:, old.depth - n :]
        self.count = min(old.count, n) if self.depth > old.depth else old.count
        self._past[...], self._held_value[...] = old._past, old._held_value
        if self._inputs is not None and old._inputs is not None:
            self._inputs.load(old._inputs.save(len(self._sample)))


class LinearPredictor:
    """A linear predictor of all modes, one frame at a time.

    Parameters
    ----------
    windows : Windows
        What it looks at.
    fits : sequence of tuple
        Weights (depth, channels), the newest sample first, and constant, one per mode.
    horizon : float
        Frames ahead that it was trained for.
    """

    def __init__(self, windows: Windows, fits: Sequence[tuple[Array, float]], horizon: float):
        self.windows, self.horizon, self.needs_command = windows, horizon, windows.needs_command
        channels = fits[0][0].shape[1]
        self._weights = np.concatenate([weights[::-1].T for weights, _ in fits])  # as the window: (n_modes * channels, depth)
        self._starts = np.arange(0, len(self._weights), channels)
        self._constants = np.array([constant for _, constant in fits])
        self._mean, self._sd = np.full(len(fits), np.nan), np.full(len(fits), np.nan)

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self.windows.push(z, u)

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return the mean of the vibration; NaN before the first full window."""
        if self.windows.is_full:
            parts = np.einsum("ij,ij->i", self._weights, self.windows.window)
            np.add.reduceat(parts, self._starts, out=self._mean)
            self._mean += self._constants
        else:
            self._mean[...] = np.nan
        return self._mean, self._sd

    def settle(self) -> None:
        """Have nothing left to do."""

    def reset(self) -> None:
        """Set the state back to the start."""
        self.windows.reset()

    def save(self) -> Saved:
        """Return a copy of the state."""
        return self.windows.save()

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        self.windows.load(state)

    def take_over(self, old: Any) -> None:
        """Go on with the samples of another design."""
        self.windows.take_over(old.windows)
