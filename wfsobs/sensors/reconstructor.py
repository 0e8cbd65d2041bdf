"""Least-squares reconstruction of Zernike modes from slopes."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from wfsobs.sensors.lenslets import Lenslets
from wfsobs.sensors.zernike import noll, up_to_order
from wfsobs.typing import Array

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
