"""Aliasing of a Shack-Hartmann sensor, as an error term of its own.

The error is the sensor's output minus the Zernike coefficients of the phase in the same beam. The fitted modes do not
contribute; the rest of the turbulence drives it.
"""

from __future__ import annotations

import numpy as np

from wfsobs.atmosphere.von_karman import von_karman_density
from wfsobs.sensors import zernike
from wfsobs.sensors.shack_hartmann import ShackHartmann
from wfsobs.typing import Array

RINGS, SPOKES = 800, 40
RADII = np.geomspace(0.005, 2000.0, RINGS)
"""k D / 2 at which the plane is sampled."""
GOLDEN = (np.arange(RINGS) * 0.5 * (np.sqrt(5.0) - 1.0)) % 1.0
ANGLES = (np.arange(SPOKES) + GOLDEN[:, None]) * (np.pi / SPOKES)
"""Points of the rings (RINGS, SPOKES), every ring rotated against the last for even coverage of all directions.

A half-plane is enough: the transforms at k and -k are conjugate.
"""


class Aliasing:
    """The aliasing error of one sensor, for any layer and beam."""

    def __init__(self, sensor: ShackHartmann) -> None:
        self.sensor = sensor
        self._radius = sensor.lenslets.diameter / 2.0
        kx, ky = RADII[:, None] * np.cos(ANGLES), RADII[:, None] * np.sin(ANGLES)
        wrong = sensor.transform(kx / self._radius, ky / self._radius)
        wrong -= [zernike.transform(j, kx, ky) for j in sensor.nolls]
        self._power = np.einsum("ikt,jkt->kij", wrong, wrong.conj()).real / SPOKES

    def covariance(self, strength: float, outer_scale: float, scale: float = 1.0) -> Array:
        """Return the covariance of the error in a layer.

        Parameters
        ----------
        strength : float
            r0^(-5/3), r0 at 500 nm [m^(-5/3)].
        outer_scale : float
            L0 [m].
        scale : float
            Scale of the beam, see `Footprint`.

        Returns
        -------
        Array
            (n_outputs, n_outputs) [um^2].
        """
        k = RADII / (self._radius * scale)
        ring = 2.0 * np.pi * k**2 * np.log(RADII[1] / RADII[0])
        return np.tensordot(von_karman_density(k**2, strength, outer_scale) * ring, self._power, 1)
