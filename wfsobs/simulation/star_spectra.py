"""True spectra of what each LGS of an asterism measures in one mode: of the mean, and of differences between the stars.

The differences are orthonormal (`star_basis`), so that their noise is that of one star, and independent of the mean's. Vibration
is the same for all stars and in none of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wfsobs.scenario import Scenario
from wfsobs.simulation.flow_spectra import star_flow_spectra
from wfsobs.simulation.guide_stars import MEAN
from wfsobs.simulation.sensor_noise import noise_rms
from wfsobs.simulation.true_spectra import FLOOR, TrueSpectra, n_frequencies, true_spectra


@dataclass(frozen=True)
class StarSpectra:
    """Spectra of one mode of a scenario, on the frequencies of `wiener` [um^2 per sample].

    Attributes
    ----------
    mean : TrueSpectra
        Those of the plain mean of the LGS.
    differences : Array
        Cross spectra of the measured differences, with noise, (n_lgs - 1, n_lgs - 1, n // 2 + 1).
    cross : Array
        Those of the differences and z, at the same step, (n_lgs - 1, n // 2 + 1).
    axis_cross, ngs_cross : Array
        Those of the turbulence at step k, on the axis and in the beam of the NGS, and the differences measured at k + 1.
    """

    mean: TrueSpectra
    differences: NDArray[np.complex128]
    cross: NDArray[np.complex128]
    axis_cross: NDArray[np.complex128]
    ngs_cross: NDArray[np.complex128]


def stars_differ(scenario: Scenario, mode: int) -> bool:
    """Return whether the LGS see different turbulence in a mode, so that each tells something that their mean does not."""
    s = scenario.sensors
    blind = s.tip_tilt_indetermination and scenario.modes[mode].radial_order == 1
    return scenario.turbulence.source == "frozen-flow" and s.lgs_count > 1 and s.lgs_radius > 0 and not blind


def star_spectra(scenario: Scenario, mode: int) -> StarSpectra:
    """Compute the spectra of one mode of an asterism whose stars differ (`stars_differ`)."""
    n = n_frequencies(scenario)
    # The notch at 0 Hz is a bin wide, as in `turbulence_spectra`.
    frequency = np.hypot(np.fft.rfftfreq(n, scenario.dt), 1.0 / (n * scenario.dt))
    found = star_flow_spectra(scenario, mode, frequency) * (0.5 / scenario.dt)
    differences = found[3:, 3:].copy()
    for i in range(len(differences)):
        differences[i, i] += max(float(noise_rms(scenario, "lgs")[mode]), FLOOR) ** 2
    plain = true_spectra(scenario.replace({"sensors.lgs_combination": MEAN}), mode)
    return StarSpectra(plain, differences, found[3:, 2], found[0, 3:], found[1, 3:])
