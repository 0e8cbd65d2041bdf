"""Adaptive multi-rate filter: `multirate_multi` with a model that is identified from both sensors, again and again.

It needs no prior. While the record is still, the window grows from `adaptive.window` to `adaptive.longest`, so that close lines
part and every number becomes more certain; the peaks of the window before are tracked. Where the innovations are not as large as
the model says, something has changed, and the window is the shortest one again. A new filter starts at rest at the beginning of
its window. The mean of a window is taken off either sensor; that of the NGS counts as turbulence.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from wfsobs.observers.base import TARGETS, Estimates, Look, Observer, Tunable
from wfsobs.observers.kalman.adaptive import ADAPTIVE, Adaptive, identification_settings
from wfsobs.observers.kalman.both_window import (
    BothModel,
    Lengths,
    both_lengths,
    check_window,
    identify_both,
    is_still,
    next_length,
    window_start,
)
from wfsobs.observers.kalman.multirate_adaptive_step import BothEstimator
from wfsobs.observers.kalman.multirate_optimal import Cycle, optimal_filter
from wfsobs.observers.kalman.single import NGS
from wfsobs.observers.kalman.spread import by_name, learnt_sd
from wfsobs.observers.kalman.with_gaps import run_frames
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, RecordError, Sampling
from wfsobs.typing import Array


def multirate_adaptive(measurements: Measurements, _prior: Prior, settings: Adaptive, watch: Watch) -> Estimates:
    """Run the filter over a record; NaN until the first window is full.

    Raises RecordError for a record shorter than a window, or a window of too few samples.
    """
    assert measurements.ratio is not None
    lengths = both_lengths(settings, measurements.dt, measurements.ratio, measurements.delay)
    check_window(settings, lengths, measurements.dt)
    needed = lengths.first + lengths.window
    if measurements.n_steps < needed:
        raise RecordError(f"the record has {measurements.n_steps} steps; adaptive.window = {settings.window:g} s needs {needed}")
    if np.isnan(measurements.z).any() or np.isnan(measurements.z_ngs[lengths.ratio :: lengths.ratio]).any():
        return run_frames(BothEstimator(settings, measurements.sampling), measurements, watch)
    v = np.stack([measurements.z, np.nan_to_num(measurements.z_ngs)], axis=1)
    columns = []
    for mode in range(measurements.n_modes):

        def tell(fraction: float, mode: int = mode) -> None:
            watch.step((mode + fraction) / measurements.n_modes)

        columns.append(_adapt(v[:, :, mode], measurements.dt, lengths, settings, tell))
    return Estimates(*(by_name(np.stack(found, axis=-1)) for found in zip(*columns, strict=True)))


def _adapt(v: Array, dt: float, lengths: Lengths, settings: Adaptive, tell: Callable[[float], None]) -> tuple[Array, Array]:
    """Turbulence and vibration of one mode of v, both (n, 2), and deviations of these and of both together, (n, 3) [um]."""
    n, ratio = len(v), lengths.ratio
    out, sd = (np.full((n, len(TARGETS) + more), np.nan) for more in (0, 1))
    start, end, changed, found = lengths.first, lengths.first + lengths.window, 0, BothModel()
    while end <= n:
        tell(end / n)
        found = identify_both(v[start:end, 0], v[start + ratio - 1 : end : ratio, 1], dt, settings, found)
        due = end + next_length(end - start, lengths)
        if found.cycle is not None:
            run = run_window(found.cycle, v[start : min(due, n)], end - start, found.hidden_rms)
            for stop in range(end + lengths.interval, min(due, n) + 1, lengths.interval):
                if not is_still(run.surprise[stop - lengths.interval - end : stop - end]):
                    changed, due = stop - lengths.interval, stop
                    break
            out[end - 1 : due], sd[end - 1 : due] = run.estimates[: due - end + 1], run.sd[: due - end + 1]
        end = due
        start = window_start(end, changed, lengths)
    return out, sd


class WindowRun(NamedTuple):
    """A filter from the last step of its window on.

    estimates : of that step and the n behind it, (n + 1, 2) [um]
    sd        : standard deviations of these and of both together, (n + 1, 3) [um]
    surprise  : squared innovations of those n over their variances, (n,)
    """

    estimates: Array
    sd: Array
    surprise: Array


def run_window(cycle: Cycle, v: Array, size: int, hidden_rms: float) -> WindowRun:
    """Run the filter of a cycle over v (n, 2) from its first step on.

    size : steps of its window, which come first;  hidden_rms : rms of what may be in none of its lines [um]
    """
    frames = len(cycle.steps)
    means = np.array([v[:size, 0].mean(), v[frames - 1 : size : frames, 1].mean()])
    A, C, _, R = cycle.steps[0]
    filter_, states = optimal_filter(cycle.steps, np.vstack([cycle.rows, C[0] @ A]))
    found = filter_.cycle.run((v - means)[:, :, None], since=size - 1)[:, :, 0]
    innovations = v[size:, 0] - means[0] - found[:-1, 2]
    phase = np.arange(size - 1, len(v)) % frames
    variance = np.array([C[0] @ s.P @ C[0] + R[0, 0] for s in states])[phase[1:]]
    sd = learnt_sd(cycle.rows, [s.posterior for s in states], hidden_rms)[phase]
    return WindowRun(found[:, :2] + [means[1], 0.0], sd, innovations**2 / variance)


def step_multirate_adaptive(_prior: Prior, settings: Adaptive, sampling: Sampling, _horizon: float) -> BothEstimator:
    """Return `multirate_adaptive`, one frame at a time."""
    return BothEstimator(settings, sampling)


def seconds(settings: Adaptive, n_steps: int, n_modes: int, dt: float) -> float:
    """9 ms + 1 us per sample for every window, one mode after the other; windows grow [s]."""
    lengths, out = both_lengths(settings, dt, 1, 0), 0.0
    end = lengths.window
    while end <= n_steps:
        window = min(end, lengths.longest)
        out += 9e-3 + 1e-6 * window
        end += next_length(window, lengths)
    return n_modes * out


def _settings_used(prior: Prior, settings: Adaptive) -> tuple[float, ...]:
    return *identification_settings(prior, settings), settings.longest


MULTIRATE_ADAPTIVE = Observer(
    "multirate-adaptive",
    "Adaptive multi-rate KF",
    TARGETS,
    multirate_adaptive,
    help="Kalman filter on both sensors that identifies noise, turbulence, peaks and LGS error as it runs; not in the paper",
    settings=ADAPTIVE,
    needs=NGS,
    takes_missing=True,
    sensors=("lgs", "ngs"),
    tunable=Tunable(("adaptive.window",), ("adaptive.longest", "adaptive.interval")),
    weight=50.0,
    seconds=seconds,
    look=Look("Adaptive multi-rate", "#591677", "#F3C1F7", (20, 2, 3, 2), width=1.8),
    step=step_multirate_adaptive,
    counts=_settings_used,
)
