"""The von Karman spectrum of a layer, and the rule that integrates it over spatial frequencies.

The trapezoidal rule in u(k) = asinh(k / q) / h + k / delta, q^2 the outer scale's k_0^2 and, where the rule is across the
wind, k_x^2 besides. The first term follows the spectrum, analytic in u; the second keeps the spacing below delta, which
resolves the aperture and the way between beams.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wfsobs.typing import Array

SEEING_WAVELENGTH = 0.5
"""Wavelength of r0 [um]."""
CORE = 64.0
"""k D / 2 up to which waves are finely resolved across the wind; less than 1e-4 of the variance of radial order 6 lies beyond."""
FIELD = 1e-3
"""Shifts between beams that the spacing across the wind resolves [m per m of height, 3.4 arcmin]."""


@dataclass(frozen=True)
class TurbulenceLayer:
    """One layer along the line of sight.

    Attributes
    ----------
    strength : float
        r0^(-5/3) of the layer alone, r0 at 500 nm [m^(-5/3)].
    height : float
        Distance along the line of sight [m].
    speed : float
        Wind speed [m/s].
    angle : float
        Direction that the wind blows to, from the pupil's x axis to its y axis [rad].
    """

    strength: float
    height: float
    speed: float
    angle: float


def von_karman_density(k2: Array, strength: float, outer_scale: float) -> Array:
    """Return the von Karman density of the wavefront; its integral over the plane d^2k is the variance.

    0.0229 r0^(-5/3) (f^2 + L0^-2)^(-11/6) rad^2 m^2 with k = 2 pi f (Noll 1976, eq. 21, with an outer scale).

    Parameters
    ----------
    k2 : Array
        Squared angular spatial frequency [rad^2/m^2].
    strength : float
        r0^(-5/3), r0 at 500 nm [m^(-5/3)].
    outer_scale : float
        L0 [m].

    Returns
    -------
    Array
        Density [um^2 m^2].
    """
    in_angular = 0.0229 * strength * (2.0 * np.pi) ** (11.0 / 3.0 - 2.0)
    return in_angular * (k2 + (2.0 * np.pi / outer_scale) ** 2) ** (-11.0 / 6.0) * (SEEING_WAVELENGTH / (2.0 * np.pi)) ** 2


def fine_rule(height: float, diameter: float) -> tuple[float, float]:
    """Return (delta, h) of the fine rule across the wind."""
    return np.pi / (diameter + FIELD * height), 0.5


def nodes_across_wind(q: float, end: float, delta: float, h: float) -> tuple[Array, Array]:
    """Return nodes k_y, symmetric about 0, and weights [rad/m] of the rule above, out to about `end`."""

    def u(k: Array) -> Array:
        return np.arcsinh(k / q) / h + k / delta

    n = int(np.ceil(float(u(np.array(end)))))
    wanted = np.arange(n) + 0.5
    table = q * np.sinh(np.linspace(0.0, np.arcsinh(end / q) + 1.0, 8 * n + 2))
    k = np.interp(wanted, u(table), table)
    for _ in range(3):
        k -= (u(k) - wanted) * _spacing(k, q, delta, h)
    weight = _spacing(k, q, delta, h)
    return np.concatenate([-k[::-1], k]), np.concatenate([weight[::-1], weight])


def _spacing(k: Array, q: float, delta: float, h: float) -> Array:
    return 1.0 / (1.0 / (h * np.hypot(k, q)) + 1.0 / delta)
