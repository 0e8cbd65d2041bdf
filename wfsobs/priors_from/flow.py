"""Turbulence of all modes together, from a scenario: what an observer of coupled modes is told."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from wfsobs.prior import Flow
from wfsobs.priors_from.turbulence import one_process
from wfsobs.scenario import Scenario
from wfsobs.simulation.guide_stars import lgs_weights
from wfsobs.simulation.mode_spectra import are_coupled, frequency_rule, mode_spectra
from wfsobs.simulation.turbulence import turbulence_process


def flow_of(scenario: Scenario, n_modes: int, dt: float | None = None) -> Flow | None:
    """Return the turbulence of the first modes together; None where they tell nothing of one another.

    dt : [s], by default that of the scenario. Where the strength of the model is set by hand the flow has that.
    """
    if not are_coupled(scenario) or n_modes < 2:
        return None
    return _flow(scenario, dt or scenario.dt).first(n_modes)


@lru_cache(maxsize=4)
def _flow(scenario: Scenario, dt: float) -> Flow:
    """Return that of all modes, which takes a while."""
    frequency, weight = frequency_rule(scenario)
    found, modes = mode_spectra(scenario, frequency), range(len(scenario.modes))
    own = [turbulence_process(scenario, mode, dt).rms for mode in modes]
    told = [one_process(scenario, mode, dt).rms for mode in modes]
    strength = np.divide(told, own)
    by_pair = weight * np.outer(strength, strength)[:, :, None]
    return Flow(
        omega=2.0 * np.pi * frequency * dt,
        own=found.own * weight * strength[:, None] ** 2,
        measurement=found.measurement * by_pair,
        cross=found.cross * by_pair,
        line_gain=np.array([lgs_weights(scenario)[mode, :, mode].sum() for mode in modes]),
    )
