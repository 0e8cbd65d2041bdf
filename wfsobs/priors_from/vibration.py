"""The part of the vibration that is no line, as a few processes of the observers' models."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from wfsobs.priors_from.turbulence import measurement_noise
from wfsobs.scenario import Scenario
from wfsobs.scenario.measured_spectra import ALL, LINES
from wfsobs.signal.ar2 import Ar2
from wfsobs.simulation.disturbance import vibration_power
from wfsobs.simulation.true_spectra import lgs_turbulence_spectrum, n_frequencies
from wfsobs.spectral.rational import fit_processes
from wfsobs.typing import Array

PROCESSES = 8
"""Processes of a continuum. With five, `multirate-multi` is up to 1.27 times the bound on `ut4-floor`, with eight 1.23."""


@lru_cache(maxsize=32)
def vibration_continuum(scenario: Scenario, mode: int) -> tuple[Ar2, ...]:
    """Return processes whose sum has the spectrum of what is no line in a mode's vibration; none where all of it is lines.

    Fitted beside turbulence and noise of the LGS, at the step of the scenario.
    """
    n = n_frequencies(scenario, mode)
    power = continuum_power(scenario, mode, n)
    if not power.any():
        return ()
    beside = measurement_noise(scenario, mode)[0] ** 2 + lgs_turbulence_spectrum(scenario, mode)
    return fit_processes(0.5 * n * power, beside, scenario.dt, PROCESSES)


def continuum_power(scenario: Scenario, mode: int, n: int) -> Array:
    """Return the variance [um^2] of what is no line in a mode's vibration, in each DFT bin of `n` steps, even, (n // 2 + 1,)."""
    v = scenario.vibration
    if v.source == "psd":
        return vibration_power(scenario, mode, n)
    if v.source != "measured" or v.part != ALL:
        return np.zeros(n // 2 + 1)
    lines = vibration_power(scenario.replace({"vibration.part": LINES}), mode, n)
    return np.maximum(vibration_power(scenario, mode, n) - lines, 0.0)
