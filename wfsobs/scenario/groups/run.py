"""Settings of the loop and of the run."""

from __future__ import annotations

from types import MappingProxyType

import param

from wfsobs.settings.group import Group
from wfsobs.settings.parameters import Real, Whole


class Loop(Group):
    """The control loop that makes the record."""

    used_when = MappingProxyType({"gain": ("closed", (True,)), "leak": ("closed", (True,))})

    closed = param.Boolean(True, label="Closed loop", doc="Drive the deformable mirror; off keeps u = 0.")
    gain = Real(
        0.3,
        bounds=(0.0, 1.0),
        inclusive_bounds=(True, False),
        step=0.01,
        label="Integrator gain g",
        doc="u[k] = leak u[k-1] - g y_lgs[k]; not given in the paper. Stable below 1.",
    )
    leak = Real(1.0, bounds=(0.0, 1.0), step=0.001, label="Integrator leak", doc="1 is a pure integrator.")


class Run(Group):
    """Length of the record, what is scored, and the seed."""

    duration = Real(10.0, bounds=(0.1, 3600.0), softbounds=(2.0, 60.0), label="Duration", doc="Length of the record [s].")
    warm_up = Real(
        1.0, bounds=(0.0, 600.0), softbounds=(0.0, 5.0), label="Warm-up", doc="Start of the record that no score counts [s]."
    )
    seed = Whole(1, bounds=(0, 2**32 - 1), softbounds=(0, 1000), label="Seed", doc="Seed of all random numbers of the run.")
