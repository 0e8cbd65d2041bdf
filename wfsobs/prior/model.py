"""What an observer is told of one mode beside its measurements: noise, turbulence and lines.

Made from a scenario (`observers.kalman_multi.prior`) or from an identification (`identify.result`).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import NamedTuple

from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.signal.statespace import DisturbanceModel, disturbance_model


class Line(NamedTuple):
    """A vibration peak: natural frequency [Hz], damping (0 for a pure line), rms [um]."""

    frequency: float
    damping: float
    rms: float


@dataclass(frozen=True)
class Prior:
    """The model of one mode.

    noise      : rms of the white noise of its measurement [um]
    turbulence : processes whose sum the turbulence is, sampled every `dt` [s]; a coloured background is one of them, as
        measurements alone cannot tell the two apart
    lines      : the peaks of the vibration
    """

    noise: float
    dt: float
    turbulence: tuple[Ar2 | Ar3, ...] = ()
    lines: tuple[Line, ...] = ()

    def model(self, line_width: float) -> DisturbanceModel:
        """The state-space model, every line at least `line_width` wide at half maximum [Hz]."""
        least = pi * line_width  # as xi w
        peaks = []
        for frequency, damping, rms in self.lines:
            omega = 2.0 * pi * frequency
            peaks.append(Ar2(omega, min(max(damping, least / omega), 1.0), rms, self.dt))
        return disturbance_model(self.turbulence, peaks)
