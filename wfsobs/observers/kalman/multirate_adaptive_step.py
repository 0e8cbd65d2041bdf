"""The adaptive multi-rate filter one frame at a time: samples of both sensors, and a filter and a window of its own per mode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from wfsobs.observers.base import TARGETS, TURBULENCE
from wfsobs.observers.kalman.both_gaps import behind_gaps, has_gaps, identify_both_with_gaps
from wfsobs.observers.kalman.both_window import (
    BothModel,
    Lengths,
    both_lengths,
    check_window,
    identify_both,
    is_still,
    model_cycle,
    next_length,
    window_start,
)
from wfsobs.observers.kalman.gap_bank import STEADY
from wfsobs.observers.kalman.spread import learnt_estimate
from wfsobs.observers.kalman.step import KalmanEstimator
from wfsobs.observers.kalman.window_model import pack_spectrum, unpack_spectrum
from wfsobs.observers.step_checks import StepError
from wfsobs.record import Sampling
from wfsobs.signal.stepping import Saved
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.observers.kalman.adaptive import Adaptive

TAIL = 200
"""Last steps of a window, in whole frames, that a new filter takes with their gaps."""


class ModeWindow:
    """The filter in charge of one mode, and when the next model is due.

    Attributes
    ----------
    due, began, last_change : int
        Steps taken when the next identification is due, when the last one was, and before which the record was not still.
    model : BothModel
        What was identified last.
    size : int
        Steps of the window of that model.
    means : Array
        Of the window, of LGS and NGS, (2,) [um].
    kalman : KalmanEstimator or None
        None before the first model.
    surprise : Array
        Squared innovations over their variances since the last check, NaN where z is missing, (interval,).
    """

    def __init__(self, lengths: Lengths):
        self.lengths, self.model = lengths, BothModel()
        self.due, self.began, self.last_change, self.size = lengths.first + lengths.window, 0, 0, 0
        self.means, self.surprise = np.full(2, np.nan), np.ones(lengths.interval)
        self.kalman: KalmanEstimator | None = None

    def advance(self, v: Array, count: int) -> None:
        """Take LGS and NGS (2,), the last of `count` steps."""
        assert self.kalman is not None
        bank, place = self.kalman.bank, (count - self.began - 1) % self.lengths.interval
        innovation = v[0] - self.means[0] - self._ahead @ bank.x[0]
        self.surprise[place] = innovation**2 / self._innovation_variance()
        self.kalman.advance(v[:1] - self.means[:1], v[1:] - self.means[1:], None)
        if place == self.lengths.interval - 1 and not is_still(self.surprise):
            self.last_change, self.due = count - self.lengths.interval, count

    def _innovation_variance(self) -> float:
        assert self.kalman is not None
        bank, one = self.kalman.bank, self.kalman.modes[0]
        near = bank.near[0]
        if near is None or near.is_last:
            return self._variance[bank.phase - 1]
        A, C, Q, R = one.cycle[bank.last_in_cycle]
        return C[0] @ (A @ near.posterior @ A.T + Q) @ C[0] + R[0, 0]

    def identify(self, v: Array, dt: float, settings: Adaptive) -> None:
        """Identify a window v (n, 2) that ends now, and start its filter at its beginning.

        With too many gaps the filter in charge goes on until the next check; behind a long one its model stays, while the
        record is still, until a window as long as its own is there.
        """
        ratio, whole = self.lengths.ratio, v
        if has_gaps(v, ratio):
            least = self.size if self.last_change < self.began else 0
            part = behind_gaps(v, self.lengths, least)
            found = None if part is None else identify_both_with_gaps(part, ratio, dt, settings, self.model)
            if found is None:
                self.due += self.lengths.interval
                return
            self.model, whole = found
        else:
            self.model = identify_both(v[:, 0], v[ratio - 1 :: ratio, 1], dt, settings, self.model)
        self.began, self.due, self.size = self.due, self.due + next_length(len(whole), self.lengths), len(whole)
        if self.model.cycle is not None:
            self._run_window(v, whole)

    def _run_window(self, v: Array, whole: Array) -> None:
        """Start the filter of what was found and take it through its window; v : with gaps; whole : its end or all of it."""
        ratio = self.lengths.ratio
        self.means = np.array([whole[:, 0].mean(), whole[ratio - 1 :: ratio, 1].mean()])
        kalman = self.start()
        gains = kalman.modes[0].gains
        states = gains.filter(np.eye(len(gains.steps[0].A))).run((whole - self.means)[:, :, None])
        tail = v[len(v) - min(TAIL // ratio * ratio, len(whole) - ratio) :]
        if not has_gaps(tail, ratio):
            kalman.bank.x[0] = states[-1, :, 0]
            return
        kalman.bank.x[0] = states[-1 - len(tail), :, 0]
        for row in tail - self.means:
            kalman.advance(row[:1], row[1:], None)

    def start(self) -> KalmanEstimator:
        """Put the filter of what was found in charge: at rest, after a whole frame."""
        assert self.model.cycle is not None
        one = self.model.cycle.filter()
        A, C, _, R = one.cycle[0]
        self._ahead = C[0] @ A
        # P before the measurement is A P A' + Q of the step before.
        before = zip(one.posterior[-1:] + one.posterior[:-1], one.cycle[-1:] + one.cycle[:-1], strict=True)
        self._variance = [C[0] @ (A @ P @ A.T + Q) @ C[0] + R[0, 0] for P, (A, _, Q, _) in before]
        self.kalman = KalmanEstimator([one])
        self.kalman.bank.phase, self.kalman.bank.last = 1, self.lengths.ratio
        return self.kalman


class BothEstimator:
    """`multirate_adaptive`, one frame at a time. It identifies in `advance`, each mode when its window has grown or changed."""

    horizon, needs_command, uses_ngs = None, False, True

    def __init__(self, settings: Adaptive, sampling: Sampling):
        assert sampling.ratio is not None
        self.settings, self.sampling = settings, sampling
        self.lengths = both_lengths(settings, sampling.dt, sampling.ratio, sampling.delay)
        check_window(settings, self.lengths, sampling.dt)
        self._samples = np.zeros((2 * self.lengths.longest, 2, sampling.n_modes))  # oldest first; moved to the front at the end
        self._outputs: dict[tuple[float, str], Array] = {}
        self.reset()

    def reset(self) -> None:
        """Set the state back to the start."""
        self.count = self._end = 0
        self.windows = [ModeWindow(self.lengths) for _ in range(self.sampling.n_modes)]

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        longest = self.lengths.longest
        if self._end == len(self._samples):
            self._samples[: longest - 1] = self._samples[1 - longest :]
            self._end = longest - 1
        row = self._samples[self._end]
        row[0], row[1] = z, 0.0 if ngs is None else ngs
        self._end += 1
        self.count += 1
        for mode, window in enumerate(self.windows):
            if window.kalman is not None:
                window.advance(row[:, mode], self.count)
            if self.count == window.due:
                size = self.count - window_start(self.count, window.last_change, self.lengths)
                window.identify(self._samples[self._end - size : self._end, :, mode], self.sampling.dt, self.settings)

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return mean and standard deviation; NaN before the first full window."""
        out, sd = self._outputs.setdefault((frames, target), np.empty((2, len(self.windows))))
        for mode, window in enumerate(self.windows):
            out[mode] = sd[mode] = np.nan
            if window.kalman is not None:
                (moving,), (spread,) = window.kalman.predict(frames, target)
                sd[mode] = np.hypot(spread, window.model.hidden_rms)
                out[mode] = moving + (window.means[1] if target == TURBULENCE else 0.0)
        return out, sd

    def estimate(self) -> tuple[Array, Array]:
        """Return the estimates of the last frame, (2, n_modes), and deviations of these and of both together, (3, n_modes)."""
        means = [np.nan if window.kalman is None else window.means[1] for window in self.windows]
        of_modes = [learnt_estimate(w.kalman, mean, w.model.hidden_rms) for w, mean in zip(self.windows, means, strict=True)]
        values, sd = (np.stack(parts, axis=1) for parts in zip(*of_modes, strict=True))
        return values, sd

    def settle(self) -> None:
        """Have nothing left to do."""

    def save(self) -> Saved:
        """Return a copy of the state: the samples, what was found in them, and the states of the filters."""
        rows = 2 * self.settings.peak_count + 2
        size = min(self._end, self.lengths.longest)
        samples = np.zeros((self.lengths.longest, *self._samples.shape[1:]))
        samples[:size] = self._samples[self._end - size : self._end]
        n_modes, n = len(self.windows), 4 * (rows + len(TARGETS)) + 2
        states, covariance = np.zeros((n_modes, n)), np.zeros((n_modes, n, n))
        phases, near = np.zeros((n_modes, 2), int), np.full(n_modes, STEADY)
        for mode, window in enumerate(self.windows):
            if window.kalman is not None:
                one = window.kalman.save()
                order = one["x"].shape[1]
                states[mode, :order], phases[mode], near[mode] = one["x"], one["phase"], *one["near"]
                covariance[mode, :order, :order] = one["covariance"]
        found = [[pack_spectrum(one, rows) for one in (w.model.spectrum, w.model.error)] for w in self.windows]
        return {
            "samples": samples,
            "counts": np.array([self.count, size]),
            "times": np.array([[w.due, w.began, w.last_change, w.size] for w in self.windows]),
            "found": np.array(found),
            "ngs": np.array([w.model.ngs for w in self.windows]),
            "hidden_rms": np.array([w.model.hidden_rms for w in self.windows]),
            "means": np.array([w.means for w in self.windows]),
            "surprise": np.array([w.surprise for w in self.windows]),
            "states": states,
            "phases": phases,
            "near": near,
            "covariance": covariance,
        }

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        self.count, self._end = (int(i) for i in state["counts"])
        self._samples[: self.lengths.longest] = state["samples"]
        for mode, window in enumerate(self.windows):
            window.due, window.began, window.last_change, window.size = (int(i) for i in state["times"][mode])
            window.means, window.surprise = state["means"][mode].copy(), state["surprise"][mode].copy()
            spectrum = unpack_spectrum(state["found"][mode, 0], self.sampling.dt)
            error = unpack_spectrum(state["found"][mode, 1], self.sampling.dt * self.lengths.ratio)
            window.model, window.kalman = BothModel(), None
            if spectrum is not None and error is not None:
                ngs = float(state["ngs"][mode])
                cycle = model_cycle(spectrum, error, ngs, self.lengths.ratio)
                window.model = BothModel(spectrum, error, ngs, cycle, float(state["hidden_rms"][mode]))
                kalman = window.start()
                n, one = kalman.bank.x.shape[1], {name: state[name][mode, None] for name in ("states", "near", "covariance")}
                at = {"x": one["states"][:, :n], "near": one["near"], "covariance": one["covariance"][:, :n, :n]}
                kalman.load({**at, "phase": state["phases"][mode]})

    def take_over(self, old: Any) -> None:
        """Go on from another design with the same windows and as many peaks. Raises StepError."""
        if old.lengths != self.lengths or old.settings.peak_count != self.settings.peak_count:
            raise StepError("the designs have other windows or another maximum number of peaks")
        self.load(old.save())
