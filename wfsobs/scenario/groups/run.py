"""Settings of the loop and of the run."""

from __future__ import annotations

from types import MappingProxyType
from typing import ClassVar

import param

from wfsobs.settings.group import Group, UsedWhen
from wfsobs.settings.parameters import Real, Whole


class Loop(Group):
    """The control loop that makes the record."""

    used_when: ClassVar[UsedWhen] = MappingProxyType({"gain": ("closed", (True,)), "leak": ("closed", (True,))})

    closed: param.Boolean[bool] = param.Boolean(True, label="Closed loop", doc="Drive the deformable mirror; off keeps u = 0.")
    gain: Real = Real(
        0.3,
        bounds=(0.0, 1.0),
        inclusive_bounds=(True, False),
        step=0.01,
        label="Integrator gain g",
        doc="u[k] = leak u[k-1] - g y_lgs[k]; not given in the paper. Stable below 1.",
    )
    leak: Real = Real(1.0, bounds=(0.0, 1.0), step=0.001, label="Integrator leak", doc="1 is a pure integrator.")


class Run(Group):
    """Length of the record, what is scored, and the seed."""

    duration: Real = Real(10.0, bounds=(0.1, 3600.0), softbounds=(2.0, 60.0), label="Duration", doc="Length of the record [s].")
    warm_up: Real = Real(
        1.0, bounds=(0.0, 600.0), softbounds=(0.0, 5.0), label="Warm-up", doc="Start of the record that no score counts [s]."
    )
    seed: Whole = Whole(
        1, bounds=(0, 2**32 - 1), softbounds=(0, 1000), label="Seed", doc="Seed of all random numbers of the run."
    )


class Control(Group):
    """The mirror and the controllers of the closed-loop comparison; the loop's own integrator makes the record."""

    used_when: ClassVar[UsedWhen] = MappingProxyType({"gain": ("integrator", ("manual",))})

    delay: Real = Real(
        2.0,
        bounds=(1.0, 10.0),
        step=0.1,
        label="Delay",
        doc="Steps from a command to the first measurement that sees it, fractions allowed [frames] (paper: 2). The "
        "record has that of the paper.",
    )
    stroke: Real = Real(
        0.0,
        bounds=(0.0, 100.0),
        softbounds=(0.0, 5.0),
        step=0.1,
        label="Stroke limit",
        doc="Maximum command of a mode, either way [um]; 0 is no limit.",
    )
    rate: Real = Real(
        0.0,
        bounds=(0.0, 100.0),
        softbounds=(0.0, 1.0),
        step=0.01,
        label="Rate limit",
        doc="Maximum change of a mode's command [um/ms]; 0 is no limit.",
    )
    integrator: param.Selector[str] = param.Selector(
        default="optimised",
        objects=["optimised", "manual"],
        label="Integrator gain from",
        doc="optimised: optimal gain for the scenario's true spectra, mode by mode; manual: the gain below.",
    )
    gain: Real = Real(
        0.5,
        bounds=(0.0, 5.0),
        softbounds=(0.0, 1.0),
        step=0.01,
        label="Integrator gain",
        doc="g of u[k] = leak u[k-1] - g y[k], for integrator manual. With a delay of two frames stable below 1.",
    )
    leak: Real = Real(1.0, bounds=(0.0, 1.0), step=0.001, label="Integrator leak", doc="1 is a pure integrator.")
    caution: Real = Real(
        1.0,
        bounds=(0.1, 1000.0),
        softbounds=(0.5, 10.0),
        step=0.1,
        label="Caution",
        doc="Factor on the noise that LQG takes measurements to have, where that is not set by hand, and divisor of an "
        "integrator's optimised gain; above 1 a loop bears more errors of the plant.",
    )
    supervised: param.Boolean[bool] = param.Boolean(
        False,
        label="Supervised",
        doc="An integrator closes the loop for 1000 frames, and takes over from every other controller where its loop is worse "
        "than it should be.",
    )
    fallback_gain: Real = Real(
        0.2,
        bounds=(0.0, 5.0),
        softbounds=(0.0, 1.0),
        step=0.01,
        label="Gain of the fallback",
        doc="Gain of that integrator, and of the one with which adaptive controllers begin, of the leak above; stable for every "
        "plant that may come.",
    )
    wavelength: Real = Real(
        2.2, bounds=(0.1, 30.0), step=0.05, label="Science wavelength", doc="Wavelength of the Strehl ratio [um]."
    )
