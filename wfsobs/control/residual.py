"""What a time-invariant loop leaves, by theory: its transfer functions on the spectra."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from wfsobs.control.law import Law
from wfsobs.control.margins import frequencies
from wfsobs.control.mirror import Mirror
from wfsobs.prior import Spectra
from wfsobs.typing import Array

AT_A_TIME = 2**17
"""Frequencies; slow winds have millions of them."""


def residual_density(T: Any, target: Array, cross: Any, measurement: Array) -> Array:
    """Spectrum of the residual phi_dist + phi_corr where T = P F: what is not rejected, and the noise let in.

    target : of phi_dist; cross : between phi_dist[k] and z[k + 1]; measurement : of z
    """
    return target + np.abs(T) ** 2 * measurement - 2.0 * np.real(np.conj(cross) * T)


def residual_variance(law: Law, spectra: Spectra, mirror: Mirror) -> float:
    """Variance [um^2] of the residual that a stable time-invariant law leaves.

    T is smooth between the points that `frequencies` takes, close together near the poles of the law, whatever the number
    of frequencies of the spectra.
    """
    points = frequencies(law.poles)
    T = CubicSpline(points, mirror.response(points) * law.response(points))
    n, total = spectra.measurement.size, 0.0
    for start in range(0, n, AT_A_TIME):
        part = slice(start, min(start + AT_A_TIME, n))
        omega = np.pi * np.arange(part.start, part.stop) / (n - 1)
        density = residual_density(T(omega), spectra.disturbance[part], spectra.cross[part], spectra.measurement[part])
        total += 2.0 * float(density.sum()) - float(density[0]) * (start == 0) - float(density[-1]) * (part.stop == n)
    return total / (2 * (n - 1))
