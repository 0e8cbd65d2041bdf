"""The lenslet array of a Shack-Hartmann sensor, and the least-squares reconstruction of Zernike modes from its slopes.

The pupil is cut into square cells, several to a subaperture, each lit or dark by its centre. A slope is the mean gradient
of the phase over the lit cells of its subaperture, so that one on the edge sees no phase from outside the pupil.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from wfsobs.sensors.zernike import noll, up_to_order
from wfsobs.typing import Array


@dataclass(frozen=True)
class Lenslets:
    """A square array of lenslets over a round aperture.

    Attributes
    ----------
    diameter : float
        Aperture diameter [m].
    across : int
        Subapertures along a side.
    illumination : float
        Minimum lit fraction of a valid subaperture.
    obscuration : float
        Diameter of the central obscuration over that of the aperture.
    cells : int
        Minimum number of cells across the aperture: 160 are 5 cm on 8 m.
    """

    diameter: float = 8.0
    across: int = 40
    illumination: float = 0.5
    obscuration: float = 0.0
    cells: int = 160

    @property
    def per_side(self) -> int:
        """Cells along a side of a subaperture: an even number."""
        return 2 * -(-self.cells // (2 * self.across))

    @property
    def pitch(self) -> float:
        """Side of a cell [m]."""
        return self.diameter / (self.across * self.per_side)

    @cached_property
    def centres(self) -> Array:
        """Coordinates of the cell centres along either axis, (n,) [m]."""
        n = self.across * self.per_side
        return (np.arange(n) - (n - 1) / 2) * self.pitch

    @cached_property
    def lit(self) -> Array:
        """Cells inside the pupil: bool (n, n), y along the rows."""
        r = np.hypot(self.centres[:, None], self.centres[None, :])
        return (r <= self.diameter / 2) & (r >= self.obscuration * self.diameter / 2)

    @cached_property
    def fraction(self) -> Array:
        """Lit fraction of every subaperture: (across, across), y along the rows."""
        return self._blocks(self.lit.astype(float)).mean(axis=(-3, -1))

    @cached_property
    def valid(self) -> Array:
        """Subapertures that are lit enough: bool (across, across)."""
        return self.fraction >= max(self.illumination, 1e-9)

    @property
    def count(self) -> int:
        """Number of valid subapertures."""
        return int(self.valid.sum())

    def mean(self, cells: Array) -> Array:
        """Average over the lit cells of the valid subapertures: (..., n, n) -> (..., count)."""
        sums = self._blocks(cells * self.lit).sum(axis=(-3, -1))
        return sums[..., self.valid] / (self.fraction[self.valid] * self.per_side**2)

    def spread(self, weights: Array) -> Array:
        """Apply the transpose of `mean`: weights of slopes (..., count) to weights of cells (..., n, n)."""
        shares = np.zeros((*weights.shape[:-1], *self.valid.shape))
        shares[..., self.valid] = weights / (self.fraction[self.valid] * self.per_side**2)
        return shares.repeat(self.per_side, axis=-2).repeat(self.per_side, axis=-1) * self.lit

    def slopes(self, phase: Callable[[Array, Array], Array]) -> Array:
        """Return the mean gradients [phase/m] of phase(x, y), x and y in [m]: (..., 2 count), those along x first.

        The mean of a derivative over a cell is the difference of the means over two of its edges, and these come from
        two Gauss points: exact for cubics.
        """
        edges = (np.arange(len(self.centres) + 1) - len(self.centres) / 2) * self.pitch
        offset = self.pitch / np.sqrt(12.0)
        below, above = self.centres - offset, self.centres + offset
        on_columns = phase(edges[None, :], below[:, None]) + phase(edges[None, :], above[:, None])
        on_rows = phase(below[None, :], edges[:, None]) + phase(above[None, :], edges[:, None])
        along_x, along_y = np.diff(on_columns, axis=-1) / (2 * self.pitch), np.diff(on_rows, axis=-2) / (2 * self.pitch)
        return np.concatenate([self.mean(along_x), self.mean(along_y)], axis=-1)

    def _blocks(self, cells: Array) -> Array:
        shape = (self.across, self.per_side, self.across, self.per_side)
        return cells.reshape(*cells.shape[:-2], *shape)


MAX_CONDITION = 30.0
"""Maximum condition number of the interaction matrix with normalised columns: beyond it the modes are not resolved."""


@lru_cache(maxsize=8)
def reconstructor(lenslets: Lenslets, order: int) -> Array:
    """Return the least-squares fit of all modes up to a radial order, without piston.

    Parameters
    ----------
    lenslets : Lenslets
        Geometry of the sensor.
    order : int
        Radial order.

    Returns
    -------
    Array
        Modes [um] from slopes [um/m]: (modes, 2 lenslets.count), read-only.

    Raises
    ------
    ValueError
        The slopes do not determine the modes.
    """
    if lenslets.count == 0:
        raise ValueError(f"no subaperture of {lenslets.across} x {lenslets.across} is lit to {lenslets.illumination:g}")
    matrix = interaction(lenslets, order)
    if 2 * lenslets.count < matrix.shape[1]:
        raise ValueError(
            f"{lenslets.count} subapertures cannot tell the {matrix.shape[1]} modes up to radial order {order} apart"
        )
    size = np.linalg.norm(matrix, axis=0)
    condition = np.linalg.cond(matrix / size)
    if not condition <= MAX_CONDITION:
        raise ValueError(
            f"{lenslets.count} subapertures hardly tell the modes up to radial order {order} apart "
            f"(condition {condition:.2g}, at most {MAX_CONDITION:g})"
        )
    out = np.linalg.pinv(matrix / size) / size[:, None]
    out.setflags(write=False)
    return out


def highest_order(lenslets: Lenslets, at_most: int) -> int:
    """Return the highest radial order that the slopes determine.

    Parameters
    ----------
    lenslets : Lenslets
        Geometry of the sensor.
    at_most : int
        Maximum order; another maximum is the number of subapertures along a side.

    Returns
    -------
    int
        Radial order.

    Raises
    ------
    ValueError
        The slopes determine no order.
    """
    for order in range(min(at_most, lenslets.across), 1, -1):
        try:
            reconstructor(lenslets, order)
        except ValueError:
            continue
        return order
    reconstructor(lenslets, 1)
    return 1


def interaction(lenslets: Lenslets, order: int) -> Array:
    """Return the slopes [um/m] of one [um] of each mode up to a radial order, without piston: (2 lenslets.count, modes)."""
    radius = lenslets.diameter / 2.0
    return lenslets.slopes(lambda x, y: polynomials(order, x / radius, y / radius)).T


def polynomials(order: int, x: Array, y: Array) -> Array:
    """Evaluate Noll's Zernike polynomials up to a radial order, without piston.

    R_n^m(r) exp(i m t) = (x + iy)^m times a polynomial of r^2; defined outside the unit disc as well.

    Parameters
    ----------
    order : int
        Radial order.
    x, y : Array
        Points in units of the radius.

    Returns
    -------
    Array
        (modes, *shape of x and y together).
    """
    square, turn = x**2 + y**2, x + 1j * y
    powers = [np.ones_like(turn)]
    for _ in range(order):
        powers.append(powers[-1] * turn)
    out = np.empty((len(up_to_order(order)), *square.shape))
    for i, j in enumerate(up_to_order(order)):
        n, signed = noll(j)
        m = abs(signed)
        radial = np.polyval(_radial(n, m), square)
        angular = powers[m].real if signed >= 0 else powers[m].imag
        out[i] = math.sqrt((n + 1.0) * (1 if m == 0 else 2)) * radial * angular
    return out


def _radial(n: int, m: int) -> list[float]:
    """Return the coefficients of R_n^m(r) / r^m in r^2, the highest power first (Noll, eq. 2)."""
    half = (n - m) // 2
    return [(-1) ** s * math.comb(n - s, s) * math.comb(n - 2 * s, half - s) for s in range(half + 1)]
