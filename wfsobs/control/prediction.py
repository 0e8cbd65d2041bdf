"""Vibration as the GPR predict it for a controller: what it will be while the next command acts.

In a loop that the prediction itself drives, u[k] does not exist yet at step k, so windows are of z whatever the settings of the
observer say; high-passed or standardised they are as those say. With a delay of two frames the target of the window ending at
step j is phi_vib[j+1]; the Butterworth bank on z says so at step j + 2, one step after the prediction was used.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from wfsobs.control.mirror import Mirror, Plant
from wfsobs.observers.base import VIBRATION
from wfsobs.observers.gpr.inputs import Windows, scale_of, scales_of, training_signals, window_signals
from wfsobs.observers.gpr.offline import OfflineEstimator, OfflineGpr, TrainedGpr, train, training_targets
from wfsobs.observers.gpr.online import OnlineEstimator, OnlineGpr, kernel_of
from wfsobs.observers.per_mode import over_modes
from wfsobs.observers.step import run_frames
from wfsobs.prior import Prior
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Measurements, RecordError, Sampling
from wfsobs.typing import Array

G = TypeVar("G", OfflineGpr, OnlineGpr)


def gpr_offline_ahead(measurements: Measurements, prior: Prior, plant: Plant, settings: Any, watch: Watch) -> Array:
    """Predict the vibration while u[k] acts, (n_steps, n_modes) [um], NaN before the first full window.

    The GPR is trained once on the training record, with targets as many steps later.
    """
    g, training = of_z(settings.gpr_offline), prior.training
    if training is None:
        raise RecordError("the record has no training data")
    assert prior.bands is not None
    if measurements.n_steps < g.depth:
        raise RecordError(f"the record has {measurements.n_steps} steps; depth needs {g.depth}")
    dt, delay = measurements.dt, measurements.delay

    def one(mode: int, watch: Watch) -> Array:
        model = _train_ahead(prior, g, mode, plant, dt, delay, watch)
        scale = scale_of(g, training, delay, mode)
        return model.predict(window_signals(g, measurements.y_lgs, measurements.u, measurements.z, mode, dt, scale), watch)

    return over_modes(measurements.n_modes, one, watch)


def _train_ahead(prior: Prior, g: OfflineGpr, mode: int, plant: Plant, dt: float, delay: int, watch: Watch = QUIET) -> TrainedGpr:
    """Train on the vibration while u[k] acts, in one mode of the training record. Raises RecordError."""
    training = prior.training
    if training is None:
        raise RecordError("the record has no training data")
    assert prior.bands is not None
    steps, ahead = training.y_lgs.shape[0], plant.mirror.taps.size - 2  # by which the targets end earlier
    if steps < (needed := g.depth + g.training_size + ahead):
        raise RecordError(f"the training data has {steps} steps, depth + training size + {ahead} need {needed}")
    targets = _ahead(training_targets(training, prior.bands, dt, delay)[:, mode], plant.mirror)
    return train(training_signals(g, training, mode, dt, delay), targets, g.depth, g.training_size, kernel_of(g), watch)


def step_gpr_offline_ahead(prior: Prior, plant: Plant, settings: Any, sampling: Sampling) -> OfflineEstimator:
    """Return `gpr_offline_ahead`, one frame at a time."""
    g = of_z(settings.gpr_offline)
    models = [_train_ahead(prior, g, mode, plant, sampling.dt, sampling.delay) for mode in range(sampling.n_modes)]
    return OfflineEstimator(Windows(g, sampling, g.depth, scales_of(g, prior.training, sampling)), models, None)


def step_gpr_online_ahead(prior: Prior, plant: Plant, settings: Any, sampling: Sampling) -> OnlineEstimator:
    """Return `gpr_online_ahead`, one frame at a time."""
    g = of_z(settings.gpr_online)
    assert prior.bands is not None
    windows = Windows(g, sampling, 1, scales_of(g, prior.training, sampling))
    return OnlineEstimator(windows, prior.bands, sampling, g.depth, g.training_size, kernel_of(g), plant.mirror.taps[1:])


def of_z(settings: G) -> G:
    """Return the settings of a GPR with windows of z."""
    out = settings.copy()
    out.inputs = "z"
    return out


def _ahead(x: Array, mirror: Mirror) -> Array:
    """Return the mean of x (n, ...) while u[k] acts; NaN at the end, where it is not known."""
    out = np.zeros_like(x)
    for steps, tap in enumerate(mirror.taps[1:]):
        if tap:
            out += tap * np.concatenate([x[steps:], np.full((steps, *x.shape[1:]), np.nan)])
    return out


def gpr_online_ahead(measurements: Measurements, prior: Prior, plant: Plant, settings: Any, watch: Watch) -> Array:
    """Predict the vibration while u[k] acts, (n_steps, n_modes) [um], NaN before the training set is full.

    The GPR is trained anew at every step (paper, Algorithm 3), at step k on the last windows whose target is known by then: those
    up to k - mirror.taps.size + 1.
    """
    estimator = step_gpr_online_ahead(prior, plant, settings, measurements.sampling)
    return run_frames(estimator, (VIBRATION,), measurements, watch)[VIBRATION]
