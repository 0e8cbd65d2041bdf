"""Turbulence of all modes together, from a scenario: what an observer of coupled modes, or of every star, is told."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TypeVar

import numpy as np

from wfsobs.prior import Asterism, Flow, FlowOfBoth
from wfsobs.priors_from.turbulence import measurement_noise, one_process
from wfsobs.scenario import Scenario
from wfsobs.simulation.flow_spectra import star_basis
from wfsobs.simulation.guide_stars import lgs_weights, stars_differ
from wfsobs.simulation.mode_spectra import ModeSpectra, are_coupled, beam_spectra, combined_spectra, frequency_rule, mode_spectra
from wfsobs.simulation.turbulence import turbulence_process
from wfsobs.typing import Array

Of = TypeVar("Of", bound=Asterism)


def flow_of(scenario: Scenario, n_modes: int, dt: float | None = None) -> Flow | None:
    """Return the turbulence of the first modes together; None where they tell nothing of one another.

    dt : [s], by default that of the scenario. Where the strength of the model is set by hand the flow has that.
    """
    if not are_coupled(scenario) or n_modes < 2:
        return None
    return _flow(scenario, dt or scenario.dt).first(n_modes)


def asterism_of(scenario: Scenario, n_modes: int, dt: float | None = None) -> Asterism | None:
    """Return the turbulence of the first modes in every beam; None where all LGS see the same. dt, strength : as in `flow_of`."""
    if not has_stars_apart(scenario):
        return None
    return _asterism(scenario, dt or scenario.dt).first(n_modes)


def flow_of_both(scenario: Scenario, n_modes: int, dt: float | None = None) -> FlowOfBoth | None:
    """Return that in what is made of all LGS, and in the NGS; None as in `flow_of`, which has dt and strength."""
    if not are_coupled(scenario) or n_modes < 2:
        return None
    return _flow_of_both(scenario, dt or scenario.dt).first(n_modes)


def has_stars_apart(scenario: Scenario) -> bool:
    """Return whether every LGS tells something that their mean does not."""
    return any(stars_differ(scenario, mode) for mode in range(len(scenario.modes)))


@lru_cache(maxsize=4)
def _flow(scenario: Scenario, dt: float) -> Flow:
    """Return that of all modes, which takes a while."""
    frequency, weight = frequency_rule(scenario)
    found, strength = mode_spectra(scenario, frequency), _strength(scenario, dt)
    by_pair = weight * np.outer(strength, strength)[:, :, None]
    return Flow(
        omega=2.0 * np.pi * frequency * dt,
        own=found.own * weight * strength[:, None] ** 2,
        measurement=found.measurement * by_pair,
        cross=found.cross * by_pair,
        line_gain=_line_gain(scenario),
    )


@lru_cache(maxsize=2)
def _asterism(scenario: Scenario, dt: float) -> Asterism:
    """Return that of all modes, which takes a while."""
    every, m = lgs_weights(scenario), range(len(scenario.modes))
    alone = np.sqrt(np.sum(every[m, :, m] ** 2, axis=1))  # noise of their combination, over that of one
    return _of_beams(Asterism, scenario, dt, beam_spectra, star_basis(len(every[0])), alone, every, np.ones(len(m)))


@lru_cache(maxsize=2)
def _flow_of_both(scenario: Scenario, dt: float) -> FlowOfBoth:
    """Return that of all modes, which takes a while."""
    m = len(scenario.modes)
    itself = np.eye(m)[:, None]
    return _of_beams(FlowOfBoth, scenario, dt, combined_spectra, np.eye(1), np.ones(m), itself, _line_gain(scenario))


def _of_beams(
    kind: type[Of],
    scenario: Scenario,
    dt: float,
    spectra: Callable[[Scenario, Array], ModeSpectra],
    basis: Array,
    noise_gain: Array,
    combination: Array,
    line_gain: Array,
) -> Of:
    """Return the turbulence in the beams of the LGS and in the NGS.

    noise_gain : noise of all LGS together, over that of one, (n_modes,);  the others as in `Asterism`
    """
    frequency, weight = frequency_rule(scenario)
    found, strength, beams = spectra(scenario, frequency), _strength(scenario, dt), len(basis) + 1
    m = len(strength)
    by_pair = weight * np.outer(strength, strength)[:, :, None]
    noise, ngs_noise = np.array([measurement_noise(scenario, mode) for mode in range(m)]).T
    return kind(
        omega=2.0 * np.pi * frequency * dt,
        own=found.own * weight * strength[:, None] ** 2,
        measurement=found.measurement.reshape(beams, m, beams, m, -1) * by_pair[:, None],
        cross=found.cross.reshape(m, beams, m, -1) * by_pair[:, None],
        basis=basis,
        noise=noise / noise_gain,
        ngs_noise=ngs_noise,
        combination=combination,
        line_gain=line_gain,
        ratio=scenario.sensors.exposure_ratio,
    )


def _line_gain(scenario: Scenario) -> Array:
    """Return the gain of the combined LGS for the vibration of each mode, (n_modes,)."""
    modes = range(len(scenario.modes))
    return lgs_weights(scenario)[modes, :, modes].sum(axis=1)


def _strength(scenario: Scenario, dt: float) -> Array:
    """Return the strength of the model over that of the turbulence, (n_modes,)."""
    modes = range(len(scenario.modes))
    own = [turbulence_process(scenario, mode, dt).rms for mode in modes]
    return np.divide([one_process(scenario, mode, dt).rms for mode in modes], own)
