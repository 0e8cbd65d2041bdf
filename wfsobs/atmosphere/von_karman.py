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
"""Wavelength that r0 is given at [um]."""
CORE = 64.0
"""k D / 2 up to which waves are resolved finely across the wind; beyond lie less than 1e-4 of the variance of radial order 6."""
FIELD = 1e-3
"""Shifts between beams [m per m of height, 3.4 arcmin] that the spacing across the wind resolves."""


@dataclass(frozen=True)
class Layer:
    """One layer along the line of sight.

    strength : r0^(-5/3) of the layer alone [m^(-5/3)], r0 at 500 nm
    height   : distance along the line of sight [m]; speed [m/s]
    angle    : direction that the wind blows to, from the pupil's x axis to its y axis [rad]
    """

    strength: float
    height: float
    speed: float
    angle: float


def spectrum(k2: Array, strength: float, outer_scale: float) -> Array:
    """Von Karman density of the wavefront [um^2 m^2] at squared angular spatial frequency k2 [rad^2/m^2].

    Its integral over the plane d^2k is the variance. 0.0229 r0^(-5/3) (f^2 + L0^-2)^(-11/6) rad^2 m^2 with k = 2 pi f
    (Noll 1976, eq. 21, with an outer scale); L0 = `outer_scale` [m].
    """
    in_angular = 0.0229 * strength * (2.0 * np.pi) ** (11.0 / 3.0 - 2.0)
    return in_angular * (k2 + (2.0 * np.pi / outer_scale) ** 2) ** (-11.0 / 6.0) * (SEEING_WAVELENGTH / (2.0 * np.pi)) ** 2


def fine_rule(height: float, diameter: float) -> tuple[float, float]:
    """(delta, h) of the rule across the wind where waves matter."""
    return np.pi / (diameter + FIELD * height), 0.5


def across(q: float, end: float, delta: float, h: float) -> tuple[Array, Array]:
    """Nodes k_y, symmetric about 0, and weights [rad/m] of the rule above, out to about `end`."""

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
