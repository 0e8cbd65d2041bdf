"""Settings of the aperture and of the turbulence above it."""

from __future__ import annotations

import param

from wfsobs.parameters import Real, Reals
from wfsobs.settings import Group


class Telescope(Group):
    """The aperture."""

    diameter = Real(8.0, bounds=(0.1, 100.0), label="Aperture diameter D",
                    doc="Diameter of the aperture [m] (paper, Table 1).")


class PsdTable(Group):
    """A one-sided power spectral density given as a table."""

    frequency = Reals([], item_bounds=(0.0, 5000.0), bounds=(0, 100_000), label="Frequencies",
                      doc="Frequencies [Hz], increasing.")
    tip = Reals([], item_bounds=(0.0, 1e6), bounds=(0, 100_000), label="PSD of tip",
                doc="One-sided power spectral density of tip [um^2/Hz], one number per frequency.")
    tilt = Reals([], item_bounds=(0.0, 1e6), bounds=(0, 100_000), label="PSD of tilt",
                 doc="One-sided power spectral density of tilt [um^2/Hz], one number per frequency.")


class Turbulence(Group):
    """Atmospheric turbulence."""

    source = param.Selector(default="ar2", objects=["ar2", "none"], label="Source",
                            doc="How turbulence is made: the AR(2) process of the paper, eq. 1, or none.")
    wind_speed = Real(15.0, bounds=(0.1, 100.0), softbounds=(1.0, 40.0), step=0.5, label="Wind speed V₀",
                      doc="Wind speed [m/s]; sets the corner w0 = 0.6 pi (n + 1) V0 / D (paper, eq. 1d and Table 1).")
    damping = Real(0.9, bounds=(0.01, 1.0), step=0.01, label="Damping ξ",
                   doc="Damping factor of the AR(2) process (paper, Table 1).")
    rms = Real(0.5, bounds=(0.0, 100.0), softbounds=(0.0, 2.0), step=0.01, label="Strength, rms",
               doc="Standard deviation of each mode [um]; the paper gives none, r0 = 0.157 m, L0 = 25 m "
                   "on 8 m give 0.529 um.")
