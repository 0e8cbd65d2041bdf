"""Errors of laser guide stars, and the combination of several to one measurement.

The minimum-variance weights are those of the best linear estimate of the disturbance on the axis from all
LGS measurements of one step,

    W = C_ty C_yy^-1,    C_ty = E phi_dist y',    C_yy = E y y',

with the covariances of the model: turbulence in each beam, vibration, which is common to all, and noise. They account for
the angle between the stars and for their cones, not for time. They apply to pseudo-open-loop measurements, so that a loop
sees its own commands in full.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from wfsobs.scenario import Scenario
from wfsobs.signal.ar2 import Ar2, turbulence_corner
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.disturbance import vibration_variance
from wfsobs.simulation.sensor_noise import noise_covariance, noise_rms
from wfsobs.simulation.turbulence import turbulence_process, turbulence_rms
from wfsobs.typing import Array

MEAN = "mean"
"""The combination without a model."""


def stars_differ(scenario: Scenario, mode: int) -> bool:
    """Return whether the LGS see different turbulence in a mode, so that each tells something that their mean does not."""
    s = scenario.sensors
    blind = s.tip_tilt_indetermination and scenario.modes[mode].radial_order == 1
    return scenario.turbulence.source == "frozen-flow" and s.lgs_count > 1 and s.lgs_radius > 0 and not blind


def low_frequency_process(scenario: Scenario, mode: int) -> Ar2:
    """Return the AR(2) process that stands for cone effect and uplink turbulence of one LGS in one mode; zero with frozen flow.

    It has the corner of the turbulence, since the missed part of the beam moves with the same wind. A higher
    order has the rms of tip in the ratio of their cone effects.
    """
    t = scenario.turbulence
    corner = turbulence_corner(t.wind_speed, scenario.telescope.diameter, scenario.modes[mode].radial_order)
    rms = 0.0
    if t.source != "frozen-flow":
        rms = scenario.sensors.lgs_low_frequency_rms * atmosphere.relative_cone_error(scenario, mode)
    return Ar2(corner, t.damping, rms, scenario.dt)


def lgs_weights(scenario: Scenario, stars: int | None = None) -> Array:
    """Return the weights of the guide-star combination.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    stars : int, optional
        Number of stars in use, the first ones; by default all.

    Returns
    -------
    Array
        Weight of mode j of star i in mode k, (n_modes, n_lgs, n_modes).
    """
    stars, modes = stars or scenario.sensors.lgs_count, len(scenario.modes)
    if scenario.sensors.lgs_combination == MEAN:
        return np.tile(np.eye(modes)[:, None] / stars, (1, stars, 1))
    return _best_weights(scenario, stars)


@lru_cache(maxsize=8)  # a scenario is what its settings are, whenever it was asked
def _best_weights(scenario: Scenario, stars: int) -> Array:
    """Return the minimum-variance weights of the first `stars` stars."""
    modes = len(scenario.modes)
    seen, noise = lgs_turbulence_covariance(scenario), noise_covariance(scenario, "lgs")
    for mode in range(modes):
        seen[:, mode, :, mode] += vibration_variance(scenario, mode)
    for star in range(1, stars + 1):
        seen[star, :, star] += noise
    n = stars * modes
    last = 1 + stars
    measured = seen[1:last, :, 1:last].reshape(n, n)
    found = seen[0, :, 1:last].reshape(modes, n) @ np.linalg.pinv(measured, rcond=1e-12, hermitian=True)
    found.flags.writeable = False
    return found.reshape(modes, stars, modes)


def lgs_turbulence_covariance(scenario: Scenario) -> Array:
    """Return the covariance [um^2] of the turbulence on the axis and as measured by each LGS, noise excluded.

    (1 + n_lgs, n_modes, 1 + n_lgs, n_modes); the errors of the stars are included.
    """
    stars, modes = 1 + scenario.sensors.lgs_count, len(scenario.modes)
    if scenario.turbulence.source == "frozen-flow":
        out = atmosphere.star_covariance(scenario).copy()
    else:
        own = np.diag([turbulence_rms(scenario, mode) ** 2 for mode in range(modes)])
        out = np.tile(own[None, :, None, :], (stars, 1, stars, 1))
    if scenario.sensors.tip_tilt_indetermination:
        blind = [i for i, mode in enumerate(scenario.modes) if mode.radial_order == 1]
        out[1:, blind] = 0.0
        out[:, :, 1:, blind] = 0.0
    for mode in range(modes):
        out[range(1, stars), mode, range(1, stars), mode] += low_frequency_process(scenario, mode).rms ** 2
    return out


def lgs_error_variance(scenario: Scenario, mode: int, stars: int | None = None) -> float:
    """Return the variance [um^2] of the combined LGS turbulence minus that on the axis, without noise.

    stars : as in `lgs_weights`
    """
    combined = np.concatenate([np.zeros((1, len(scenario.modes))), lgs_weights(scenario, stars)[mode]])
    combined[0, mode] = -1.0
    n = len(combined)
    return float(np.einsum("ij,ijkl,kl->", combined, lgs_turbulence_covariance(scenario)[:n, :, :n], combined))


def lgs_error_process(scenario: Scenario, mode: int, dt: float) -> Ar2:
    """Return the slow error of the combined LGS in one mode: AR(2), with the corner of the turbulence."""
    if scenario.turbulence.source != "frozen-flow" and scenario.sensors.lgs_combination == MEAN:
        one = low_frequency_process(scenario, mode)
        return replace(one, rms=one.rms / np.sqrt(scenario.sensors.lgs_count), dt=dt)
    rms = float(np.sqrt(max(lgs_error_variance(scenario, mode), 0.0)))
    return replace(turbulence_process(scenario, mode, dt), rms=rms)


def lgs_noise_rms(scenario: Scenario, mode: int, stars: int | None = None) -> float:
    """Return the rms [um] of the white noise of the combined LGS in one mode; stars: as `lgs_weights`."""
    if scenario.sensors.lgs_combination == MEAN:
        return float(noise_rms(scenario, "lgs")[mode] / np.sqrt(stars or scenario.sensors.lgs_count))
    own = lgs_weights(scenario, stars)[mode]
    return float(np.sqrt(np.einsum("ij,jk,ik->", own, noise_covariance(scenario, "lgs"), own)))
