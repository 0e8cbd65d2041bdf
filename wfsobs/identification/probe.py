"""A probe: commands beside those of a loop that tell its plant to a wanted accuracy at the least cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy.fft import irfft, rfft

from wfsobs.control.margins import residual_density
from wfsobs.scenario import Scenario
from wfsobs.signal.wiener import circle_mean
from wfsobs.simulation.true_spectra import true_spectra
from wfsobs.typing import Array

LOW = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
"""Lowest frequencies of a probe that are tried, over the rate."""


@dataclass(frozen=True)
class Probe:
    """White commands above a frequency, beside those of the loop of a scenario, which is its integrator at a delay of two.

    Attributes
    ----------
    low : float
        Minimum frequency, the maximum is half the rate [Hz].
    rms : float
        Of the commands of each mode [um].
    bound : dict of str to float
        Cramer-Rao bounds of the probe alone, whatever the plant's own motion tells, if the lag of the mirror is unknown (any
        response of four lags): `delay_frames`, one of both modes, `gain`, that of the worse mode, and `rotation_deg`.
    cost : float
        What it adds to the rms of the residual of a mode while it lasts, over that; the largest of the modes.
    """

    low: float
    rms: float
    bound: dict[str, float]
    cost: float

    def commands(self, n: int, n_modes: int, dt: float, rng: np.random.Generator) -> Array:
        """Return its commands (n, n_modes) [um], to be added to those of the loop."""
        x = rfft(rng.standard_normal((n, n_modes)), axis=0)
        x[np.arange(len(x)) / (n * dt) < self.low] = 0.0
        x = irfft(x, n, axis=0)
        return self.rms * x / x.std(axis=0)


def design_probe(scenario: Scenario, seconds: float, accuracy: Mapping[str, float]) -> Probe:
    """Design the probe that adds least to the residual of a scenario's loop, for standard deviations of the plant.

    Parameters
    ----------
    scenario : Scenario
        Disturbance, noise, integrator.
    seconds : float
        How long it lasts [s].
    accuracy : mapping of str to float
        Standard deviations by name, as `Probe.bound`.

    Returns
    -------
    Probe
        The one whose lowest frequency, of LOW over the rate, costs least.
    """
    spectra, probes = [true_spectra(scenario, mode) for mode in range(2)], []
    for share in LOW:
        information, rotation, excess, density = np.zeros((5, 5)), 0.0, [], []
        for s in spectra:
            omega = np.pi * np.arange(s.measurement.size) / (s.measurement.size - 1)
            forgets = 1.0 - scenario.loop.leak * np.exp(-1j * omega)
            acts = scenario.loop.gain * scenario.loop.closed * np.exp(-2j * omega)
            sensitivity = np.divide(forgets, forgets + acts, out=np.ones_like(forgets), where=acts != 0.0)
            own = residual_density(1.0 - sensitivity, s.total[0], s.total[1], s.measurement)
            power = np.abs(sensitivity) ** 2 * np.where(omega >= 2.0 * np.pi * share, 0.5 / (0.5 - share), 0.0)
            excess.append(circle_mean(power) / circle_mean(own))
            density.append((omega, power))
        n = seconds / scenario.dt
        for mode, s in enumerate(spectra):
            (omega, power), other = density[mode], density[1 - mode][1]
            back = np.exp(-1j * omega)
            # by delay, two numbers of the mirror's shape, and gain, but for two frames
            slopes = np.array([back - 1.0, (1.0 - back) ** 2 / back, (1.0 - back) ** 2, np.ones_like(omega)])
            products = np.real(slopes[:, None] * slopes.conj()) * power / s.measurement
            information[np.ix_(*[[0, 1, 2, 3 + mode]] * 2)] += n * np.array([[circle_mean(x) for x in row] for row in products])
            rotation += n * circle_mean(other / s.measurement) if other.size == omega.size else 0.0
        sd = np.sqrt(np.diag(np.linalg.inv(information)))
        unit = {"delay_frames": sd[0], "gain": sd[3:].max(), "rotation_deg": np.degrees(1.0 / sqrt(rotation))}
        rms = max(unit[name] / accuracy[name] for name in unit)
        cost = sqrt(1.0 + rms**2 * max(excess)) - 1.0
        probes.append(Probe(share / scenario.dt, float(rms), {name: float(x / rms) for name, x in unit.items()}, cost))
    return min(probes, key=lambda probe: probe.cost)
