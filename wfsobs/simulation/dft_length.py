"""Length of the DFT of a mode's true spectra: correlations must have decayed by half of it."""

from __future__ import annotations

from math import ceil, log2, pi

import numpy as np

from wfsobs.scenario import Scenario
from wfsobs.sensors import zernike
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.disturbance import vibration_power
from wfsobs.simulation.synthesis import line_width
from wfsobs.simulation.turbulence import processes, turbulence_process

DECAYED = 2.5
"""Decay of correlations after half the DFT, as an exponent; a line that wraps around by then brings nothing new."""

SMOOTH = 5.0
"""The same for processes of a known width, whose correlations must not wrap around: exp(-12.5) of them does."""

MOST = 2**20
"""Maximum length of the DFT: an AR(2) that decays more slowly wraps around, which changes the bound by little."""

NOTCH = 0.1
"""Mean square of a mode in waves across the wind, whose maximum is 1, below which its spectrum has a notch at 0 Hz."""


def n_frequencies(scenario: Scenario, mode: int = 0) -> int:
    """Return the length of the DFT of a mode, a power of two: its slowest correlation has decayed by half of it."""
    return min(wanted_frequencies(scenario, mode), MOST)


def wanted_frequencies(scenario: Scenario, mode: int = 0) -> int:
    """Return the same without the maximum."""
    rate = min(_decay_rates(scenario))
    if _is_of_aperture(scenario, mode):  # 2^16 and 2^18 differ by 6e-5 at most, on `higher-orders`
        rate = max(rate, _slowest_wind(scenario) / (16.0 * scenario.telescope.diameter))
    return int(2 ** ceil(log2(2.0 * DECAYED / (rate * scenario.dt))))


def _decay_rates(scenario: Scenario) -> list[float]:
    """Return the decay rates of the correlations of the disturbances [1/s], xi w, with the margin of smooth spectra."""
    v, least = scenario.vibration, pi * line_width(scenario)
    smooth = [turbulence_process(scenario, 0, scenario.dt)]
    if scenario.turbulence.source == "processes":
        smooth = [p for mode in range(len(scenario.modes)) for p in processes(scenario, mode, scenario.dt)]
    rates = [2.0, *(p.omega * p.damping / SMOOTH for p in smooth)]
    if v.source in ("psd", "measured"):
        rates.append(least)
    elif v.source != "none":
        rates += [max(2.0 * pi * p.frequency * p.damping / SMOOTH, least) for p in v.peaks]
    if scenario.turbulence.source == "frozen-flow":
        rates.append(_slowest_wind(scenario) / (8.0 * scenario.turbulence.outer_scale))
    elif scenario.turbulence.source == "psd":
        rates.append(least)
    return rates


def _slowest_wind(scenario: Scenario) -> float:
    return min(layer.speed for layer in atmosphere.layers(scenario))


def _is_of_aperture(scenario: Scenario, mode: int) -> bool:
    """Return whether a mode forgets what the wind carries out of the aperture: it sees little of the outer scale, and no line.

    The spectrum of one that waves across the wind do not excite falls to zero at 0 Hz, and it remembers longer.
    """
    it = scenario.modes[mode]
    if scenario.turbulence.source != "frozen-flow" or it.radial_order < 2 or _vibrates(scenario, mode):
        return False
    layers = atmosphere.layers(scenario)
    across = zernike.azimuthal(it.noll, np.array([1j * np.exp(1j * layer.angle) for layer in layers]))
    strength = np.array([layer.strength for layer in layers])
    return float(strength @ across**2) > NOTCH * float(strength.sum())


def _vibrates(scenario: Scenario, mode: int) -> bool:
    v = scenario.vibration
    if v.source in ("peaks", "ar2"):
        return any(mode < len(peak.rms) and peak.rms[mode] > 0 for peak in v.peaks)
    return bool(vibration_power(scenario, mode, scenario.n_steps).any())
