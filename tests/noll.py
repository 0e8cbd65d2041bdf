"""Covariances of Zernike coefficients in Kolmogorov turbulence, in closed form."""

from __future__ import annotations

import math
from math import gamma

from wfsobs.sensors.zernike import noll


def noll_covariance(j: int, i: int) -> float:
    """Return the covariance of the coefficients of two modes in Kolmogorov turbulence [(D / r0)^(5/3) rad^2] (Noll, eq. 25).

    With the constant of the spectrum, 0.0229; the 2.2698 that is often printed here is 1 % larger.
    """
    (n, m), (p, q) = noll(j), noll(i)
    if j == 1 or i == 1:
        raise ValueError("the variance of piston is infinite")
    if m != q:
        return 0.0
    numeric = gamma(14 / 3) * (4.8 * gamma(6 / 5)) ** (5 / 6) * gamma(11 / 6) ** 2 / (2.0 ** (8 / 3) * math.pi)
    sign = (-1) ** ((n + p - 2 * abs(m)) // 2)
    return (
        numeric
        * sign
        * math.sqrt((n + 1.0) * (p + 1.0))
        * gamma((n + p - 5 / 3) / 2)
        / (gamma((n - p + 17 / 3) / 2) * gamma((p - n + 17 / 3) / 2) * gamma((n + p + 23 / 3) / 2))
    )
