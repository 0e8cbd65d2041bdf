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
    angle, r, short, lost = rest * omega * dt, np.exp(-damped), -np.expm1(-damped), -np.expm1(-2.0 * damped)  # 1 - r, 1 - r^2

    def distance(half_sine: Array, sine: Array) -> tuple[Array, Array]:
        """Return the inverse of one, of 2 sqrt(r) sin(a / 2), and the derivative of its logarithm by a, of 2 r sin(a)."""
        inverse = 1.0 / (short**2 + half_sine**2)
        return inverse, sine * inverse

    # The derivative of the logarithm by r is 1 / r - (1 - r^2) / r over the distance.
    wide, turned = 2.0 * np.sqrt(r), np.pi * f * dt
    s, c, of_sine, of_cosine = (g(x) for x in (0.5 * angle, angle) for g in (np.sin, np.cos))
    drive, drive_a = zip(distance(wide * s, 2.0 * r * of_sine), distance(wide * c, -2.0 * r * of_sine), strict=True)
    sc, cs = wide * s * np.cos(turned), wide * c * np.sin(turned)
    of_sum, of_difference = 2.0 * r * of_sine * np.cos(2.0 * turned), 2.0 * r * of_cosine * np.sin(2.0 * turned)
    (low, low_a), (high, high_a) = distance(sc - cs, of_sum - of_difference), distance(sc + cs, of_sum + of_difference)
    S = 2.0 * dt * rms**2 * lost / ((1.0 + r**2) * drive[0] * drive[1]) * (low * high)
    by_r = lost / r * (low + high - drive[0] - drive[1]) - 2.0 * r / lost - 2.0 * r / (1.0 + r**2)
    by_angle = sum(drive_a) - low_a - high_a
    slopes = np.empty((len(numbers), 3, len(f)))
    slopes[:, 0] = angle * by_angle - damped * r * by_r
    slopes[:, 1] = (r * by_r + damping / rest * by_angle) * (-omega * dt * damping * (1.0 - damping))
    slopes[:, 2] = 2.0
    return S, slopes
