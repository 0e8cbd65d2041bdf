"""Adaptive Gaussian process regression: inputs, kernel and targets learnt from the record itself, again and again.

The GPR of the paper has given bands, sees raw windows, and its targets online are causal band-passes, which lag and hold
turbulence. This one has no prior. `learning` has what it learns from the last seconds of z; between two times of learning it
is a fixed filter of the whitened measurements. It learns after the estimate of a step, for those that follow: first from half of
`adaptive.window`, and its window then grows to twice `adaptive.window`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from wfsobs.observers.base import VIBRATION, Look, Observer, Tunable
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.gpr.learning import Learnt, learn, nothing_learnt
from wfsobs.observers.kalman.adaptive import identification_settings
from wfsobs.observers.kalman.window_model import ADAPTIVE, Adaptive, pack_spectrum, unpack_spectrum, window_lengths
from wfsobs.observers.step import HeldEstimate, StepError, run_frames, whole_frames
from wfsobs.observers.stepping import FilterBank, SampleHistory, Saved
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, RecordError, Sampling
from wfsobs.signal.periodic import PeriodicFilter, Recursion
from wfsobs.spectral.quick import SHORTEST
from wfsobs.typing import Array

ORDER = 4
"""Maximum number of states of a whitener: two of the turbulence, and of a background where there is one."""
SLOWER = 1.5
"""Time from learning to learning, over `adaptive.interval`: less often costs errors, more often processor time alone."""


class Schedule(NamedTuple):
    """When it learns from what, all in steps.

    first, interval : until the first time of learning, and from one to the next
    longest         : maximum length of the identification window
    depth           : of a window of the regression
    """

    first: int
    interval: int
    longest: int
    depth: int


def schedule_of(settings: Adaptive, dt: float) -> Schedule:
    """Return the schedule of settings. Raises RecordError for a window of too few samples."""
    found = window_lengths(settings, dt)
    found.check(settings, dt)
    first = max(found.window // 2, SHORTEST)
    return Schedule(first, round(SLOWER * found.interval), 2 * found.window, min(settings.depth, first // 4))


class AdaptiveGprEstimator(HeldEstimate):
    """The regression of all modes, for the vibration now or `horizon` frames ahead. It learns in `settle`.

    Raises StepError where the horizon leaves too few targets.
    """

    settings: Adaptive
    sampling: Sampling
    count: int

    state_names: tuple[str, ...] = ("_samples", "_recent", "_filters", "_mean", "_sd", "count")

    def __init__(self, settings: Adaptive, sampling: Sampling, horizon: int = 0):
        super().__init__(sampling.n_modes, float(horizon))
        self.settings, self.sampling, self._ahead = settings, sampling, horizon
        self.schedule: Schedule = schedule_of(settings, sampling.dt)
        if horizon >= self.schedule.first // 4:
            raise StepError(f"gpr-adaptive: {horizon} frames ahead: takes less than an eighth of adaptive.window")
        n = sampling.n_modes
        none = np.zeros((ORDER, ORDER)), np.zeros((ORDER, 1)), np.zeros((1, ORDER)), np.zeros((1, 1))
        self._filters = FilterBank([Recursion([none])] * n)  # the whiteners
        self._samples, self._recent = SampleHistory(n, self.schedule.longest), SampleHistory(n, self.schedule.depth)  # whitened
        self._weights, self._means, self._sds = np.zeros((n, self.schedule.depth)), np.zeros(n), np.zeros(n)
        self.count, self._pending = 0, False
        self.learnt = [nothing_learnt(self.schedule.depth)] * n
        self._use()
        self.mark_start()

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Run over a record, frame by frame. Raises RecordError for one in which it cannot learn once."""
        needed = self.schedule.first + measurements.delay
        if measurements.n_steps <= needed:
            raise RecordError(
                f"the record has {measurements.n_steps} steps; half of adaptive.window and one more are {needed + 1}"
            )
        return run_frames(self, (VIBRATION,), measurements, watch)

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame; those of the mirror's first delay are left out: what it did before is not known."""
        self.settle()
        self.count += 1
        if self.count <= self.sampling.delay:
            return
        self._samples.push(z)
        since = self.count - self.sampling.delay - self.schedule.first
        if since > 0:
            self._estimate(z)
        self._pending = since >= 0 and since % self.schedule.interval == 0

    def _estimate(self, z: Array) -> None:
        """Whiten the samples z (n_modes,), and put their windows through the weights."""
        self._recent.push(self._filters.step((z - self._means)[:, None])[:, 0])
        np.einsum("ij,ij->i", self._weights, self._recent.last(self.schedule.depth), out=self._mean)
        self._sd[...] = self._sds

    def settle(self) -> None:
        """Learn, where the last frame ended an interval; estimates of the next frames are of it."""
        if not self._pending:
            return
        self._pending = False
        size = min(self.count - self.sampling.delay, self.schedule.longest)
        s, windows = self.settings, self._samples.last(size)
        self.learnt = [
            learn(z, self.sampling.dt, self.schedule.depth, s.peak_count, s.lowest, last, self._ahead)
            for last, z in zip(self.learnt, windows, strict=True)
        ]
        self._use()
        past = [self._whiten_past(mode, z - one.mean) for mode, (one, z) in enumerate(zip(self.learnt, windows, strict=True))]
        self._recent.load({"newest": np.array(past)})

    def _use(self) -> None:
        """Take over what was learnt."""
        for mode, one in enumerate(self.learnt):
            F, G, H, J = one.whitener
            order, filter_map = len(F), self._filters.maps[0][mode]
            filter_map[...] = 0.0
            filter_map[:order, :order], filter_map[:order, ORDER:] = F, G
            filter_map[ORDER:, :order], filter_map[ORDER:, ORDER:] = H, J
            self._weights[mode], self._means[mode], self._sds[mode] = one.weights[::-1], one.mean, one.sd

    def _whiten_past(self, mode: int, z: Array) -> Array:
        """Take the whitener of a mode through its window z (n,) from rest; return its last outputs, (depth,)."""
        F, G, H, J = self.learnt[mode].whitener
        whitener = PeriodicFilter([(F, G, np.vstack([H, F]), np.vstack([J, G]))])
        out = whitener.run(z[:, None, None], since=len(z) - self.schedule.depth)[:, :, 0]
        self._filters.x[mode] = 0.0
        self._filters.x[mode, : len(F)] = out[-1, 1:]
        return out[:, 0]

    def save(self) -> Saved:
        """Return a copy of the state: the window, what was learnt, and the states of the whiteners."""
        self.settle()
        rows = self.settings.peak_count + 2
        return super().save() | {
            "spectra": np.array([pack_spectrum(one.fit, rows) for one in self.learnt]),
            "weights": np.array([one.weights for one in self.learnt]),
            "means": np.array([[one.mean, one.sd] for one in self.learnt]),
        }

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        super().load(state)
        self._pending = False
        packed = zip(state["spectra"], state["means"].tolist(), state["weights"], strict=True)
        self.learnt: list[Learnt] = [
            Learnt(unpack_spectrum(table, self.sampling.dt), mean, weights.copy(), sd) for table, (mean, sd), weights in packed
        ]
        self._use()

    def take_over(self, old: Any) -> None:
        """Go on from another design with the same windows, number of peaks and horizon. Raises StepError."""
        if (old.schedule, old.settings.peak_count, old.horizon) != (self.schedule, self.settings.peak_count, self.horizon):
            raise StepError("the designs have other windows, another number of peaks or horizon")
        self.load(old.save())


def gpr_adaptive(_prior: Prior, settings: Adaptive, sampling: Sampling, horizon: float) -> AdaptiveGprEstimator:
    """Return the regression of the vibration `horizon` frames ahead. Raises RecordError for a window of too few samples."""
    return AdaptiveGprEstimator(settings, sampling, whole_frames(horizon, "gpr-adaptive"))


def seconds(settings: Adaptive, n_steps: int, n_modes: int, dt: float) -> float:
    """2 ms + 3.2 us per sample for every time of learning, one mode after the other [s]; nothing for a window that it refuses."""
    if settings.window < SHORTEST * dt:
        return 0.0
    schedule = schedule_of(settings, dt)
    ends = range(schedule.first, n_steps, schedule.interval)
    return n_modes * sum(2e-3 + 3.2e-6 * min(end, schedule.longest) for end in ends)


def _settings_used(prior: Prior, settings: Adaptive) -> tuple[float, ...]:
    return *identification_settings(prior, settings), settings.depth


GPR_ADAPTIVE = Observer(
    "gpr-adaptive",
    "Adaptive GPR",
    (VIBRATION,),
    help="Gaussian process regression that learns inputs, kernel and targets from the last 8 s; not in the paper",
    settings=ADAPTIVE,
    tunable=Tunable(("adaptive.window", "adaptive.depth"), ("adaptive.interval",)),
    weight=50.0,
    seconds=seconds,
    look=Look("Adaptive GPR", "#01734F", "#7AFED9", (20, 2, 2, 2), width=1.8),
    step=gpr_adaptive,
    counts=_settings_used,
)
