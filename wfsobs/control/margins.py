"""What a time-invariant loop does at every frequency, what it leaves, and how far it is from instability.

    rejection       E = 1 / (1 + L) = 1 - P F       from the disturbance to the residual
    noise transfer  N = P F = L / (1 + L)           from the measurement's noise to the residual, its sign and delay aside
    loop gain       L = P F / (1 - P F)

With T = P F = L / (1 + L) (`mirror.Law`), nothing needs to be divided by what may vanish:

    L real      where Im T = 0; the gain can be multiplied by kappa = 1 - 1 / T before 1 + kappa L = 0
    |L| = 1     where Re T = 1/2; L can be turned by its angle from -1
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from scipy.optimize import minimize_scalar

from wfsobs.control.mirror import Law, Mirror
from wfsobs.prior import Spectra
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array

Response = Callable[[Array], Complex]
"""omega (n,) [rad per step] -> (n,)."""


@dataclass(frozen=True)
class Margins:
    """Stability margins; None where there is no limit.

    Attributes
    ----------
    gain, least_gain : float or None
        Factors above and below 1 by which the loop gain may be multiplied.
    phase : float or None
        Phase by which the loop gain may be turned, either way [rad].
    delay : float or None
        Additional delay [s].
    disk : float
        `disk_margin`.
    """

    gain: float | None
    least_gain: float | None
    phase: float | None
    delay: float | None
    disk: float


def margins(T: Response, omega: Array, dt: float) -> Margins:
    """Margins of a stable loop; omega (n,): points from 0 to pi between which T crosses a line at most once."""
    values = T(omega)
    real = np.concatenate([values.real[[0, -1]], T(crossings(lambda w: T(w).imag, omega, values.imag)).real])
    with np.errstate(divide="ignore"):
        factors = 1.0 - 1.0 / real
    unit = crossings(lambda w: T(w).real - 0.5, omega, values.real - 0.5)
    at_unit = T(unit)
    lag = np.angle(-at_unit / (1.0 - at_unit)) % (2.0 * np.pi)  # to -1 by turning clockwise, as a delay does
    return Margins(
        min(factors[(factors > 1.0) & np.isfinite(factors)].tolist(), default=None),
        max(factors[(factors >= 0.0) & (factors < 1.0)].tolist(), default=None),
        min(np.minimum(lag, 2.0 * np.pi - lag).tolist(), default=None),
        min((lag / unit * dt).tolist(), default=None),
        disk_margin(T, omega),
    )


def disk_margin(T: Response, omega: Array) -> float:
    """Disk margin of a stable loop: 1 / max |S - 1/2|, S = 1 - T (P. Seiler et al., IEEE Control Systems 40, 2020).

    The loop bears every complex factor (1 + x/2) / (1 - x/2), |x| below it: gain and phase at once, at any frequency.
    omega : points from 0 to pi that are close where T changes
    """
    size = np.abs(T(omega) - 0.5)
    i = int(np.argmax(size))
    ends = omega[max(i - 1, 0)], omega[min(i + 1, omega.size - 1)]
    found = minimize_scalar(lambda w: -abs(T(np.array([w]))[0] - 0.5), bounds=ends, method="bounded", options={"xatol": 1e-12})
    return 1.0 / max(float(size[i]), -float(found.fun))


def crossings(f: Callable[[Array], Array], x: Array, values: Array) -> Array:
    """Where f, whose values at x (n,) are given, changes its sign, to rounding."""
    i = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    low, high, below = x[i], x[i + 1], np.signbit(values[i])
    parts, rows = np.linspace(0.0, 1.0, 17), np.arange(i.size)
    for _ in range(12 if i.size else 0):  # 16^12 parts are more than a double resolves
        points = low[:, None] + (high - low)[:, None] * parts
        changed = np.signbit(f(points.ravel()).reshape(points.shape)) != below[:, None]
        changed[:, 0], changed[:, -1] = False, True
        first = np.argmax(changed, axis=1)
        low, high = points[rows, first - 1], points[rows, first]
    return 0.5 * (low + high)


def frequencies(poles: Complex, n: int = 400, near_pole: int = 24) -> Array:
    """Return points from 0 to pi [rad per step] for a filter with these poles.

    n are even, n on a logarithmic scale, and so many on either side of each pole are close to it.
    """
    spread = np.concatenate([[0.0], np.geomspace(0.05, 40.0, near_pole)])
    angle, width = np.abs(np.angle(poles)), np.maximum(-np.log(np.maximum(np.abs(poles), 1e-3)), 1e-9)
    near = (angle[:, None] + width[:, None] * np.concatenate([-spread, spread])).ravel()
    points = np.concatenate([np.geomspace(1e-5 * np.pi, np.pi, n), np.linspace(0.0, np.pi, n), near])
    return np.unique(points[(points >= 0.0) & (points <= np.pi)])


@dataclass(frozen=True)
class Curves:
    """frequency (n,) [Hz], above zero, closer where the loop changes faster; noise (n,) = P F."""

    frequency: Array
    noise: Complex

    @property
    def rejection(self) -> Complex:
        """E (n,)."""
        return 1.0 - self.noise

    @property
    def loop_gain(self) -> Complex:
        """L (n,); infinite where nothing is left of a disturbance."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.noise / self.rejection


def curves(T: Response, poles: Complex, dt: float) -> Curves:
    """Of a time-invariant loop of T = L / (1 + L) whose law has these poles, with a step `dt` [s]."""
    omega = frequencies(poles)[1:]
    return Curves(omega / (2.0 * np.pi * dt), T(omega))


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
    T = scipy.interpolate.CubicSpline(points, mirror.response(points) * law.response(points))
    n, total = spectra.measurement.size, 0.0
    for start in range(0, n, AT_A_TIME):
        part = slice(start, min(start + AT_A_TIME, n))
        omega = np.pi * np.arange(part.start, part.stop) / (n - 1)
        density = residual_density(T(omega), spectra.disturbance[part], spectra.cross[part], spectra.measurement[part])
        total += 2.0 * float(density.sum()) - float(density[0]) * (start == 0) - float(density[-1]) * (part.stop == n)
    return total / (2 * (n - 1))
