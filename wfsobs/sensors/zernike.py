"""Noll's Zernike modes: indices, names and columns, Fourier transforms, and covariances in Kolmogorov turbulence.

Reference: R. J. Noll, "Zernike polynomials and atmospheric turbulence", J. Opt. Soc. Am. 66, 207 (1976).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.atmosphere import Footprint, Wave

HIGHEST_ORDER = 6


class Mode(NamedTuple):
    """One Zernike mode: name, Noll index, radial order n(i) of the paper's eq. 1d."""

    name: str
    noll: int
    radial_order: int


@cache
def modes_up_to(order: int) -> tuple[Mode, ...]:
    """Return all modes up to a radial order, without piston, in Noll's order.

    >>> [mode.name for mode in modes_up_to(2)]
    ['tip', 'tilt', 'defocus', 'oblique astigmatism', 'vertical astigmatism']
    """
    return tuple(Mode(NAMES.get(j, f"Z{j}"), j, noll(j)[0]) for j in up_to_order(order))


def order_of(n_modes: int) -> int | None:
    """Return the smallest radial order that has so many modes, None where there is none.

    >>> order_of(2), order_of(5), order_of(28)
    (1, 2, None)
    """
    return next((order for order in range(1, HIGHEST_ORDER + 1) if len(modes_up_to(order)) >= n_modes), None)


NAMES = {
    1: "piston",
    2: "tip",
    3: "tilt",
    4: "defocus",
    5: "oblique astigmatism",
    6: "vertical astigmatism",
    7: "vertical coma",
    8: "horizontal coma",
    9: "vertical trefoil",
    10: "oblique trefoil",
    11: "spherical",
}


def noll(j: int) -> tuple[int, int]:
    """Return (n, m) of Noll's mode j: radial order and azimuthal frequency, m < 0 for a sine.

    >>> [noll(j) for j in range(1, 8)]
    [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1)]
    """
    n = (math.isqrt(8 * j - 7) - 1) // 2
    place = j - n * (n + 1) // 2 - 1
    m = 2 * ((place + (n + 1) % 2) // 2) + n % 2
    return n, m if j % 2 == 0 else -m


def up_to_order(order: int) -> range:
    """Return the Noll indices of all modes up to a radial order, without piston.

    >>> up_to_order(2)
    range(2, 7)
    """
    return range(2, (order + 1) * (order + 2) // 2 + 1)


TIP_TILT = modes_up_to(1)
MODE_NAMES = tuple(mode.name for mode in modes_up_to(HIGHEST_ORDER))
"""Of the columns of an array of any width."""


def bessel_ratio(order: int, x: Array) -> Array:
    """Return J_order(x) / x for an order of 1 or more, its limit at 0."""
    from scipy.special import jv  # here, since settings need the names of modes alone and SciPy takes long to import

    at_zero = 0.5 if order == 1 else 0.0
    return np.where(x > 0, jv(order, x) / np.where(x > 0, x, 1.0), at_zero)


def transform(j: int, kx: Array, ky: Array, bessel: Callable[[int, Array], Array] = bessel_ratio) -> Array:
    """Return the transform of mode j: its coefficient in exp(i k . r), r in units of the aperture's radius.

    (1 / pi) integral over the unit disc of Z_j(r) exp(i k . r), Noll's eq. 8 in angular frequencies:
    2 sqrt(n + 1) (-1)^((n - m) / 2) i^m J_(n+1)(k) / k, times sqrt(2) cos or sin of m times the angle of k where m > 0.

    Parameters
    ----------
    j : int
        Noll index.
    kx, ky : Array
        Angular spatial frequency times radius.
    bessel : callable
        (n, x) -> J_n(x) / x.

    Returns
    -------
    Array
        Complex, shape of k.
    """
    (n, _), k = noll(j), np.hypot(kx, ky)
    return amplitude(j) * bessel(n + 1, k) * azimuthal(j, (kx + 1j * ky) / np.where(k > 0, k, 1.0))


def amplitude(j: int) -> complex:
    """Return 2 sqrt(n + 1) (-1)^((n - m) / 2) i^m, times sqrt(2) where m > 0."""
    n, signed = noll(j)
    m = abs(signed)
    return 2.0 * math.sqrt((n + 1.0) * (2.0 if m else 1.0)) * (-1) ** ((n - m) // 2) * 1j**m


def azimuthal(j: int, direction: NDArray[np.complex128]) -> Array:
    """Return cos or sin of m times the angle of a direction of length one."""
    _, signed = noll(j)
    turn = direction ** abs(signed)
    return turn.real if signed >= 0 else turn.imag


TABLE_STEP, TABLE_END = 0.005, 1024.0
"""Of the tabulated Bessel functions: linear between points they are off by 3e-6 of their size or less."""


@lru_cache(maxsize=16)
def _table(order: int) -> Array:
    x = _table_points()
    return np.concatenate([bessel_ratio(order, x[:1]), _bessel(order)[1:] / x[1:]])


@lru_cache(maxsize=32)
def _bessel(order: int) -> Array:
    """Return J_order at the points of the table, by recurrence in the order where that is stable: a fourth of the time."""
    from scipy.special import j0, j1, jv

    x = _table_points()
    if order < 2:
        return j1(x) if order else j0(x)
    n = order - 1
    far = x[1:]
    out = np.concatenate([[0.0], 2.0 * n / far * _bessel(n)[1:] - _bessel(n - 1)[1:]])
    near = int(np.searchsorted(x, 2.0 * order))
    out[:near] = jv(order, x[:near])
    return out


def _table_points() -> Array:
    return np.arange(0.0, TABLE_END + 2.0 * TABLE_STEP, TABLE_STEP)


def tabulated_bessel_ratio(order: int, x: Array) -> Array:
    """Return J_order(x) / x from a table, 0 beyond its end."""
    table = _table(order)
    place = np.minimum(x, TABLE_END) * (1.0 / TABLE_STEP)
    below = place.astype(np.intp)
    low = table[below]
    return (low + (table[below + 1] - low) * (place - below)) * (x < TABLE_END)


@dataclass(frozen=True)
class ZernikeProjection:
    """Ideal sensor: Noll's coefficients of the phase itself over the pupil.

    Attributes
    ----------
    diameter : float
        Pupil diameter [m].
    modes : tuple of int
        Noll indices.
    """

    diameter: float
    modes: tuple[int, ...]

    @property
    def n_outputs(self) -> int:
        """Number of modes."""
        return len(self.modes)

    @property
    def reach(self) -> float:
        """Zero: a projection averages, so the waves of the core are enough [rad/m]."""
        return 0.0

    def transform(
        self, kx: Array, ky: Array, footprint: Footprint, bessel: Callable[[int, Array], Array] = bessel_ratio
    ) -> Array:
        """Return M(k) of every mode, shift included, complex (n_outputs, *shape of k)."""
        radius = 0.5 * self.diameter * footprint.scale
        turn = np.exp(1j * (kx * footprint.shift[0] + ky * footprint.shift[1]))
        return np.array([transform(j, radius * kx, radius * ky, bessel) * turn for j in self.modes])

    def measure(self, wave: Wave, footprint: Footprint) -> Array:
        """Return the response to the waves of a layer, see `plane_waves.Sensor`.

        Modes are even or odd across the wind, so k_y and -k_y are summed first; the angle
        from the wind's direction to the pupil's axis mixes the two modes of a pair.
        """
        half = wave.ky.size // 2
        seen = wave.through(footprint)
        upper, lower = seen[half:], seen[half - 1 :: -1]
        even, odd = upper + lower, upper - lower
        k = np.hypot(wave.kx, wave.ky[half:, None])
        direction = (wave.kx + 1j * wave.ky[half:, None]) / k
        x = k * (0.5 * self.diameter * footprint.scale)
        radial: dict[int, Array] = {}
        turns = {0: np.ones_like(direction)}
        pairs: dict[tuple[int, int], tuple[Array, Array]] = {}
        out = np.empty((self.n_outputs, wave.kx.size), complex)
        for row, j in zip(out, self.modes, strict=True):
            n, signed = noll(j)
            m = abs(signed)
            if (n, m) not in pairs:
                if n not in radial:
                    radial[n] = tabulated_bessel_ratio(n + 1, x)
                if m not in turns:
                    turns[m] = direction**m
                factor = amplitude(j)
                cosine = factor * np.einsum("yx,yx->x", radial[n] * turns[m].real, even)
                sine = factor * np.einsum("yx,yx->x", radial[n] * turns[m].imag, odd) if m else np.zeros(0)
                pairs[n, m] = cosine, sine
            cosine, sine = pairs[n, m]
            c, s = math.cos(m * wave.angle), math.sin(m * wave.angle)
            row[:] = cosine if m == 0 else c * cosine - s * sine if signed > 0 else s * cosine + c * sine
        return out
