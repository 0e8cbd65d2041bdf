"""True spectra of turbulence in one mode, by its source: of the target and of what LGS and NGS see of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from wfsobs.scenario import Scenario
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.signal.wiener import Complex
from wfsobs.simulation.flow_spectra import FlowSpectra, flow_spectra
from wfsobs.simulation.guide_stars import lgs_weights, low_frequency_process
from wfsobs.simulation.turbulence import processes, table_variance, third_order_process, turbulence_process
from wfsobs.typing import Array


def turbulence_spectra(scenario: Scenario, mode: int, n: int) -> TurbulenceSpectra:
    """Return the spectra of the turbulence of one mode alone, for a DFT of `n` steps."""
    return TURBULENCE_SPECTRA[scenario.turbulence.source](scenario, mode, n)


def density(process: Ar2 | Ar3, n: int) -> Array:
    """Return the spectrum of an autoregressive process, per sample."""
    return process.psd(np.fft.rfftfreq(n, process.dt)) / (2.0 * process.dt)


class TurbulenceSpectra(NamedTuple):
    """Spectra of turbulence, per sample, as `FlowSpectra`; the combined LGS with its errors."""

    own: Array
    measurement: Array
    cross: Complex | Array
    ngs: Array
    ngs_cross: Complex | Array
    sensors_cross: Complex | Array


def _through_lgs(scenario: Scenario, mode: int, own: Array) -> TurbulenceSpectra:
    """Return the spectra of turbulence that is common to all stars, each LGS with a slow error of its own."""
    weights = lgs_weights(scenario)[mode, :, mode]
    error = density(low_frequency_process(scenario, mode), 2 * (own.size - 1)) * np.sum(weights**2)
    blind = scenario.sensors.tip_tilt_indetermination and scenario.modes[mode].radial_order == 1
    gain = 0.0 if blind else weights.sum()
    return TurbulenceSpectra(own, gain**2 * own + error, gain * own, own, own, gain * own)


def _ar2_turbulence(scenario: Scenario, mode: int, n: int) -> TurbulenceSpectra:
    return _through_lgs(scenario, mode, density(turbulence_process(scenario, mode, scenario.dt), n))


def _ar3_turbulence(scenario: Scenario, mode: int, n: int) -> TurbulenceSpectra:
    return _through_lgs(scenario, mode, density(third_order_process(scenario, mode, scenario.dt), n))


def _sum_of_processes(scenario: Scenario, mode: int, n: int) -> TurbulenceSpectra:
    own = [density(p, n) for p in processes(scenario, mode, scenario.dt)]
    return _through_lgs(scenario, mode, sum(own, np.zeros(n // 2 + 1)))


def _no_turbulence(scenario: Scenario, mode: int, n: int) -> TurbulenceSpectra:
    return _through_lgs(scenario, mode, np.zeros(n // 2 + 1))


def _table(scenario: Scenario, mode: int, n: int) -> TurbulenceSpectra:
    return _through_lgs(scenario, mode, 0.5 * n * table_variance(scenario, mode, n))


def _frozen_flow(scenario: Scenario, mode: int, n: int) -> TurbulenceSpectra:
    return per_sample(scenario, n, lambda frequency: flow_spectra(scenario, mode, frequency))


def per_sample(scenario: Scenario, n: int, densities: Callable[[Array], FlowSpectra]) -> TurbulenceSpectra:
    """Return the spectra of frozen flow for a DFT of `n` steps; densities : frequencies [Hz] -> spectra [um^2/Hz]."""
    # Along the wind the spectrum falls as f^2 to zero at 0 Hz, a notch that the DFT does not resolve: here it is a bin wide.
    frequency = np.hypot(np.fft.rfftfreq(n, scenario.dt), 1.0 / (n * scenario.dt))
    found = densities(frequency)
    scaled = {id(part): 0.5 / scenario.dt * part for part in found}  # on the axis the NGS shares its arrays with the truth
    return TurbulenceSpectra(*(scaled[id(part)] for part in found))


TURBULENCE_SPECTRA: dict[str, Callable[[Scenario, int, int], TurbulenceSpectra]] = {
    "ar2": _ar2_turbulence,
    "ar3": _ar3_turbulence,
    "processes": _sum_of_processes,
    "frozen-flow": _frozen_flow,
    "psd": _table,
    "none": _no_turbulence,
}
"""Source of turbulence -> its spectra."""
