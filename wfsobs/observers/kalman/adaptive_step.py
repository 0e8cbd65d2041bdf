"""The adaptive Kalman filter one frame at a time: a window of samples, and a filter per mode that it is identified anew from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from wfsobs.observers.base import TURBULENCE
from wfsobs.observers.kalman.gap_bank import STEADY
from wfsobs.observers.kalman.spread import learnt_estimate
from wfsobs.observers.kalman.step import KalmanEstimator
from wfsobs.observers.kalman.window_model import (
    NOT_YET,
    WindowModel,
    identify_window,
    identify_with_gaps,
    lengths,
    mode_of,
    pack_spectrum,
    unpack_spectrum,
)
from wfsobs.observers.step_checks import StepError
from wfsobs.record import Sampling
from wfsobs.signal.stepping import Saved
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.observers.kalman.adaptive import Adaptive

TAIL = 200
"""Last steps of a window that a new filter takes with their gaps; before them it takes what is expected in these."""


class AdaptiveEstimator:
    """`kf_adaptive`, one frame at a time. It identifies in `advance`, in one frame of every interval."""

    horizon, needs_command, uses_ngs = None, False, False

    def __init__(self, settings: Adaptive, sampling: Sampling):
        self.settings, self.sampling = settings, sampling
        self.window, self.interval = lengths(settings, sampling.dt)
        self._samples = np.zeros((sampling.n_modes, 2 * self.window))  # newest last; moved to the front at the end
        self._outputs: dict[tuple[float, str], Array] = {}
        self.reset()

    def reset(self) -> None:
        """Set the state back to the start."""
        n = self.sampling.n_modes
        self._end = self.count = 0
        self.models = [NOT_YET] * n
        self.means = np.full(n, np.nan)
        self.filters: list[KalmanEstimator | None] = [None] * n

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame; those of the mirror's first delay are left out: what it did before is not known."""
        self.count += 1
        if self.count <= self.sampling.delay:
            return
        if self._end == self._samples.shape[1]:
            self._samples[:, : self.window - 1] = self._samples[:, 1 - self.window :]
            self._end = self.window - 1
        self._samples[:, self._end] = z
        self._end += 1
        full = self.count - self.sampling.delay - self.window
        is_due = full >= 0 and full % self.interval == 0
        for mode, value in enumerate(z):
            kalman = self.filters[mode]
            if not (is_due and self._identify(mode)) and kalman is not None:
                kalman.advance(value[None] - self.means[mode], None, None)

    def _identify(self, mode: int) -> bool:
        """Identify the window of a mode; return whether its filter has been started anew."""
        z, dt = self._samples[mode, self._end - self.window : self._end], self.sampling.dt
        if np.isnan(z).any():
            found = identify_with_gaps(z, dt, self.settings, self.models[mode])
            if found is None:
                return False
            self.models[mode], whole = found
        else:
            self.models[mode] = identify_window(z, dt, self.settings, self.models[mode])
            whole = z
        if self.models[mode].spectrum is None:
            return False
        self.means[mode] = whole.mean()
        self._start(mode)
        self._run_window(mode, z, whole)
        return True

    def _run_window(self, mode: int, z: Array, whole: Array) -> None:
        """Take the filter in charge through its window; z : with its gaps; whole : without, the last part or all of it."""
        kalman, mean = self.filters[mode], self.means[mode]
        if kalman is None:
            return
        gains, tail = kalman.modes[0].gains, z[z.size - min(TAIL, whole.size - 1) :]
        states = gains.filter(np.eye(len(kalman.modes[0].model.A))).run((whole - mean)[:, None, None])
        if not np.isnan(tail).any():
            kalman.bank.x[0] = states[-1, :, 0]
            return
        kalman.bank.x[0] = states[-1 - tail.size, :, 0]
        for value in tail:
            kalman.advance(value[None] - mean, None, None)

    def _start(self, mode: int) -> None:
        """Put the filter that has been found in charge, at rest."""
        one = self.models[mode].mode
        self.filters[mode] = None if one is None else KalmanEstimator([one])

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return mean and standard deviation; NaN before the first full window."""
        out, sd = self._outputs.setdefault((frames, target), np.empty((2, len(self.means))))
        for mode, (kalman, mean) in enumerate(zip(self.filters, self.means, strict=True)):
            moving, sd[mode] = 0.0, np.nan
            if kalman is not None:
                (moving,), (spread,) = kalman.predict(frames, target)
                sd[mode] = np.hypot(spread, self.models[mode].hidden_rms)
            out[mode] = moving + (mean if target == TURBULENCE else 0.0 * mean)
        return out, sd

    def estimate(self) -> tuple[Array, Array]:
        """Return the estimates of the last frame, (2, n_modes), and deviations of these and of both together, (3, n_modes)."""
        known = zip(self.filters, self.means, self.models, strict=True)
        of_modes = [learnt_estimate(kalman, mean, found.hidden_rms) for kalman, mean, found in known]
        values, sd = (np.stack(parts, axis=1) for parts in zip(*of_modes, strict=True))
        return values, sd

    def settle(self) -> None:
        """Have nothing left to do."""

    def save(self) -> Saved:
        """Return a copy of the state: the window, what was found in it, and the states of the filters."""
        rows = self.settings.peak_count + 2
        spectra = [[pack_spectrum(one, rows) for one in (found.fit, found.spectrum)] for found in self.models]
        n_modes, n = len(self.means), 3 * rows
        window, states, covariance = np.zeros((n_modes, self.window)), np.zeros((n_modes, n)), np.zeros((n_modes, n, n))
        near = np.full(n_modes, STEADY)
        size = min(self._end, self.window)
        window[:, self.window - size :] = self._samples[:, self._end - size : self._end]
        for mode, kalman in enumerate(self.filters):
            if kalman is not None:
                one = kalman.save()
                order = one["x"].shape[1]
                states[mode, :order], near[mode], covariance[mode, :order, :order] = one["x"], *one["near"], *one["covariance"]
        return {
            "window": window,
            "spectra": np.array(spectra),
            "means": self.means.copy(),
            "hidden_rms": np.array([found.hidden_rms for found in self.models]),
            "states": states,
            "near": near,
            "covariance": covariance,
            "counts": np.array([self.count, size]),
        }

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        self.count, size = (int(i) for i in state["counts"])
        self._end = self.window
        self._samples[:, : self.window] = state["window"]
        if size < self.window:
            self._samples[:, :size] = state["window"][:, self.window - size :]
            self._end = size
        self.means[...] = state["means"]
        saved = (state[name] for name in ("spectra", "states", "near", "covariance"))
        for mode, (packed, x, near, covariance) in enumerate(zip(*saved, strict=True)):
            fit, spectrum = (unpack_spectrum(one, self.sampling.dt) for one in packed)
            one = None if spectrum is None else mode_of(spectrum)
            self.models[mode] = WindowModel(fit, spectrum, one, float(state["hidden_rms"][mode]))
            self._start(mode)
            kalman = self.filters[mode]
            if kalman is not None:
                n = kalman.bank.x.shape[1]
                kalman.load({"x": x[None, :n], "phase": np.zeros(2), "near": near[None], "covariance": covariance[None, :n, :n]})

    def take_over(self, old: Any) -> None:
        """Go on from another design with the same window and as many peaks. Raises StepError."""
        if old.window != self.window or old.settings.peak_count != self.settings.peak_count:
            raise StepError("the designs have another window or maximum number of peaks")
        self.load(old.save())
