"""What a time-invariant loop does at every frequency.

rejection       E = 1 / (1 + L) = 1 - P F       from the disturbance to the residual
noise transfer  N = P F = L / (1 + L)           from the measurement's noise to the residual, its sign and delay aside
loop gain       L = P F / (1 - P F)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wfsobs.control.margins import Response, frequencies
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array


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
