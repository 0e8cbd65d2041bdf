"""Plane waves of a layer of frozen flow, and the interface of a sensor that measures them.

The phase of a layer at time t, in the pupil plane, is a sum of plane waves that move with the wind,

    phi(r, t) = Re sum_k A(k) exp(i k . (r - v t)),    k_x > 0 along the wind.

A sensor's output is a fixed linear functional of the phase, given by its value for exp(i k . r), its transform M(k).
A whole time series is then one Fourier transform of

    a(k_x) = sum_ky A(k_x, k_y) M(k),    a(t) = Re sum_kx a(k_x) exp(-i k_x v t).

Sensors that share the waves share the turbulence, so their covariances are exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from wfsobs.typing import Array


@dataclass(frozen=True)
class Footprint:
    """Where a beam crosses a layer.

    Attributes
    ----------
    scale : float
        Beam diameter over aperture diameter, 1 - h / H for a star at height H, 1 for one at infinity.
    shift : tuple of float
        (x, y) of its centre on the layer [m], pupil frame.
    """

    scale: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Wave:
    """The random waves of one layer on a block of spatial frequencies.

    Attributes
    ----------
    kx : Array
        Along the wind, above 0, (Nx,) [rad/m].
    ky : Array
        Across the wind, ascending and symmetric about 0, (Ny,) [rad/m].
    angle : float
        Direction that the wind blows to, from the pupil's x axis to its y axis [rad].
    amplitude : Array
        Complex A of the sums above, quadrature weights included, (Ny, Nx) [um of wavefront].
    """

    kx: Array
    ky: Array
    angle: float
    amplitude: Array

    def through(self, footprint: Footprint) -> Array:
        """Return the amplitudes in a frame about the centre of the footprint, A exp(i k . shift), complex (Ny, Nx) [um]."""
        x, y = footprint.shift
        if x == 0.0 and y == 0.0:
            return self.amplitude
        c, s = np.cos(self.angle), np.sin(self.angle)
        along, across = c * x + s * y, c * y - s * x
        return self.amplitude * np.exp(1j * self.ky * across)[:, None] * np.exp(1j * self.kx * along)

    def in_pupil(self) -> tuple[Array, Array]:
        """Return (k_x, k_y) of the waves in the pupil frame, each (Ny, Nx) [rad/m]."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        kx, ky = self.kx[None, :], self.ky[:, None]
        return c * kx - s * ky, s * kx + c * ky


class Sensor(Protocol):
    """A linear wavefront sensor with its reconstruction."""

    @property
    def n_outputs(self) -> int:
        """Number of outputs, such as Zernike coefficients."""
        ...

    @property
    def reach(self) -> float:
        """Maximum spatial frequency on the pupil that the sensor needs [rad/m]; waves beyond may be left out."""
        ...

    def measure(self, wave: Wave, footprint: Footprint) -> Array:
        """Return the response to the waves, a(k_x) per output: complex (n_outputs, Nx) [um].

        A wave exp(i k . r) of the layer is exp(i s k . r) on the pupil, s the scale of the footprint, times the factor
        that `Wave.through` puts into the amplitudes.
        """
        ...
