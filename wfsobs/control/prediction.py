"""Vibration as the GPR predict it for a controller: what it will be while the next command acts.

In a loop that the prediction itself drives, u[k] does not exist yet at step k, so windows are of z whatever the settings of the
observer say; high-passed or standardised they are as those say. With a delay of two frames the target of the window ending at
step j is phi_vib[j+1]; the Butterworth bank on z says so at step j + 2, one step after the prediction was used.
"""

from __future__ import annotations

from typing import Any, TypeVar

from wfsobs.control.mirror import Plant
from wfsobs.observers.base import VIBRATION
from wfsobs.observers.gpr.offline import OfflineEstimator, OfflineGpr, trained_estimator
from wfsobs.observers.gpr.online import OnlineEstimator, OnlineGpr, learning_estimator
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling
from wfsobs.typing import Array

G = TypeVar("G", OfflineGpr, OnlineGpr)


def gpr_offline_ahead(measurements: Measurements, prior: Prior, plant: Plant, settings: Any, watch: Watch) -> Array:
    """Predict the vibration while u[k] acts, (n_steps, n_modes) [um], NaN before the first full window.

    The GPR is trained once on the training record, with targets as many steps later.
    """
    estimator = step_gpr_offline_ahead(prior, plant, settings, measurements.sampling)
    return estimator.run(measurements, watch, with_sd=False)[VIBRATION]


def step_gpr_offline_ahead(prior: Prior, plant: Plant, settings: Any, sampling: Sampling) -> OfflineEstimator:
    """Return `gpr_offline_ahead`, one frame at a time."""
    return trained_estimator(prior, of_z(settings.gpr_offline), sampling, plant.mirror.taps[1:], None)


def step_gpr_online_ahead(prior: Prior, plant: Plant, settings: Any, sampling: Sampling) -> OnlineEstimator:
    """Return `gpr_online_ahead`, one frame at a time."""
    return learning_estimator(prior, of_z(settings.gpr_online), sampling, plant.mirror.taps[1:])


def of_z(settings: G) -> G:
    """Return the settings of a GPR with windows of z."""
    out = settings.copy()
    out.inputs = "z"
    return out


def gpr_online_ahead(measurements: Measurements, prior: Prior, plant: Plant, settings: Any, watch: Watch) -> Array:
    """Predict the vibration while u[k] acts, (n_steps, n_modes) [um], NaN before the training set is full.

    The GPR is trained anew at every step (paper, Algorithm 3), at step k on the last windows whose target is known by then: those
    up to k - mirror.taps.size + 1.
    """
    estimator = step_gpr_online_ahead(prior, plant, settings, measurements.sampling)
    return estimator.run(measurements, watch)[VIBRATION]
