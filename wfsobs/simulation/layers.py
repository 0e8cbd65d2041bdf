"""The scenario's atmosphere: layers along the line of sight, the beams of its stars through them, and their covariances.

Airmass lengthens the path to layers and to guide stars alike, so that a laser's cone has the same share of the aperture in a
layer whatever the zenith angle.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from wfsobs.atmosphere import CORE, Footprint, TurbulenceLayer, fine_rule, nodes_across_wind, von_karman_density
from wfsobs.scenario import Scenario
from wfsobs.sensors.zernike import ZernikeProjection, bessel_ratio, tabulated_bessel_ratio
from wfsobs.typing import Array

ARCSEC = np.pi / 180.0 / 3600.0

CONE = 8.0 / 90.0
"""Height of the layer over that of the guide star that gives the slow LGS error."""


class Star(NamedTuple):
    """direction : (x, y) from the axis [rad]; distance: along the line of sight [m], infinite for a natural star."""

    direction: tuple[float, float]
    distance: float


def airmass(scenario: Scenario) -> float:
    """Return the path through the atmosphere over that at the zenith, for plane layers."""
    return float(1.0 / np.cos(np.radians(scenario.telescope.zenith_angle)))


def layers(scenario: Scenario) -> tuple[TurbulenceLayer, ...]:
    """Return the layers along the line of sight, their shares normalised to a sum of one."""
    t, way = scenario.turbulence, airmass(scenario)
    total = sum(layer.fraction for layer in t.layers)
    strength = t.r0 ** (-5.0 / 3.0) * way
    return tuple(
        TurbulenceLayer(
            strength * layer.fraction / total,
            layer.height * way,
            t.wind_speed * layer.wind_factor,
            float(np.radians(layer.wind_direction)),
        )
        for layer in t.layers
    )


def effective_wind(scenario: Scenario) -> float:
    """Return the effective wind speed [m/s], (sum of share v^(5/3))^(3/5) (Roddier 1981)."""
    if scenario.turbulence.source != "frozen-flow":
        return scenario.turbulence.wind_speed
    found = layers(scenario)
    mean = sum(x.strength * x.speed ** (5.0 / 3.0) for x in found) / sum(x.strength for x in found)
    return float(mean**0.6)


def on_axis() -> Star:
    """Return the direction of the truth."""
    return Star((0.0, 0.0), np.inf)


def natural_star(scenario: Scenario) -> Star:
    """Return the NGS."""
    x, y = scenario.sensors.ngs_direction
    return Star((x * ARCSEC, y * ARCSEC), np.inf)


def laser_stars(scenario: Scenario) -> list[Star]:
    """Return the LGS, evenly on their circle."""
    s = scenario.sensors
    angles = np.radians(s.lgs_angle) + 2.0 * np.pi * np.arange(s.lgs_count) / s.lgs_count
    radius, distance = s.lgs_radius * ARCSEC, s.lgs_altitude * airmass(scenario)
    return [Star((radius * float(np.cos(a)), radius * float(np.sin(a))), distance) for a in angles]


def footprint(star: Star, layer: TurbulenceLayer) -> Footprint:
    """Return where the beam of a star crosses a layer."""
    (x, y), distance = star
    return Footprint(1.0 - layer.height / distance, (layer.height * x, layer.height * y))


def ideal_sensor(scenario: Scenario) -> ZernikeProjection:
    """Return the plain projection on the scenario's modes."""
    return ZernikeProjection(scenario.telescope.diameter, tuple(mode.noll for mode in scenario.modes))


# ---------------------------------------------------------------------- covariances

LOG_K: Array = np.linspace(np.log(1e-9), np.log(1e4), 6000)
"""Spatial frequencies, times D / 2, of integrals over all directions; the smallest lie below any outer scale."""


@lru_cache(maxsize=256)
def mode_variance(order: int, diameter: float, strength: float, outer_scale: float, cone: float = 1.0) -> float:
    """Return the variance [um^2] of a Zernike mode in turbulence, or with `cone` that of the cone effect.

    Parameters
    ----------
    order : int
        Radial order.
    diameter : float
        Aperture diameter [m].
    strength : float
        r0^(-5/3), r0 at 500 nm [m^(-5/3)].
    outer_scale : float
        L0 [m].
    cone : float
        Width of the beam over that of the aperture; below 1, the variance is that of the error of this beam.

    Returns
    -------
    float
        Variance [um^2].
    """
    x = np.exp(LOG_K)
    seen = bessel_ratio(order + 1, x) - (bessel_ratio(order + 1, cone * x) if cone != 1.0 else 0.0)
    k = x / (0.5 * diameter)
    density = von_karman_density(k**2, strength, outer_scale) * 4.0 * (order + 1) * seen**2
    return float(np.trapezoid(2.0 * np.pi * k**2 * density, LOG_K))


def relative_rms(scenario: Scenario, mode: int) -> float:
    """Return the rms of a mode over that of tip, for the scenario's r0 and outer scale."""
    return _relative(scenario, mode, 1.0)


def relative_cone_error(scenario: Scenario, mode: int) -> float:
    """Return the cone effect of a mode over that of tip."""
    return _relative(scenario, mode, 1.0 - CONE)


def _relative(scenario: Scenario, mode: int, cone: float) -> float:
    order = scenario.modes[mode].radial_order
    if order == 1:
        return 1.0
    air = scenario.telescope.diameter, 1.0, scenario.turbulence.outer_scale, cone
    return float(np.sqrt(mode_variance(order, *air) / mode_variance(1, *air)))


def frozen_flow_variance(scenario: Scenario, mode: int) -> float:
    """Return the variance [um^2] of one mode on the axis."""
    strength = sum(layer.strength for layer in layers(scenario))
    return mode_variance(
        scenario.modes[mode].radial_order, scenario.telescope.diameter, strength, scenario.turbulence.outer_scale
    )


def star_covariance(scenario: Scenario) -> Array:
    """Return the covariance [um^2] of the modes seen by an ideal sensor on the axis and on each LGS.

    (1 + n_lgs, n_modes, 1 + n_lgs, n_modes).
    """
    stars = (on_axis(), *laser_stars(scenario))
    return _covariance(ideal_sensor(scenario), layers(scenario), scenario.turbulence.outer_scale, stars)


@lru_cache(maxsize=32)
def _covariance(sensor: ZernikeProjection, of: tuple[TurbulenceLayer, ...], outer_scale: float, stars: tuple[Star, ...]) -> Array:
    """Integrate by the rule of frozen flow across the wind, in both directions."""
    n = len(stars) * sensor.n_outputs
    total = np.zeros((n, n))
    for layer in of:
        nodes, weights = nodes_across_wind(
            2.0 * np.pi / outer_scale, CORE / (0.5 * sensor.diameter), *fine_rule(layer.height, sensor.diameter)
        )
        half = nodes.size // 2
        kx, ky = nodes[half:], nodes[:, None]
        power = 2.0 * weights[half:] * weights[:, None] * von_karman_density(kx**2 + ky**2, layer.strength, outer_scale)
        footprints = [footprint(star, layer) for star in stars]
        distinct = list(dict.fromkeys(footprints))
        seen = np.concatenate(
            [sensor.transform(kx, ky, f, tabulated_bessel_ratio).reshape(sensor.n_outputs, -1) for f in distinct]
        )
        seen *= np.sqrt(power).ravel()
        parts = np.real(seen @ seen.conj().T)
        rows = np.concatenate([np.arange(sensor.n_outputs) + distinct.index(f) * sensor.n_outputs for f in footprints])
        total += parts[np.ix_(rows, rows)]
    total.flags.writeable = False
    return total.reshape(len(stars), sensor.n_outputs, len(stars), sensor.n_outputs)
