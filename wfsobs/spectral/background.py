"""A coloured background of a measurement: noise that is flat up to a corner far above that of turbulence.

The aliasing of a Shack-Hartmann sensor is like that.
"""

from __future__ import annotations

from dataclasses import replace
from math import pi, sqrt

from wfsobs.signal.ar2 import Ar2
from wfsobs.spectral.model import Spectrum

DAMPING = 0.8
"""Its damping, which no fit changes."""
REACHES = (0.02, 0.08)
"""Its corners, over the rate, at which a fit starts: 20 and 80 Hz at 1 kHz."""
WORTH = 8.0
"""Minimum gain of log-likelihood for its two parameters: noise gains as much with a probability of 0.03 % (chi squared of 16)."""


def with_first_guess(spectrum: Spectrum, reach: float) -> Spectrum:
    """Return a spectrum with a background to start from, of about half the density of the noise.

    reach : its corner over the rate
    """
    dt = spectrum.dt
    return replace(spectrum, background=Ar2(2.0 * pi * reach / dt, DAMPING, spectrum.noise * sqrt(reach), dt))
