"""Geometric Shack-Hartmann sensor with a least-squares modal reconstructor, as a functional of plane waves.

A slope is the mean gradient of the phase over the lit part of a subaperture (`Lenslets`). The reconstructor fits more
Zernike modes to the slopes than its outputs: a fit of tip and tilt alone would return the mean
gradient, which coma and similar modes change too. What the fitted modes do not include appears in them: aliasing.

Slopes and fit are linear, so an output is one sum over the cells of the pupil, its transform

    M_j(k) = sum_cells i (k_x w_xj + k_y w_yj) sinc(k_x h / 2) sinc(k_y h / 2) exp(i k . r_cell),    sinc(x) = sin(x) / x,

with w the weights of the cells of side h. No slope is computed: the cost is that of the output modes,
whatever the number of subapertures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from wfsobs.atmosphere.plane_waves import Footprint, Wave
from wfsobs.sensors.lenslets import Lenslets
from wfsobs.sensors.nufft import TrigonometricSum, lagrange_weights
from wfsobs.sensors.reconstructor import reconstructor
from wfsobs.sensors.spots import SpotModel
from wfsobs.sensors.zernike import noll
from wfsobs.typing import Array

NODES = 4
"""Nodes along k_x per 2 pi / D, the period of the contribution of the aperture's edge to a transform."""

TAPS = 8
"""Nodes of an interpolation along k_x: with four per period accurate to 2e-4 of the contribution of the edge."""


class ShackHartmann:
    """A sensor whose outputs are Zernike coefficients [um].

    Parameters
    ----------
    lenslets : Lenslets
        Geometry of the sensor.
    nolls : sequence of int
        Noll indices of the output modes.
    order : int, optional
        Radial order up to which modes are fitted; by default the highest of the output modes.

    Raises
    ------
    ValueError
        The slopes do not determine the modes.
    """

    def __init__(self, lenslets: Lenslets, nolls: Sequence[int], order: int | None = None) -> None:
        self.lenslets = lenslets
        self.nolls = tuple(nolls)
        self.order = noll(max(nolls))[0] if order is None else order
        self.reconstructor = reconstructor(lenslets, self.order)[[j - 2 for j in self.nolls]]
        weights = lenslets.spread(np.concatenate(np.split(self.reconstructor, 2, axis=1)))
        self._sums = TrigonometricSum(weights)
        self._memory: tuple[Wave, float, Array] | None = None

    @property
    def n_outputs(self) -> int:
        """Number of output modes."""
        return len(self.nolls)

    @property
    def reach(self) -> float:
        """The second zero of a subaperture's own transform; on a coarse sensor that of an array of 40 [rad/m]."""
        return 4.0 * np.pi * max(self.lenslets.across, 40) / self.lenslets.diameter

    def transform(self, kx: Array, ky: Array) -> Array:
        """Return the outputs for exp(i k . r) on the pupil, k in its frame [rad/m]: complex (n_outputs, *shape of k)."""
        h = self.lenslets.pitch
        along_x, along_y = np.split(self._sums(kx * h, ky * h), 2)
        cell = 1j * np.sinc(kx * (h / (2.0 * np.pi))) * np.sinc(ky * (h / (2.0 * np.pi)))
        return cell * kx * along_x + cell * ky * along_y

    def noise_covariance(self, spots: SpotModel) -> Array:
        """Return the noise covariance of the outputs in one frame, (n_outputs, n_outputs) [um^2].

        The noises of the slopes are independent, those of the modes are not.
        """
        variance = spots.slope_variance(self.lenslets.fraction[self.lenslets.valid])
        return (self.reconstructor * np.tile(variance, 2)) @ self.reconstructor.T

    def measure(self, wave: Wave, footprint: Footprint) -> Array:
        """Return the response to the waves of a layer, see `Sensor.measure`: complex (n_outputs, Nx) [um].

        The transform varies along k_x on the scale of a fringe of the aperture, which is many steps of a long record. So the
        sum over k_y is computed at the nodes about each k_x, as matrix products, and interpolated. Single
        precision, 1e-7, is enough for the products.
        """
        amplitude = wave.through(footprint).astype(np.complex64)
        step = 2.0 * np.pi / (NODES * footprint.scale * self.lenslets.diameter)
        place = wave.kx / step
        cells = np.arange(int(place[0]), int(place[-1]) + 2)
        nodes = step * np.arange(cells[0] + 1 - TAPS // 2, cells[-1] + TAPS // 2)
        if len(nodes) >= len(place):
            return np.einsum("xjy,yx->jx", self._on_grid(wave, footprint.scale, wave.kx), amplitude)
        known = self._on_grid(wave, footprint.scale, nodes)
        weights = lagrange_weights(place % 1.0, TAPS)
        out = np.empty((self.n_outputs, len(place)), dtype=complex)
        for i, (start, stop) in enumerate(pairwise(np.searchsorted(place, cells))):
            about = known[i : i + TAPS].reshape(TAPS * self.n_outputs, -1) @ amplitude[:, start:stop]
            out[:, start:stop] = np.einsum("tjx,tx->jx", about.reshape(TAPS, self.n_outputs, -1), weights[:, start:stop])
        return out

    def _on_grid(self, wave: Wave, scale: float, kx: Array) -> Array:
        """Return the transform at `kx` and the wave's k_y through a beam of that scale, (len(kx), n_outputs, Ny).

        The last one is cached: guide stars at one height differ in their shifts alone.
        """
        known = self._memory  # another thread may replace it
        if known is None or known[0] is not wave or known[1] != scale:
            x, y = replace(wave, kx=kx).in_pupil()
            made = self.transform(scale * x, scale * y)
            known = wave, scale, np.moveaxis(made, 2, 0).astype(np.complex64, order="C")
            self._memory = known
        return known[2]
