"""A controller's design written for a program elsewhere."""

from __future__ import annotations

from pathlib import Path

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.handover.arrays import write_control, write_mat, write_npz
from wfsobs.handover.c99 import write_c99
from wfsobs.handover.linear import linear_design
from wfsobs.handover.simulators import write_compass, write_specula
from wfsobs.handover.vectors import make_vectors
from wfsobs.priors_from.controllers import own_settings, plant_of
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.signal.gate import GateSettings
from wfsobs.stepping import prior_in, sampling_of

FORMATS = ("c99", "compass", "control", "mat", "npz", "specula")
"""What a design can be written as."""

ARRAYS = {"compass": write_compass, "control": write_control, "mat": write_mat, "npz": write_npz, "specula": write_specula}


def write_design(name: str, scenario: Scenario, form: str, path: str | Path) -> None:
    """Write a controller of a scenario.

    Parameters
    ----------
    name : str
        Id of the controller.
    scenario : Scenario
        What it is told, its settings, and the loop.
    form : str
        One of `FORMATS`.
    path : str or Path
        File, or for c99 a new directory.

    Raises
    ------
    SettingError
        No such controller or format.
    StepError
        The format cannot hold the controller.
    OSError
        The file cannot be written.
    """
    if name not in CONTROLLERS:
        raise SettingError(f"controller {name!r}: no such controller; there are {', '.join(CONTROLLERS)}")
    if form not in FORMATS:
        raise SettingError(f"--to {form}: takes one of {', '.join(FORMATS)}")
    controller, sampling, plant = CONTROLLERS[name], sampling_of(scenario), plant_of(scenario)
    groups = own_settings(controller, scenario)
    prior = prior_in(name, scenario, controller.parts(groups), scenario, sampling, None)
    linear = linear_design(controller.design(prior, plant, groups, sampling))
    if form == "c99":
        gate = GateSettings(scenario.sensors.gate_level)
        write_c99(path, linear, make_vectors(controller, prior, plant, groups, sampling, gate), gate)
    else:
        ARRAYS[form](path, linear)
