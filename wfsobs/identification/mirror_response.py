"""Impulse responses, of unit gain, of a measurement to the commands of a mirror with dynamics.

Each has a group delay at low frequency and two shape parameters: an arbitrary response over four lags, or that of a second-order
mirror.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from wfsobs.typing import Array

LAGS = 256
"""Length of a response; its first lag is one frame."""

RANGE = np.log([[0.03, 0.02], [1.0, 3.0]])
"""Bounds of the shape of a second-order mirror: logarithms of natural frequency over frame rate, and of damping ratio."""

SHAPES = tuple((np.log(f), np.log(damping)) for f in (0.15, 0.3, 0.6) for damping in (0.3, 0.8))
"""Starting points of its fit."""

Response = Callable[[Array], Array]
"""From delay [frames] and shape, (3,), to the response, (LAGS,)."""


def few_lags(base: int) -> Response:
    """Return the responses over four lags around a delay of `base` whole frames.

    The shape is the size of two second differences, which change neither gain nor group delay at low frequency.
    """
    return partial(_few_lags, base)


def _few_lags(base: int, x: Array) -> Array:
    out, first, part = np.zeros(LAGS), max(base - 1, 1) - 1, x[0] - base
    out[base - 1 : base + 1] = 1.0 - part, part
    for i, size in enumerate(x[1:]):
        out[first + i : first + i + 3] += size * np.array([1.0, -2.0, 1.0])
    return out


def second_order(x: Array) -> Array:
    """Return the response of a second-order mirror, (LAGS,).

    x : delay [frames], logarithms of natural frequency over frame rate and of damping ratio, (3,)

    The mirror holds a command for one frame and the sensor averages over one, so that the response is the second difference of
    the integral of its step response. That integral tends to t - 2 damping / omega, the group delay at low frequency.
    """
    omega, damping = 2.0 * np.pi * np.exp(x[1]), np.exp(x[2])
    root = np.sqrt(complex(damping**2 - 1.0))
    root = root if abs(root) > 1e-4 else 1e-4
    p, q = omega * (-damping + root), omega * (-damping - root)
    t = np.maximum(np.arange(LAGS + 2) - (x[0] - 2.0 * damping / omega), 0.0)
    return np.diff(t + ((q / p * np.expm1(p * t) - p / q * np.expm1(q * t)) / (p - q)).real, 2)
