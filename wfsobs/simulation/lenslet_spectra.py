"""Temporal spectra of frozen flow seen by Shack-Hartmann sensors, their aliasing included: those of records with such sensors.

As `flow_spectra`, with the transforms M_j(k) of the sensors in place of those of the Zernike modes, and nodes as fine as they ask
for. Aliasing is correlated with the modes that it is taken for, so the whole spectra are computed, not those of an added noise.
It takes one or two seconds a mode, where spectra of ideal sensors take a tenth of one; bounds and theory leave aliasing out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wfsobs.atmosphere.plane_waves import Footprint
from wfsobs.atmosphere.von_karman import TurbulenceLayer
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.sensors import Kind
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.flow_spectra import PlaneWaves, TurbulenceSpectra, ideal_mode, of_stars, spectra_between
from wfsobs.simulation.sensor_noise import shack_hartmann
from wfsobs.simulation.true_spectra import TrueSpectra, n_frequencies, per_sample, true_spectra
from wfsobs.typing import Array


def true_lenslet_spectra(scenario: Scenario, mode: int) -> TrueSpectra:
    """Compute the spectra of one mode of frozen flow as Shack-Hartmann sensors see it.

    Parameters
    ----------
    scenario : Scenario
        Settings; of frozen flow.
    mode : int
        Index of the mode.

    Returns
    -------
    TrueSpectra
        Spectra.

    Raises
    ------
    ValueError
        The turbulence is no frozen flow: it has no waves that lenslets could alias.
    """
    if scenario.turbulence.source != "frozen-flow":
        raise ValueError(f"turbulence.source = {scenario.turbulence.source}: aliasing is that of frozen flow")
    air = per_sample(scenario, n_frequencies(scenario, mode), lambda frequency: lenslet_flow_spectra(scenario, mode, frequency))
    return true_spectra(scenario, mode, air)


def lenslet_flow_spectra(scenario: Scenario, mode: int, frequency: Array) -> TurbulenceSpectra:
    """Compute the spectra of one mode, as `flow_spectra`, of the signals of Shack-Hartmann sensors.

    Parameters
    ----------
    scenario : Scenario
        Settings; of frozen flow.
    mode : int
        Index of the mode.
    frequency : Array
        Frequencies from 0 on, (n,) [Hz].

    Returns
    -------
    TurbulenceSpectra
        Six densities, (n,) each [um^2/Hz].
    """
    beams = [atmosphere.footprint(star, layer).scale for star in _stars(scenario) for layer in atmosphere.layers(scenario)]
    reach = max(shack_hartmann(scenario, kind).reach for kind in ("lgs", "ngs")) / min(beams)
    shared = spectra_between(scenario, mode, frequency, _through_lenslets, reach)
    own, measurement, ngs = shared.density
    return TurbulenceSpectra(own, measurement, shared.pair(0, 1), ngs, shared.pair(0, 2), shared.pair(2, 1))


def _stars(scenario: Scenario) -> list[atmosphere.Star]:
    return [atmosphere.natural_star(scenario), *atmosphere.laser_stars(scenario)]


def _through_lenslets(scenario: Scenario, mode: int, layer: TurbulenceLayer, waves: PlaneWaves) -> list[NDArray[np.complex128]]:
    """Return the transforms of axis, combined LGS and NGS."""
    natural = atmosphere.footprint(atmosphere.natural_star(scenario), layer)
    return [
        ideal_mode(scenario, mode, waves, Footprint()),
        of_stars(scenario, mode, layer, waves, _lgs_mode),
        _sensor_mode(scenario, "ngs", mode, waves, natural),
    ]


def _lgs_mode(scenario: Scenario, mode: int, waves: PlaneWaves, footprint: Footprint) -> NDArray[np.complex128]:
    return _sensor_mode(scenario, "lgs", mode, waves, footprint)


def _sensor_mode(scenario: Scenario, kind: Kind, mode: int, waves: PlaneWaves, footprint: Footprint) -> NDArray[np.complex128]:
    """Return the transform of a mode as a sensor gives it."""
    seen = shack_hartmann(scenario, kind).transform(footprint.scale * waves.x, footprint.scale * waves.y)[mode]
    return seen * waves.turn(footprint)
