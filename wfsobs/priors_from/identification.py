"""What observers are told of telemetry: the file of an identification in place of a simulation's settings."""

from __future__ import annotations

from wfsobs.scenario import Scenario

FOUND = ("telescope", "turbulence", "vibration", "sensors", "kalman", "butterworth")
"""Groups of settings of which priors are made."""


def told_by(found: Scenario, scenario: Scenario) -> Scenario:
    """Return a scenario with the models of an identification, and all other settings of `scenario`.

    found : the file of `wfsobs identify --out` (`Identification.scenario`)
    """
    out = scenario.before_events.copy()
    for group in FOUND:
        setattr(out, group, getattr(found, group).copy())
    out.kalman.ngs_between_frames = scenario.kalman.ngs_between_frames  # what a filter does, not what it is told
    return out
