"""Geometric Shack-Hartmann sensor with a least-squares modal reconstructor, as a functional of plane waves.

A slope is the mean gradient of the phase over the lit part of a subaperture (`Lenslets`). The reconstructor fits more
Zernike modes to the slopes than its outputs: a fit of tip and tilt alone would return the mean
gradient, which coma and similar modes change too. What the fitted modes do not include appears in them: aliasing.

Slopes and fit are linear, so an output is one sum over the cells of the pupil, its transform

    M_j(k) = sum_cells i (k_x w_xj + k_y w_yj) sinc(k_x h / 2) sinc(k_y h / 2) exp(i k . r_cell),    sinc(x) = sin(x) / x,

with w the weights of the cells of side h. No slope is computed: the cost is that of the output modes,
whatever the number of subapertures.

A sum of exponentials is one Fourier transform onto a grid of twice the resolution, and five points of that grid along each
axis for every point, with a Kaiser-Bessel window whose own transform is divided out beforehand: the non-uniform fast
Fourier transform of type 2 (J. A. Fessler and B. P. Sutton, IEEE Trans. Signal Process. 51, 560, 2003).

The noise is that of the spots and of their centre of gravity. Aliasing is an error term of its own: the sensor's output minus
the Zernike coefficients of the phase in the same beam. The fitted modes do not contribute; the rest of the turbulence drives
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.fft import ifft2, next_fast_len
from scipy.sparse import csr_array
from scipy.special import i0

from wfsobs.atmosphere import Footprint, Wave, von_karman_density
from wfsobs.sensors import zernike
from wfsobs.sensors.lenslets import Lenslets, reconstructor
from wfsobs.sensors.zernike import noll
from wfsobs.typing import Array

ARCSEC = np.pi / 180.0 / 3600.0
"""One arcsecond [rad]."""


@dataclass(frozen=True)
class SpotModel:
    """The spots of a sensor and their detector. Spots are round: the elongation of a laser's spot is not modelled.

    Attributes
    ----------
    photons : float
        Detected per frame by a fully lit subaperture [e-].
    read_noise : float
        Rms per pixel and frame [e-].
    fwhm : float
        Full width at half maximum of a spot [arcsec].
    pixel_scale : float
        Angle of a pixel [arcsec].
    pixels : int
        Side of the window of the centre of gravity.
    """

    photons: float
    read_noise: float
    fwhm: float
    pixel_scale: float
    pixels: int

    def slope_variance(self, lit: Array) -> Array:
        """Return the variance of a slope [um^2/m^2] of subapertures with the lit fraction `lit`.

        For a Gaussian spot in photon noise, and read noise on every pixel of the window (G. Rousset in F. Roddier (ed.),
        "Adaptive optics in astronomy", 1999; S. Thomas et al., Mon. Not. R. Astron. Soc. 371, 323, 2006):

            fwhm^2 / (8 ln 2 photons) + pixel_scale^2 (read_noise / photons)^2 N^2 (N^2 - 1) / 12,

        where N^2 (N^2 - 1) / 12 is the sum of the squares of the pixels' positions along an axis.
        """
        photons = self.photons * lit
        photon_noise = self.fwhm**2 / (8.0 * np.log(2.0) * photons)
        places = self.pixels**2 * (self.pixels**2 - 1) / 12.0
        read_noise = (self.pixel_scale * self.read_noise / photons) ** 2 * places
        return (photon_noise + read_noise) * (1e6 * ARCSEC) ** 2


WIDTH = 5
SHAPE = np.pi * WIDTH * 0.75  # of the window, for a grid twice as fine
FINE = 2048  # points of the table of the window between two grid points; linear between them it is good to 1e-6
CHUNK = 1 << 16  # points at a time


def _window() -> Array:
    """Return weights (FINE + 2, WIDTH) of the grid points about a point, by the distance of the first from the edge."""
    distance = np.arange(FINE + 2)[:, None] / FINE + np.arange(WIDTH) - WIDTH / 2
    return i0(SHAPE * np.sqrt(np.maximum(1.0 - (distance / (WIDTH / 2)) ** 2, 0.0)))


WINDOW = _window()


class TrigonometricSum:
    """f_m(x, y) = sum_pq w_m[q, p] exp(i (p x + q y)), p and q from -(n - 1) / 2 to (n - 1) / 2, to 1e-5 of sum |w|.

    Parameters
    ----------
    weights : Array
        Real, (m, n, n), n even.
    """

    def __init__(self, weights: Array) -> None:
        m, n, _ = weights.shape
        self._size = next_fast_len(2 * n)
        p = np.arange(n) - n // 2  # the sum's p less 1/2
        window = np.sqrt(SHAPE**2 - (np.pi * WIDTH * p / self._size) ** 2 + 0j)
        correction = (window / (WIDTH * np.sinh(window))).real
        padded = np.zeros((m, self._size, self._size))
        padded[:, p[:, None], p[None, :]] = weights * correction[:, None] * correction
        grid = ifft2(padded, norm="forward")
        table = np.moveaxis(grid, 0, -1).reshape(-1, m).astype(np.complex64, order="C")
        self._table = table.view(np.float32)  # (size^2, 2 m); single precision is finer than the window

    def __call__(self, x: Array, y: Array) -> Array:
        """Return the sums at the points (x, y) [rad]: complex (m, *shape of x)."""
        points = np.stack([np.ravel(x), np.ravel(y)])
        out = np.empty((points.shape[1], self._table.shape[1] // 2), dtype=complex)
        for start in range(0, len(out), CHUNK):
            part = slice(start, start + CHUNK)
            out[part] = (self._interpolation(*points[:, part]) @ self._table).view(np.complex64)
        out *= np.exp(0.5j * points.sum(axis=0))[:, None]
        return out.T.reshape(-1, *np.shape(x))

    def _interpolation(self, x: Array, y: Array) -> csr_array:
        """Return the matrix (points, size^2) that interpolates the table at the points."""
        (column, across), (row, along) = self._taps(x), self._taps(y)
        index = row[:, :, None] * self._size + column[:, None, :]
        weight = along[:, :, None] * across[:, None, :]
        starts = np.arange(len(x) + 1) * WIDTH**2
        return csr_array((weight.ravel(), index.ravel(), starts), shape=(len(x), self._size**2))

    def _taps(self, x: Array) -> tuple[Array, Array]:
        """Return the grid points about each x, and their weights: (points, WIDTH) each."""
        at = x * (self._size / (2.0 * np.pi)) - WIDTH / 2
        first = np.ceil(at)
        place = (first - at) * FINE
        below = place.astype(np.intp)
        weights = WINDOW[below] + (WINDOW[below + 1] - WINDOW[below]) * (place - below)[:, None]
        return (first.astype(np.int64)[:, None] + np.arange(WIDTH)) % self._size, weights.astype(np.float32)


def lagrange_weights(t: Array, taps: int) -> Array:
    """Return weights (taps, len(t)) that interpolate values at 1 - taps / 2 ... taps / 2 to t, 0 <= t <= 1."""
    nodes = np.arange(taps) + 1 - taps // 2
    out = np.ones((taps, len(t)))
    for i, node in enumerate(nodes):
        for other in np.delete(nodes, i):
            out[i] *= (t - other) / (node - other)
    return out


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

    reconstructor: Array

    def __init__(self, lenslets: Lenslets, nolls: Sequence[int], order: int | None = None) -> None:
        self.lenslets = lenslets
        self.nolls: tuple[int, ...] = tuple(nolls)
        self.order: int = noll(max(nolls))[0] if order is None else order
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
