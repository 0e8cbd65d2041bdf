"""Adaptive Gaussian process regression: inputs, kernel and targets learnt from the record itself, again and again.

The GPR of the paper is told bands, sees raw windows, and its targets online are causal band-passes, which lag and hold
turbulence. This one is told nothing. `learning` has what it learns from the last seconds of z; between two times of learning it
is a fixed filter of the whitened measurements. It learns after the estimate of a step, for those that follow: first from half of
`adaptive.window`, and its window then grows to twice `adaptive.window`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from wfsobs.observers.base import VIBRATION, Look, Observer, Tunable
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.gpr.adaptive_step import AdaptiveGprEstimator, Schedule, schedule_of
from wfsobs.observers.gpr.learning import learn, nothing_learnt
from wfsobs.observers.kalman.adaptive import ADAPTIVE, Adaptive, identification_settings
from wfsobs.observers.step_checks import whole_frames
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, RecordError, Sampling
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.spectral.quick import SHORTEST
from wfsobs.typing import Array


def gpr_adaptive(measurements: Measurements, _prior: Prior, settings: Adaptive, watch: Watch) -> Estimates:
    """Run the regression over a record, one mode after the other; NaN until it has learnt once.

    Raises RecordError for a record shorter than that, or a window of too few samples.
    """
    schedule = schedule_of(settings, measurements.dt)
    needed = schedule.first + measurements.delay
    if measurements.n_steps <= needed:
        raise RecordError(f"the record has {measurements.n_steps} steps; half of adaptive.window and one more are {needed + 1}")
    z = measurements.z[measurements.delay :]  # what the mirror did before the record is not known
    columns = []
    for mode in range(measurements.n_modes):
        pieces = [np.full((2, measurements.delay + schedule.first), np.nan)]
        for done, piece in _pieces(z[:, mode], measurements.dt, settings, schedule):
            watch.step((mode + done) / measurements.n_modes)
            pieces.append(piece)
        columns.append(np.concatenate(pieces, axis=1))
    values, sd = np.stack(columns, axis=-1)
    return Estimates({VIBRATION: values}, {VIBRATION: sd})


def _pieces(z: Array, dt: float, settings: Adaptive, schedule: Schedule) -> Iterator[tuple[float, Array]]:
    """Yield the fraction done, and estimates and standard deviations (2, steps) from one time of learning to the next."""
    n, last = len(z), nothing_learnt(schedule.depth)
    for now in range(schedule.first, n, schedule.interval):
        start, stop = max(now - schedule.longest, 0), min(now + schedule.interval, n)
        last = learn(z[start:now], dt, schedule.depth, settings.peak_count, settings.lowest, last)
        x = PeriodicFilter([last.whitener]).run(
            (z[start:stop] - last.mean)[:, None, None], since=now - start - schedule.depth + 1
        )
        yield now / n, np.array([np.convolve(x[:, 0, 0], last.weights, "valid"), np.full(stop - now, last.sd)])


def step_gpr_adaptive(_prior: Prior, settings: Adaptive, sampling: Sampling, horizon: float) -> AdaptiveGprEstimator:
    """Return `gpr_adaptive`, one frame at a time, learning the vibration `horizon` frames ahead."""
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
    gpr_adaptive,
    help="Gaussian process regression that learns inputs, kernel and targets from the last 8 s; not in the paper",
    settings=ADAPTIVE,
    tunable=Tunable(("adaptive.window", "adaptive.depth"), ("adaptive.interval",)),
    weight=50.0,
    seconds=seconds,
    look=Look("Adaptive GPR", "#01734F", "#7AFED9", (20, 2, 2, 2), width=1.8),
    step=step_gpr_adaptive,
    counts=_settings_used,
)
