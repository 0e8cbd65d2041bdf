"""True spectra of what each LGS of an asterism measures in one mode: of the mean, and of differences between the stars.

The differences are orthonormal (`star_basis`), so that their noise is that of one star, and independent of the mean's. Vibration
is the same for all stars and in none of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wfsobs.scenario import Scenario
from wfsobs.signal.wiener import Complex
from wfsobs.simulation.flow_integral import SpectraBetween
from wfsobs.simulation.flow_spectra import star_flow_spectra
from wfsobs.simulation.guide_stars import MEAN
from wfsobs.simulation.sensor_noise import noise_rms
from wfsobs.simulation.true_spectra import FLOOR, TrueSpectra, n_frequencies, true_spectra

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
        return self._pair(FIRST + i, FIRST + j) + (self.noise if i == j else 0.0)

    def with_z(self, i: int) -> Complex:
        """Return that of a difference and z, at the same step."""
        return self._pair(FIRST + i, LGS)

    def with_axis(self, i: int) -> Complex:
        """Return that of the turbulence on the axis at step k, and a difference measured at k + 1."""
        return self._pair(AXIS, FIRST + i)

    def with_ngs(self, i: int) -> Complex:
        """Return that of the turbulence in the beam of the NGS at step k, and a difference measured at k + 1."""
        return self._pair(NGS, FIRST + i)

    def _pair(self, i: int, j: int) -> Complex:
        found = self.flow.pair(i, j)
        found *= 0.5 / self.dt
        return found


def star_spectra(scenario: Scenario, mode: int, mean: TrueSpectra | None = None) -> StarSpectra:
    """Compute the spectra of one mode of an asterism whose stars differ (`stars_differ`).

    mean : those of the plain mean, where already computed
    """
    n = n_frequencies(scenario, mode)
    # The notch at 0 Hz is a bin wide, as in `turbulence_spectra`.
    frequency = np.hypot(np.fft.rfftfreq(n, scenario.dt), 1.0 / (n * scenario.dt))
    noise = max(float(noise_rms(scenario, "lgs")[mode]), FLOOR) ** 2
    mean = mean or true_spectra(scenario.replace({"sensors.lgs_combination": MEAN}), mode)
    return StarSpectra(mean, star_flow_spectra(scenario, mode, frequency), scenario.dt, noise)
