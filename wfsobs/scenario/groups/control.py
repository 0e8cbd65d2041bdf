"""Settings of the closed loop in which controllers are compared."""

from __future__ import annotations

from types import MappingProxyType

import param

from wfsobs.settings.group import Group
from wfsobs.settings.parameters import Real


class Control(Group):
    """The mirror and the controllers of the closed-loop comparison; the loop's own integrator makes the record."""

    used_when = MappingProxyType({"gain": ("integrator", ("manual",))})

    delay = Real(
        2.0,
        bounds=(1.0, 10.0),
        step=0.1,
        label="Delay",
        doc="Steps from a command to the first measurement that sees it, fractions allowed [frames] (paper: 2). The "
        "record has that of the paper.",
    )
    stroke = Real(
        0.0,
        bounds=(0.0, 100.0),
        softbounds=(0.0, 5.0),
        step=0.1,
        label="Stroke limit",
        doc="Maximum command of a mode, either way [um]; 0 is no limit.",
    )
    rate = Real(
        0.0,
        bounds=(0.0, 100.0),
        softbounds=(0.0, 1.0),
        step=0.01,
        label="Rate limit",
        doc="Maximum change of a mode's command [um/ms]; 0 is no limit.",
    )
    integrator = param.Selector(
        default="optimised",
        objects=["optimised", "manual"],
        label="Integrator gain from",
        doc="optimised: optimal gain for the scenario's true spectra, mode by mode; manual: the gain below.",
    )
    gain = Real(
        0.5,
        bounds=(0.0, 5.0),
        softbounds=(0.0, 1.0),
        step=0.01,
        label="Integrator gain",
        doc="g of u[k] = leak u[k-1] - g y[k], for integrator manual. With a delay of two frames stable below 1.",
    )
    leak = Real(1.0, bounds=(0.0, 1.0), step=0.001, label="Integrator leak", doc="1 is a pure integrator.")
    wavelength = Real(2.2, bounds=(0.1, 30.0), step=0.05, label="Science wavelength", doc="Wavelength of the Strehl ratio [um].")
