"""Turbulence of all modes together, from a scenario: what an observer of coupled modes, or of every star, is told."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from wfsobs.prior import Asterism, Flow
from wfsobs.priors_from.turbulence import measurement_noise, one_process
from wfsobs.scenario import Scenario
from wfsobs.simulation.flow_spectra import star_basis
from wfsobs.simulation.guide_stars import lgs_weights, stars_differ
from wfsobs.simulation.mode_spectra import are_coupled, beam_spectra, frequency_rule, mode_spectra
from wfsobs.simulation.turbulence import turbulence_process
from wfsobs.typing import Array


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
        line_gain=np.array([lgs_weights(scenario)[mode, :, mode].sum() for mode in range(len(strength))]),
    )


@lru_cache(maxsize=2)
def _asterism(scenario: Scenario, dt: float) -> Asterism:
    """Return that of all modes, which takes a while."""
    frequency, weight = frequency_rule(scenario)
    found, strength, stars = beam_spectra(scenario, frequency), _strength(scenario, dt), scenario.sensors.lgs_count
    m = len(strength)
    by_pair = weight * np.outer(strength, strength)[:, :, None]
    noise, ngs_noise = np.array([measurement_noise(scenario, mode) for mode in range(m)]).T
    return Asterism(
        omega=2.0 * np.pi * frequency * dt,
        own=found.own * weight * strength[:, None] ** 2,
        measurement=found.measurement.reshape(stars + 1, m, stars + 1, m, -1) * by_pair[:, None],
        cross=found.cross.reshape(m, stars + 1, m, -1) * by_pair[:, None],
        basis=star_basis(stars),
        noise=noise / np.sqrt(np.sum(lgs_weights(scenario)[range(m), :, range(m)] ** 2, axis=1)),
        ngs_noise=ngs_noise,
        combination=lgs_weights(scenario),
        ratio=scenario.sensors.exposure_ratio,
    )


def _strength(scenario: Scenario, dt: float) -> Array:
    """Return the strength of the model over that of the turbulence, (n_modes,)."""
    modes = range(len(scenario.modes))
    own = [turbulence_process(scenario, mode, dt).rms for mode in modes]
    return np.divide([one_process(scenario, mode, dt).rms for mode in modes], own)
