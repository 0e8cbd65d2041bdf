"""Cross spectra of the modes of frozen flow: what of a mode is told by the others.

The modes are projections of one screen that moves with the wind. What enters the aperture with one mode passes it with another,
and what the LGS see through a narrower beam as one mode is of several modes of the whole aperture. So the modes have a matrix of
spectra S(f), Hermitian and positive semidefinite, that `flow_spectra` has the diagonal of.

What each LGS of an asterism measures in one mode is a mean and differences between the stars. The differences are orthonormal
(`star_basis`), so that their noise is that of one star, and independent of the mean's. Vibration is the same for all stars and in
none of them.

Records with Shack-Hartmann sensors have their aliasing: as `flow_spectra`, with the transforms M_j(k) of the sensors in place of
those of the Zernike modes, and nodes as fine as they ask for. Aliasing is correlated with the modes that it is taken for, so the
whole spectra are computed, not those of an added noise. It takes one or two seconds a mode, where spectra of ideal sensors take a
tenth of one; bounds and theory leave aliasing out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from wfsobs.atmosphere import Footprint, TurbulenceLayer
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.sensors import Kind
from wfsobs.signal.wiener import Complex
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.disturbance import vibration_lines
from wfsobs.simulation.flow_spectra import (
    ModesInBeams,
    PlaneWaves,
    Sight,
    SpectraBetween,
    TurbulenceSpectra,
    ideal_mode,
    of_stars,
    spectra_between,
    star_basis,
    star_flow_spectra,
)
from wfsobs.simulation.sensing import is_blind, lgs_weights
from wfsobs.simulation.sensor_noise import noise_rms, shack_hartmann
from wfsobs.simulation.true_spectra import FLOOR, TrueSpectra, n_frequencies, notched_frequencies, per_sample, true_spectra
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
    stars = [atmosphere.natural_star(scenario), *atmosphere.laser_stars(scenario)]
    beams = [atmosphere.footprint(star, layer).scale for star in stars for layer in atmosphere.layers(scenario)]
    reach = max(shack_hartmann(scenario, kind).reach for kind in ("lgs", "ngs")) / min(beams)
    shared = spectra_between(scenario, mode, frequency, _through_lenslets, reach)
    own, measurement, ngs = shared.density
    return TurbulenceSpectra(own, measurement, shared.pair(0, 1), ngs, shared.pair(0, 2), shared.pair(2, 1))


def _through_lenslets(scenario: Scenario, mode: int, layer: TurbulenceLayer, waves: PlaneWaves) -> list[Complex]:
    """Return the transforms of axis, combined LGS and NGS."""
    natural = atmosphere.footprint(atmosphere.natural_star(scenario), layer)
    return [
        ideal_mode(scenario, mode, waves, Footprint()),
        of_stars(scenario, mode, layer, waves, partial(_sensor_mode, "lgs")),
        _sensor_mode("ngs", scenario, mode, waves, natural),
    ]


def _sensor_mode(kind: Kind, scenario: Scenario, mode: int, waves: PlaneWaves, footprint: Footprint) -> Complex:
    """Return the transform of a mode as a sensor gives it."""
    seen = shack_hartmann(scenario, kind).transform(footprint.scale * waves.x, footprint.scale * waves.y)[mode]
    return seen * waves.turn(footprint)


PER_DECADE, PER_SMOOTH_DECADE = 200, 40
"""Nodes of the sums over frequency, and those where spectra have no ripples."""

SMOOTH = 0.1
"""Frequency below which they have none, over the share of the aperture that the slowest wind crosses in a second."""

ABOUT_LINES = np.geomspace(0.012, 0.6, 6)
"""Nodes on either side of a line [Hz]: filters that know of it respond there to little else."""

SLOWEST = 1e-4
"""Minimum frequency of the nodes, over the same."""


@dataclass(frozen=True)
class ModeSpectra:
    """One-sided spectra of all modes [um^2/Hz], between the axis and beams: the combined LGS, or those of `beam_spectra`.

    Attributes
    ----------
    own : Array
        Densities on the axis, (n_modes, n).
    measurement : Array
        Cross spectra of all modes of the first beam, then of the next, without noise: the transform over j of E m_i[k] m_l[k-j],
        (n_beams n_modes, n_beams n_modes, n).
    cross : Array
        Those of the modes on the axis and the modes of the beams, (n_modes, n_beams n_modes, n).
    """

    own: Array
    measurement: Complex
    cross: Complex


def are_coupled(scenario: Scenario) -> bool:
    """Return whether modes tell of one another: there are several, of frozen flow."""
    return scenario.turbulence.source == "frozen-flow" and len(scenario.modes) > 1


def mode_spectra(scenario: Scenario, frequency: Array) -> ModeSpectra:
    """Compute the spectra of all modes of frozen flow, on the axis and in the combined LGS.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    frequency : Array
        Frequencies from 0 on, (n,) [Hz].

    Returns
    -------
    ModeSpectra
        Densities.
    """
    return _spectra(scenario, frequency, _all_modes)


def beam_spectra(scenario: Scenario, frequency: Array) -> ModeSpectra:
    """Compute those of every beam by itself: the mean of the LGS, their orthonormal differences (`star_basis`), and the NGS.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    frequency : Array
        Frequencies from 0 on, (n,) [Hz].

    Returns
    -------
    ModeSpectra
        Densities, of n_lgs + 1 beams.
    """
    return _spectra(scenario, frequency, _all_modes_of_beams, _mean_and_differences(scenario))


def combined_spectra(scenario: Scenario, frequency: Array) -> ModeSpectra:
    """Compute those of two beams: the combined LGS, and the NGS.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    frequency : Array
        Frequencies from 0 on, (n,) [Hz].

    Returns
    -------
    ModeSpectra
        Densities.
    """
    m = len(scenario.modes)
    if atmosphere.natural_star(scenario) == atmosphere.on_axis():
        return _spectra(scenario, frequency, _all_modes, beams=[*range(m, 2 * m), *range(m)])
    return _spectra(scenario, frequency, _all_modes_of_both)


def _spectra(
    scenario: Scenario, frequency: Array, sight: Sight, weights: Array | None = None, beams: Sequence[int] | None = None
) -> ModeSpectra:
    """Return those of what a sight gives, the axis first; beams : places of the signals of beams, by default all others."""
    found, m = spectra_between(scenario, None, frequency, sight, weights=weights), len(scenario.modes)
    beams = range(m, len(found.density)) if beams is None else beams
    cross = np.array([[found.pair(i, j) for j in beams] for i in range(m)])
    return ModeSpectra(np.array(found.density[:m]), found.matrix(beams), cross)


def frequency_rule(scenario: Scenario) -> tuple[Array, Array]:
    """Return nodes and weights [Hz] of a sum that stands for an integral over frequency up to half the rate, (n,) each.

    All weights are positive, so that covariances of such sums are those of a process.
    """
    crossing = min(layer.speed for layer in atmosphere.layers(scenario)) / scenario.telescope.diameter
    highest = 0.5 / scenario.dt
    first, middle = (min(share * crossing, share * highest) for share in (SLOWEST, SMOOTH))
    parts = [(first, middle, PER_SMOOTH_DECADE), (middle, highest, PER_DECADE)]
    smooth = np.concatenate([np.geomspace(low, high, int(per * np.log10(high / low)) + 1) for low, high, per in parts])
    every = [line for mode in range(len(scenario.modes)) for line in vibration_lines(scenario, mode)]
    lines = np.unique([round(frequency, 2) for frequency, _, _ in every])
    near = np.ravel(lines[:, None] + np.concatenate([-ABOUT_LINES[::-1], ABOUT_LINES]))
    edges = np.unique(np.concatenate([smooth, near[(near > first) & (near < highest)]]))
    return np.sqrt(edges[1:] * edges[:-1]), np.diff(edges)


def _all_modes(scenario: Scenario, _mode: None, layer: TurbulenceLayer, waves: PlaneWaves) -> list[Complex]:
    """Return the transforms of all modes on the axis, then of all modes of the combined LGS."""
    own = _modes_in(scenario, waves, Footprint())
    weights = lgs_weights(scenario) * _are_seen(scenario)
    combined = np.zeros_like(own)
    for i, star in enumerate(atmosphere.laser_stars(scenario)):
        seen = _modes_in(scenario, waves, atmosphere.footprint(star, layer))
        combined += np.tensordot(weights[:, i], seen, axes=1)
    return [*own, *combined]


def _all_modes_of_both(scenario: Scenario, mode: None, layer: TurbulenceLayer, waves: PlaneWaves) -> list[Complex]:
    """Return those of `_all_modes`, then the transforms of all modes in the NGS."""
    natural = atmosphere.footprint(atmosphere.natural_star(scenario), layer)
    return [*_all_modes(scenario, mode, layer, waves), *_modes_in(scenario, waves, natural)]


def _all_modes_of_beams(scenario: Scenario, _mode: None, layer: TurbulenceLayer, _waves: PlaneWaves) -> ModesInBeams:
    """Return all modes on the axis, in each LGS, and in the NGS."""
    stars = (atmosphere.on_axis(), *atmosphere.laser_stars(scenario), atmosphere.natural_star(scenario))
    footprints = [atmosphere.footprint(star, layer) for star in stars]
    return ModesInBeams(scenario.telescope.diameter, [(mode.noll, each) for each in footprints for mode in scenario.modes])


def _mean_and_differences(scenario: Scenario) -> Array:
    """Return the weights of the modes of `_all_modes_of_beams` in those of axis, mean and differences of the LGS, and NGS."""
    modes, basis = np.eye(len(scenario.modes)), star_basis(scenario.sensors.lgs_count)
    return block_diag(modes, np.kron(basis, np.diag(_are_seen(scenario))), modes)


def _are_seen(scenario: Scenario) -> Array:
    """Return 1 for every mode whose turbulence the LGS see, else 0."""
    return np.array([float(not is_blind(scenario, mode)) for mode in range(len(scenario.modes))])


def _modes_in(scenario: Scenario, waves: PlaneWaves, footprint: Footprint) -> Complex:
    return np.array([ideal_mode(scenario, mode, waves, footprint) for mode in range(len(scenario.modes))])


AXIS, NGS, LGS, FIRST = range(4)
"""Places of the signals in `star_flow_spectra`: the axis, the NGS, the mean of the LGS, and the first of the differences."""


@dataclass(frozen=True)
class StarSpectra:
    """Spectra of one mode of a scenario, on the frequencies of `wiener`; those between signals are computed when asked for.

    Attributes
    ----------
    mean : TrueSpectra
        Those of the plain mean of the LGS.
    flow : SpectraBetween
        Those of `star_flow_spectra` [um^2/Hz].
    dt : float
        Step [s].
    noise : float
        Variance of the noise of a measured difference [um^2].
    """

    mean: TrueSpectra
    flow: SpectraBetween
    dt: float
    noise: float

    @property
    def n_differences(self) -> int:
        """Number of differences."""
        return len(self.flow.density) - FIRST

    def between(self, i: int, j: int) -> Complex:
        """Return the cross spectrum of two of the measured differences, with noise, (n // 2 + 1,) [um^2 per sample]."""
        return self.pair(FIRST + i, FIRST + j) + (self.noise if i == j else 0.0)

    def pair(self, i: int, j: int) -> Complex:
        """Return the cross spectrum of two signals by their places: the turbulence at step k, measurements at k + 1."""
        found = self.flow.pair(i, j)
        found *= 0.5 / self.dt
        return found


def star_spectra(scenario: Scenario, mode: int, mean: TrueSpectra) -> StarSpectra:
    """Compute the spectra of one mode of an asterism whose stars differ (`stars_differ`); mean : those of the plain mean."""
    frequency = notched_frequencies(n_frequencies(scenario, mode), scenario.dt)
    noise = max(float(noise_rms(scenario, "lgs")[mode]), FLOOR) ** 2
    return StarSpectra(mean, star_flow_spectra(scenario, mode, frequency), scenario.dt, noise)
