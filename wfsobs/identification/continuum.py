"""Which processes of a spectrum are vibration: what shapes the continuum has no visible peak."""

from __future__ import annotations

from math import pi

import numpy as np

from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.spectral.model import Spectrum

BROAD = 0.1
"""Minimum damping of a resonance of the continuum: modes of structures have 0.005 to 0.05."""
STANDS_OUT = 1.25
"""Minimum density at the maximum of a broad vibration peak, over that of the dip below it."""
POINTS = 200
"""Points at which the density is evaluated."""


def is_continuum(spectrum: Spectrum, p: Ar2 | Ar3, lowest: float) -> bool:
    """Return whether a process of the spectrum belongs to turbulence or background.

    It does if it lies below `lowest`, the minimum frequency of peaks [Hz]; or if it is broad, and the density of the
    whole model has no maximum there that stands out of the dip on its lower side. Likelihood cannot decide: where no model
    of turbulence fits, a resonance raises it by any amount.
    """
    f0 = p.omega / (2.0 * pi)
    if f0 < lowest:
        return True
    if p.damping <= BROAD:
        return False
    f = np.linspace(max(1.0 - 3.0 * p.damping, 0.1) * f0, min((1.0 + p.damping) * f0, 0.5 / p.dt), POINTS)
    S = spectrum.psd(f)
    near = np.flatnonzero(f >= (1.0 - p.damping) * f0)
    top = near[np.argmax(S[near])]
    return bool(S[top] < STANDS_OUT * S[: top + 1].min())
