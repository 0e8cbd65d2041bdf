"""Densities of many AR(2) processes at once, and their derivatives in closed form, for fits in milliseconds."""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from wfsobs.typing import Array


def densities(numbers: Array, dt: float, f: Array) -> tuple[Array, Array]:
    """Compute the densities of AR(2) processes and the derivatives of their logarithms.

    The density is that of the drive over the squares of two distances |1 - r exp(i a)|^2 = (1 - r)^2 + 4 r sin(a / 2)^2, where
    r exp(+- i angle) are the poles and a = angle -+ 2 pi f dt; that of the drive has two such distances as well, with a = angle
    and a = angle - pi.

    Parameters
    ----------
    numbers : Array
        Log of omega [rad/s], logit of the damping, log of the rms [um], (processes, 3).
    dt : float
        Time step [s].
    f : Array
        Frequencies [Hz].

    Returns
    -------
    density : Array
        One-sided [um^2/Hz], (processes, len(f)).
    slopes : Array
        Derivatives of its logarithm by the numbers, (processes, 3, len(f)).
    """
    omega, damping, rms = np.exp(numbers[:, :1]), expit(numbers[:, 1:2]), np.exp(numbers[:, 2:])
    damped, rest = damping * omega * dt, np.sqrt(expit(-numbers[:, 1:2]) * (1.0 + damping))  # rest = sqrt(1 - damping^2)
    angle, r, short = rest * omega * dt, np.exp(-damped), -np.expm1(-damped)  # short = 1 - r

    def distance(sine: Array, cosine: Array) -> tuple[Array, Array, Array]:
        """Of sine and cosine of a / 2; and the derivatives of its logarithm by r and by a."""
        squared = sine**2
        d = short**2 + 4.0 * r * squared
        return d, (4.0 * squared - 2.0 * short) / d, 4.0 * r * sine * cosine / d

    s, c, turned_s, turned_c = np.sin(0.5 * angle), np.cos(0.5 * angle), np.sin(np.pi * f * dt), np.cos(np.pi * f * dt)
    ss, sc, cs, cc = s * turned_s, s * turned_c, c * turned_s, c * turned_c
    (zero, zero_r, zero_a), (half, half_r, half_a) = distance(s, c), distance(-c, s)
    (low, low_r, low_a), (high, high_r, high_a) = distance(sc - cs, cc + ss), distance(sc + cs, cc - ss)
    lost = -np.expm1(-2.0 * damped)  # 1 - r^2
    S = 2.0 * dt * rms**2 * lost / (1.0 + r**2) * zero * half / (low * high)
    by_r = zero_r + half_r - low_r - high_r - 2.0 * r / lost - 2.0 * r / (1.0 + r**2)
    by_angle = zero_a + half_a - low_a - high_a
    by_logit = -(r * by_r + damping / rest * by_angle) * omega * dt * damping * (1.0 - damping)
    return S, np.stack([angle * by_angle - damped * r * by_r, by_logit, np.full_like(S, 2.0)], axis=1)
