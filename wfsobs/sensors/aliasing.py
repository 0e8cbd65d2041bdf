"""What a Shack-Hartmann sensor takes for its modes and is none of them, as an error term of its own.

The error is the sensor's output less the Zernike coefficients of the phase in the same beam. Of the modes that are fitted it
holds nothing; the rest of the turbulence drives it.
"""

from __future__ import annotations

import numpy as np

from wfsobs.atmosphere.von_karman import spectrum
from wfsobs.sensors import zernike
from wfsobs.sensors.shack_hartmann import ShackHartmann
from wfsobs.typing import Array

RINGS, SPOKES = 800, 40
RADII = np.geomspace(0.005, 2000.0, RINGS)
"""k D / 2 at which the plane is sampled."""
GOLDEN = (np.arange(RINGS) * 0.5 * (np.sqrt(5.0) - 1.0)) % 1.0
ANGLES = (np.arange(SPOKES) + GOLDEN[:, None]) * (np.pi / SPOKES)
"""Points of the rings (RINGS, SPOKES), every ring turned against the last, so that all directions count alike. A half-plane
suffices: the transforms at k and -k are conjugate."""


class Aliasing:
    """The error of one sensor; made once, it serves layers and beams of every kind."""

    def __init__(self, sensor: ShackHartmann) -> None:
        self.sensor = sensor
        self._radius = sensor.lenslets.diameter / 2.0
        kx, ky = RADII[:, None] * np.cos(ANGLES), RADII[:, None] * np.sin(ANGLES)
        wrong = sensor.transform(kx / self._radius, ky / self._radius)
        wrong -= [zernike.transform(j, kx, ky) for j in sensor.nolls]
        self._power = np.einsum("ikt,jkt->kij", wrong, wrong.conj()).real / SPOKES

    def covariance(self, strength: float, outer_scale: float, scale: float = 1.0) -> Array:
        """Of the error in a layer, (n_outputs, n_outputs) [um^2].

        strength : r0^(-5/3) [m^(-5/3)], r0 at 500 nm; outer_scale : [m]; scale : of the beam, see `Footprint`
        """
        k = RADII / (self._radius * scale)
        ring = 2.0 * np.pi * k**2 * np.log(RADII[1] / RADII[0])
        return np.tensordot(spectrum(k**2, strength, outer_scale) * ring, self._power, 1)
