"""What observers are told of telemetry: an identification, or the file of one, in place of a simulation's settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from wfsobs.scenario import Scenario

if TYPE_CHECKING:
    from wfsobs.identification.result import Identification

FOUND = ("telescope", "turbulence", "vibration", "sensors", "kalman", "butterworth")
"""Groups of settings of which priors are made."""


def told_by(model: Scenario | Identification, scenario: Scenario) -> Scenario:
    """Return a scenario with the models of an identification, and all other settings of `scenario`.

    model : an identification, or the file of one (`wfsobs identify --out`)
    """
    if not isinstance(model, Scenario):
        model = model.scenario(scenario)
    out = scenario.before_events.copy()
    for group in FOUND:
        setattr(out, group, getattr(model, group).copy())
    out.kalman.ngs_between_frames = scenario.kalman.ngs_between_frames  # what a filter does, not what it is told
    return out
