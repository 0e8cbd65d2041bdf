"""Processes as the numbers of a fit: logarithms, a logit; one of third order is one of second order behind one more pole."""

from __future__ import annotations

from dataclasses import replace
from math import log, sqrt

import numpy as np
from scipy.special import logit

from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.typing import Array


def numbers_of(p: Ar2 | Ar3) -> Array:
    """Return the numbers of a process, as `densities` takes them; of one of third order the log of the third corner besides."""
    numbers = np.array([log(p.omega), logit(min(p.damping, 0.99)), log(max(p.rms, 1e-12))])
    if isinstance(p, Ar3):
        alone = Ar2(p.omega, min(p.damping, 0.99), 1.0, p.dt)
        numbers = np.append(numbers, log(p.corner))
        numbers[2] = 0.5 * log(max(_slow_density(p) / _slow_density(alone), 1e-24))
    return numbers


def behind_pole(p: Ar2, corner: float) -> Ar3:
    """Return the process of third order with the poles of p and one more, and the density of p at low frequencies."""
    one = Ar3(p.omega, p.damping, max(corner, p.omega), 1.0, p.dt)
    return replace(one, rms=sqrt(_slow_density(p) / _slow_density(one)))


def _slow_density(p: Ar2 | Ar3) -> float:
    return float(p.psd(np.zeros(1))[0])


def one_pole(number: float, dt: float, f: Array) -> tuple[Array, Array]:
    """Return the power that passes a pole, 1 at low frequencies, and the derivative of its logarithm by `number`.

    number : log of the corner [rad/s];  f : frequencies [Hz]
    """
    decay = float(np.exp(number)) * dt
    a, turned = np.exp(-decay), 4.0 * np.sin(np.pi * f * dt) ** 2
    distance = (1.0 - a) ** 2 + a * turned
    by_a = -2.0 / (1.0 - a) - (turned - 2.0 * (1.0 - a)) / distance
    return (1.0 - a) ** 2 / distance, -decay * a * by_a
