"""What a mirror with dynamics makes of commands: responses of a measurement, lag by lag, of gain 1.

Each has a delay, the group delay at low frequency, and two numbers of its shape. One is any response over few lags; the other
that of a second-order mirror, which swings on.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from wfsobs.typing import Array

LAGS = 256
"""Lags of a response, the first is 1."""

RANGE = np.log([[0.03, 0.02], [1.0, 3.0]])
"""Least and largest shape of a second-order mirror: natural frequency over the rate, damping ratio."""

SHAPES = tuple((np.log(f), np.log(damping)) for f in (0.15, 0.3, 0.6) for damping in (0.3, 0.8))
"""Where its search starts."""

Response = Callable[[Array], Array]
"""Of delay [frames] and shape (3,) to the response (LAGS,)."""


def few_lags(base: int) -> Response:
    """Return the responses of four lags around the whole part of a delay; a second difference moves neither gain nor delay."""
    return partial(_few_lags, base)


def _few_lags(base: int, x: Array) -> Array:
    out, first, part = np.zeros(LAGS), max(base - 1, 1) - 1, x[0] - base
    out[base - 1 : base + 1] = 1.0 - part, part
    for i, size in enumerate(x[1:]):
        out[first + i : first + i + 3] += size * np.array([1.0, -2.0, 1.0])
    return out


def second_order(x: Array) -> Array:
    """Return the response of a mirror of the natural frequency exp(x[1]) over the rate and the damping ratio exp(x[2]).

    It holds a command for a frame and the sensor averages over one: second differences of the integral of its step response,
    t - 2 damping / omega at last, which is its group delay.
    """
    omega, damping = 2.0 * np.pi * np.exp(x[1]), np.exp(x[2])
    root = np.sqrt(complex(damping**2 - 1.0))
    root = root if abs(root) > 1e-4 else 1e-4
    p, q = omega * (-damping + root), omega * (-damping - root)
    t = np.maximum(np.arange(LAGS + 2) - (x[0] - 2.0 * damping / omega), 0.0)
    return np.diff(t + ((q / p * np.expm1(p * t) - p / q * np.expm1(q * t)) / (p - q)).real, 2)
