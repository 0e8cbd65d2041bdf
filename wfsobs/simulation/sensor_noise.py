"""The scenario's wavefront sensors, their noise and their aliasing."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from wfsobs.atmosphere import Sensor
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.sensors import Kind, fit_lenslets
from wfsobs.sensors.shack_hartmann import Aliasing, ShackHartmann, SpotModel
from wfsobs.simulation import layers as atmosphere
from wfsobs.typing import Array


def sensor(scenario: Scenario, kind: Kind) -> Sensor:
    """Return the sensor on an LGS or on the NGS. Raises SettingError where its slopes do not determine the modes."""
    return atmosphere.ideal_sensor(scenario) if scenario.sensors.kind == "zernike" else shack_hartmann(scenario, kind)


def shack_hartmann(scenario: Scenario, kind: Kind) -> ShackHartmann:
    """Return the Shack-Hartmann sensor on an LGS or on the NGS, see `sensor`."""
    lenslets, order = fit_lenslets(scenario.sensors.lenslets, kind, scenario.telescope.diameter, scenario.telescope.radial_order)
    return _cached_sensor(lenslets, tuple(mode.noll for mode in scenario.modes), order)


_cached_sensor = lru_cache(maxsize=4)(ShackHartmann)  # tens of megabytes each, for many modes


def noise_covariance(scenario: Scenario, kind: Kind) -> Array:
    """Return the covariance of the white noise of one LGS, or of the NGS, in one frame.

    Photon and read noise is the noise of Shack-Hartmann slopes, correlated between modes, whatever the sensor.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    kind : {"lgs", "ngs"}
        Which sensor.

    Returns
    -------
    Array
        (n_modes, n_modes) [um^2].
    """
    s = scenario.sensors
    if s.noise_from == "nm":
        return np.diag(_stated_noise(scenario, kind) ** 2)
    photons, fwhm = (getattr(s.spots, f"{kind}_{name}") for name in ("photons", "fwhm"))
    spots = SpotModel(photons, s.spots.read_noise, fwhm, s.spots.pixel_scale, s.spots.pixels)
    return shack_hartmann(scenario, kind).noise_covariance(spots)


def _stated_noise(scenario: Scenario, kind: Kind) -> Array:
    """Return the rms [um] per mode of noise given in nm, (n_modes,)."""
    s = scenario.sensors
    if kind == "ngs":
        return np.full(len(scenario.modes), s.ngs_noise)
    own = s.lgs_noise_per_mode[: len(scenario.modes)]
    return np.array(own + [s.lgs_noise] * (len(scenario.modes) - len(own)))


def noise_rms(scenario: Scenario, kind: Kind) -> Array:
    """Return the rms [um] of the white noise of one frame in each mode, (n_modes,)."""
    return np.sqrt(np.diag(noise_covariance(scenario, kind)))


def white_noise(scenario: Scenario, kind: Kind, n_steps: int, rng: np.random.Generator) -> Array:
    """Draw the noise of one LGS, or of the NGS, at every step [um], (n_steps, n_modes).

    Tip and tilt have the same random numbers with and without higher modes.
    """
    n_modes = len(scenario.modes)
    normal = np.hstack([rng.standard_normal((n_steps, 2)), rng.standard_normal((n_steps, n_modes - 2))])
    if scenario.sensors.noise_from == "nm":
        return normal * _stated_noise(scenario, kind)
    return normal @ np.linalg.cholesky(noise_covariance(scenario, kind)).T


def aliasing_rms(scenario: Scenario, kind: Kind) -> Array:
    """Return the rms [um] of the aliasing of an LGS, or of the NGS, in each mode, (n_modes,).

    The sensor minus the Zernike coefficients in the same beam. Zero where turbulence has no layers or the sensor is ideal.
    """
    if scenario.turbulence.source != "frozen-flow" or scenario.sensors.kind == "zernike":
        return np.zeros(len(scenario.modes))
    error, outer_scale = _aliasing(shack_hartmann(scenario, kind)), scenario.turbulence.outer_scale
    star = atmosphere.laser_stars(scenario)[0] if kind == "lgs" else atmosphere.natural_star(scenario)
    variance = sum(
        np.diag(error.covariance(layer.strength, outer_scale, atmosphere.footprint(star, layer).scale))
        for layer in atmosphere.layers(scenario)
    )
    return np.sqrt(variance)


_aliasing = lru_cache(maxsize=4)(Aliasing)
