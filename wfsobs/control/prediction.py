"""Vibration as the GPR predict it for a controller: what it will be while the next command acts.

In a loop that the prediction itself drives, u[k] does not exist yet at step k, so windows are of z whatever the settings of the
observer say; high-passed or standardised they are as those say. With a delay of two frames the target of the window ending at
step j is phi_vib[j+1]; the Butterworth bank on z says so at step j + 2, one step after the prediction was used.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from wfsobs.control.mirror import Mirror, Plant
from wfsobs.observers.gpr.inputs import Scale, StreamingInputs, Windows, scale_of, scales_of, training_signals, window_signals
from wfsobs.observers.gpr.offline import OfflineEstimator, OfflineGpr, training_targets
from wfsobs.observers.gpr.online import OnlineEstimator, OnlineGpr, kernel_of
from wfsobs.observers.gpr.sliding_regression import LateRegression
from wfsobs.observers.gpr.trained import TrainedGpr, train
from wfsobs.observers.per_mode import over_modes
from wfsobs.prior import Bands, Prior
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Measurements, RecordError, Sampling
from wfsobs.signal.bandpass import StreamingBank, bandpass_bank
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


class VibrationPredictor:
    """The online GPR of one mode as a control loop calls it: one sample in, one prediction out, then an update.

    At step k it has learnt from the windows whose target is known by then: those up to k - mirror.taps.size + 1.
    """

    def __init__(self, settings: OnlineGpr, bands: Bands, plant: Plant, scale: Scale | None = None):
        """Scale: of standardised inputs, from `inputs.scale_of`."""
        g = of_z(settings)
        self._inputs = StreamingInputs(g, plant.dt, scale)
        self._taps = plant.mirror.taps
        self._bank = StreamingBank(bandpass_bank(bands.frequencies, bands.bandwidth_online, bands.order, plant.dt))
        self._regression = LateRegression(g.depth, g.training_size, 1, kernel_of(g), late=self._taps.size - 2)
        self._band_signal = np.zeros(self._taps.size - 1)  # newest first; of step k it tells phi_vib[k-1]

    def step(self, z: float) -> float:
        """Prediction [um] of the vibration while the command of this step acts; NaN until the training set is full."""
        self._band_signal = np.roll(self._band_signal, 1)
        self._band_signal[0] = self._bank.push(z)
        # of the window that ended as many steps ago as there are taps after the first
        target = self._taps[1:] @ self._band_signal[::-1]
        value = float(self._regression.predict(self._inputs.step(np.array([z]))[None], target[None])[0])
        self._regression.update()
        self._bank.settle()
        return value


def gpr_online_ahead(measurements: Measurements, prior: Prior, plant: Plant, settings: Any, watch: Watch) -> Array:
    """As `gpr_offline_ahead`, by `VibrationPredictor`."""
    g, bands = settings.gpr_online, prior.bands
    assert bands is not None
    done = np.zeros(measurements.n_modes)

    def one(mode: int, watch: Watch) -> Array:
        scale = scale_of(of_z(g), prior.training, measurements.delay, mode)
        predictor, z = VibrationPredictor(g, bands, plant, scale), measurements.z[:, mode].tolist()
        out = np.empty(measurements.n_steps)
        for k, sample in enumerate(z):
            if k % 256 == 0:
                done[mode] = k / measurements.n_steps
                watch.step(float(done.mean()))
            out[k] = predictor.step(sample)
        return out

    return over_modes(measurements.n_modes, one, watch)
