"""Temporal spectra of frozen flow seen by ideal sensors: the expectation of the signals of `frozen_flow`.

A layer of wind speed v turns the spatial frequency k_x along the wind into f = k_x v / 2 pi. With Phi the von Karman density and
M_i the transform of a functional (`plane_waves`), two of them have the one-sided cross spectrum

    S_ij(f) = (2 pi / v) 2 integral dk_y Phi(k) conj(M_i(k)) M_j(k),

times sinc^2(f T) for the mean over a step. Layers are independent and add. Aliasing is left out (`lenslet_spectra`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from wfsobs.atmosphere.plane_waves import Footprint
from wfsobs.atmosphere.von_karman import TurbulenceLayer
from wfsobs.scenario import Scenario
from wfsobs.signal.wiener import Complex
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.flow_integral import ModesInBeams, PlaneWaves, SpectraBetween, spectra_between
from wfsobs.simulation.guide_stars import MEAN, lgs_weights, stars_differ
from wfsobs.typing import Array


class TurbulenceSpectra(NamedTuple):
    """Spectra of the turbulence in one mode, one-sided [um^2/Hz], or per sample, with the errors of the combined LGS.

    Attributes
    ----------
    own, measurement, ngs : Array
        On the axis, of the mean of the LGS, and of the NGS.
    cross, ngs_cross, sensors_cross : Array
        Between the axis and the LGS, between the axis and the NGS, and between the NGS and the LGS.
    """

    own: Array
    measurement: Array
    cross: Complex | Array
    ngs: Array
    ngs_cross: Complex | Array
    sensors_cross: Complex | Array


def flow_spectra(scenario: Scenario, mode: int, frequency: Array) -> TurbulenceSpectra:
    """Compute the spectra of one mode of frozen flow.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    mode : int
        Index of the mode.
    frequency : Array
        Frequencies from 0 on, (n,) [Hz].

    Returns
    -------
    TurbulenceSpectra
        Six densities, (n,) each [um^2/Hz].
    """
    if scenario.sensors.lgs_combination == MEAN and stars_differ(scenario, mode):
        shared = _stars_apart(scenario, mode, frequency, 1)
    else:
        shared = spectra_between(scenario, mode, frequency, _stars_together)
    own, ngs, measurement = shared.density
    cross = shared.pair(0, 2)
    if atmosphere.natural_star(scenario) == atmosphere.on_axis():
        return TurbulenceSpectra(own, measurement, cross, own, own + 0j, cross)
    return TurbulenceSpectra(own, measurement, cross, ngs, shared.pair(0, 1), shared.pair(1, 2))


def star_flow_spectra(scenario: Scenario, mode: int, frequency: Array) -> SpectraBetween:
    """Compute the spectra of one mode of frozen flow, every LGS apart.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    mode : int
        Index of the mode.
    frequency : Array
        Frequencies from 0 on, (n,) [Hz].

    Returns
    -------
    SpectraBetween
        One-sided cross spectra [um^2/Hz] of the signal on the axis, that of the NGS, the mean of the LGS and their orthonormal
        differences (`star_basis`).
    """
    return _stars_apart(scenario, mode, frequency, scenario.sensors.lgs_count)


def _stars_apart(scenario: Scenario, mode: int, frequency: Array, count: int) -> SpectraBetween:
    """Return those of the axis, the NGS, and the first `count` of `star_basis`, from spectra between beams that are kept."""
    weights = block_diag(np.eye(2), star_basis(scenario.sensors.lgs_count)[:count])
    return spectra_between(scenario, mode, frequency, _beams, weights=weights)


def star_basis(stars: int) -> Array:
    """Return the weights of the stars in their mean and in orthonormal differences, (n_stars, n_stars).

    The differences are the harmonics on the circle of the stars, which have little in common.
    """
    angle = 2.0 * np.pi * np.outer(np.arange(1, stars // 2 + 1), np.arange(stars)) / stars
    waves = np.stack([np.cos(angle), np.sin(angle)], axis=1).reshape(-1, stars)[: stars - 1]
    differences = waves / np.linalg.norm(waves, axis=1, keepdims=True)
    return np.vstack([np.full(stars, 1.0 / stars), differences])


ModeInBeam = Callable[[Scenario, int, PlaneWaves, Footprint], Complex]
"""(scenario, mode, waves, footprint) -> transform of the mode in that beam."""


def _stars_together(scenario: Scenario, mode: int, layer: TurbulenceLayer, waves: PlaneWaves) -> list[Complex]:
    """Return those of axis, NGS and combined LGS."""
    footprints = (Footprint(), atmosphere.footprint(atmosphere.natural_star(scenario), layer))
    natural = [ideal_mode(scenario, mode, waves, footprint) for footprint in footprints]
    return [*natural, of_stars(scenario, mode, layer, waves, ideal_mode)]


def _beams(scenario: Scenario, mode: int, layer: TurbulenceLayer, _waves: PlaneWaves) -> ModesInBeams:
    """Return those of axis, NGS and every LGS."""
    stars = (atmosphere.on_axis(), atmosphere.natural_star(scenario), *atmosphere.laser_stars(scenario))
    noll = scenario.modes[mode].noll
    return ModesInBeams(scenario.telescope.diameter, [(noll, atmosphere.footprint(star, layer)) for star in stars])


def of_stars(scenario: Scenario, mode: int, layer: TurbulenceLayer, waves: PlaneWaves, star_mode: ModeInBeam) -> Complex:
    """Return the transform of the combined LGS; star_mode : of a mode of each of them."""
    combined = np.zeros(waves.x.shape, dtype=np.complex128)
    for star, gains in zip(atmosphere.laser_stars(scenario), lgs_weights(scenario)[mode], strict=True):
        footprint = atmosphere.footprint(star, layer)
        for other, gain in enumerate(gains):
            blind = scenario.sensors.tip_tilt_indetermination and scenario.modes[other].radial_order == 1
            if gain != 0.0 and not blind:
                combined += gain * star_mode(scenario, other, waves, footprint)
    return combined


def ideal_mode(scenario: Scenario, mode: int, waves: PlaneWaves, footprint: Footprint) -> Complex:
    """Return the transform of a mode in a beam."""
    return waves.mode(scenario.telescope.diameter, scenario.modes[mode].noll, footprint)
