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


def star_spectra(scenario: Scenario, mode: int, mean: TrueSpectra | None = None) -> StarSpectra:
    """Compute the spectra of one mode of an asterism whose stars differ (`stars_differ`).

    mean : those of the plain mean, where already computed
    """
    n = n_frequencies(scenario, mode)
    # The notch at 0 Hz is a bin wide, as in `turbulence_spectra`.
    frequency = np.hypot(np.fft.rfftfreq(n, scenario.dt), 1.0 / (n * scenario.dt))
    found = star_flow_spectra(scenario, mode, frequency)
    scale, each = 0.5 / scenario.dt, range(3, len(found.density))
    differences = scale * found.matrix(each)
    for i in range(len(differences)):
        differences[i, i] += max(float(noise_rms(scenario, "lgs")[mode]), FLOOR) ** 2
    cross = np.array([found.pair(i, 2) for i in each])
    axis, ngs = (np.array([found.pair(j, i) for i in each]) for j in (0, 1))
    mean = mean or true_spectra(scenario.replace({"sensors.lgs_combination": MEAN}), mode)
    return StarSpectra(mean, differences, *(scale * part for part in (cross, axis, ngs)))
