"""Settings of a scenario that have no effect for the values of the others, and why.

Rules within a group are declared by the group (`Group.used_when`); here are those across groups.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from wfsobs.scenario.scenario import Scenario
from wfsobs.settings.group import Group
from wfsobs.settings.tree import Plain

FLOW_ONLY = (
    "telescope.zenith_angle",
    "sensors.kind",
    "sensors.lgs_altitude",
    "sensors.lgs_radius",
    "sensors.lgs_angle",
    "sensors.ngs_direction",
)
"""Settings of frozen flow, outside the group of the turbulence."""

SIMULATION_ONLY = ("loop", "events", "run.seed")
"""Settings that only the simulation of a record reads."""

RECORD_ONLY = ("sensors.gate", "sensors.gate_level")
"""Settings that no simulation of a record reads."""


def idle_settings(scenario: Scenario, *, is_simulated: bool = True) -> dict[str, str]:
    """Return the settings without effect.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    is_simulated : bool
        Whether the record is simulated from them; otherwise it is given.

    Returns
    -------
    dict of str to str
        Dotted path of a setting, a list or a group -> reason in one line. What is below a path has no effect either.

    Examples
    --------
    >>> idle_settings(Scenario())["gpr_online.highpass"]
    'Used only where Filter of the inputs is high-pass'
    """
    out = dict(_within(scenario, "")) | dict(_across(scenario))
    if is_simulated:
        out |= dict.fromkeys(RECORD_ONLY, "Used only with a record that is given; a simulated one has no outliers")
    else:
        out |= dict.fromkeys(SIMULATION_ONLY, "Used only by a simulation; here the record is given")
    return out


def why_idle_at(path: str, idle: Mapping[str, str]) -> str:
    """Return why the setting of a dotted path has no effect, by `idle_settings`; empty where it has one."""
    keys = path.split(".")
    return next((idle[above] for i in range(len(keys)) if (above := ".".join(keys[: i + 1])) in idle), "")


def used_settings(scenario: Scenario) -> Plain:
    """Return the settings that have an effect, as nested plain values."""
    tree = scenario.effective_values()
    for path in (*RECORD_ONLY, *(path for path, _ in _across(scenario))):
        *above, name = path.split(".")
        node: Any = tree
        for key in above:
            node = node[int(key)] if isinstance(node, list) else node.get(key, {})
        node.pop(name, None)
    return tree


def _within(group: Group, prefix: str) -> Iterator[tuple[str, str]]:
    """Yield the idle settings of a group and of the groups and lists in it, by their own rules."""
    idle = group.idle()
    yield from ((f"{prefix}{name}", reason) for name, reason in idle.items())
    for name in group.settings():
        value = getattr(group, name)
        if name in idle:
            continue
        if isinstance(value, Group):
            yield from _within(value, f"{prefix}{name}.")
        elif isinstance(value, list):
            for i, item in enumerate(value):
                if isinstance(item, Group):
                    yield from _within(item, f"{prefix}{name}.{i}.")


def _across(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """Yield the idle settings by rules across groups."""
    s, flow = scenario.sensors, scenario.turbulence.source == "frozen-flow"
    if not flow:
        yield from ((path, "Used only where Source of turbulence is frozen-flow") for path in FLOW_ONLY)
        if scenario.telescope.radial_order == 1:
            yield "turbulence.outer_scale", "Used only with frozen flow, and for radial orders above 1"
    else:
        yield "sensors.lgs_low_frequency_rms", "Used only where Source of turbulence is not frozen-flow"
        if len(scenario.turbulence.layers) == 1:
            yield "turbulence.layers.0.fraction", "Used only where there are several layers: they share the turbulence"
        if s.lgs_radius == 0:
            yield "sensors.lgs_angle", "Used only where LGS asterism, radius is above 0"
    if scenario.turbulence.source == "none":
        yield "sensors.tip_tilt_indetermination", "Used only where there is turbulence"
    if scenario.plant.mount == "custom" and not scenario.plant.resonance:
        yield "plant.damping", "Used only where Resonance is above 0"
    if not scenario.plant.hysteresis:
        yield "plant.hysteresis_range", "Used only where Hysteresis is above 0"
    if not scenario.plant.optical_gain_rms:
        yield "plant.optical_gain_time", "Used only where Optical gain, rms is above 0"
    if s.noise_from == "nm" and not (flow and s.kind == "shack-hartmann"):
        yield "sensors.lenslets", "Used only by Shack-Hartmann sensors in frozen flow, and for noise from photons"
    if scenario.kalman.peak == "matched" and _every_mode_has_a_line(scenario):
        yield "kalman.frequency", "Used only where Vibration peak is manual, or a mode has no line"
        yield "kalman.damping", "Used only where Vibration peak is manual, or a mode has no line"


def _every_mode_has_a_line(scenario: Scenario) -> bool:
    """Return whether a list of peaks gives every mode a line; for other sources False."""
    v = scenario.vibration
    if v.source not in ("peaks", "ar2"):
        return False
    found = [peak.rms for peak in v.peaks if v.source == "ar2" or peak.frequency <= v.cutoff]
    return all(any(i < len(rms) and rms[i] > 0 for rms in found) for i in range(len(scenario.modes)))
