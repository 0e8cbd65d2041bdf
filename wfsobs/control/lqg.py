"""LQG control: command against the disturbance what a Kalman filter predicts of it.

The mirror follows a command at once and without cost, so the best command is minus the prediction of what the disturbance
will be while it acts (certainty equivalence): u[k] = -(turb_hat[k+1] + vib_hat[k+1]) for the paper's delay of two
frames, and for n + f frames the mean over the time that the command is held,

    u[k] = -((1 - f) phi_hat[k+n-1] + f phi_hat[k+n]).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from wfsobs.control.law import Law, steady_law
from wfsobs.control.mirror import Mirror
from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.multirate import MultiRateFilter, multirate_filter, multirate_noise
from wfsobs.observers.kalman.multirate_optimal import optimal_filter, optimal_model
from wfsobs.observers.kalman.single import steady_filter
from wfsobs.prior import Prior
from wfsobs.priors_from.scenario import kalman_model, lgs_error_of, measurement_noise, model_of, multi_model
from wfsobs.scenario import Scenario
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.typing import Array


def command_rows(A: Array, phi: Array, mirror: Mirror) -> Array:
    """Row (1, n) that makes the command of the estimated state x_hat[k].

    A (n, n): transition; phi (n,): row that gives phi_dist[k], which no other part of the state drives later on
    """
    row = -phi
    out = np.zeros_like(row)
    for tap in mirror.taps[1:]:
        out += tap * row
        row = row @ A
    return out[None, :]


def _rows_of(model: DisturbanceModel, mirror: Mirror) -> Array:
    return command_rows(model.A, model.output_rows(TARGETS).sum(axis=0), mirror)


def lqg_of(model: DisturbanceModel, noise: float, mirror: Mirror) -> Law:
    """LQG on the LGS with any model; noise [um] of a measurement. Raises RiccatiError."""
    return steady_law(steady_filter(model, noise, _rows_of(model, mirror))[0])


def lqg_kf_lgs(scenario: Scenario, mode: int, mirror: Mirror) -> Law:
    """With the model of the LGS Kalman filter: turbulence and one vibration peak."""
    return lqg_of(kalman_model(scenario, mode, scenario.dt), measurement_noise(scenario, mode)[0], mirror)


def lqg_kf_multi(scenario: Scenario, mode: int, mirror: Mirror) -> Law:
    """With every peak of the vibration in the model."""
    return lqg_of(multi_model(scenario, mode, scenario.dt), measurement_noise(scenario, mode)[0], mirror)


def lqg_multirate(scenario: Scenario, mode: int, mirror: Mirror) -> Law:
    """With the paper's multi-rate filter. Raises SettingError where its cycle is unstable."""
    prior = model_of(scenario, mode)
    model, noise = prior.disturbance(), multirate_noise(scenario.multirate, prior)
    return _two_sensors(multirate_filter(model, scenario.sensors.exposure_ratio, *noise, _rows_of(model, mirror)))


def lqg_multirate_optimal(scenario: Scenario, mode: int, mirror: Mirror) -> Law:
    """With the optimal multi-rate filter."""
    return _optimal(scenario, mode, mirror, None)


def lqg_multirate_multi(scenario: Scenario, mode: int, mirror: Mirror) -> Law:
    """With the optimal multi-rate filter and every peak of the vibration in its model."""
    return _optimal(scenario, mode, mirror, multi_model(scenario, mode, scenario.dt))


def _optimal(scenario: Scenario, mode: int, mirror: Mirror, model: DisturbanceModel | None) -> Law:
    prior = Prior((model_of(scenario, mode),), (lgs_error_of(scenario, mode),))
    cycle, rows = optimal_model(scenario.multirate, prior, 0, scenario.sensors.exposure_ratio, model)
    return _two_sensors(optimal_filter(cycle, command_rows(cycle[0][0], rows.sum(axis=0), mirror))[0])


def _two_sensors(filter_: MultiRateFilter) -> Law:
    return Law(filter_.cycle, lambda z: filter_.run(z)[:, 0])


LQG: dict[str, Callable[[Scenario, int, Mirror], Law]] = {
    "lqg-kf-lgs": lqg_kf_lgs,
    "lqg-kf-multi": lqg_kf_multi,
    "lqg-multirate": lqg_multirate,
    "lqg-multirate-optimal": lqg_multirate_optimal,
    "lqg-multirate-multi": lqg_multirate_multi,
}
"""Controller -> its law in one mode."""
