"""What observers are told of telemetry: an identification, or the file of one, in place of a simulation's settings."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from wfsobs.prior import Bands, Beams, LgsError, Lines, Model, Noise, Part, Prior
from wfsobs.priors_from import scenario as priors
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


KNOWN: tuple[Part, ...] = (Model, Noise, LgsError, Lines, Beams, Bands)
"""What an identification tells."""


def prior_of(identification: Identification, parts: Iterable[Part] = KNOWN, scenario: Scenario | None = None) -> Prior:
    """Return what an identification tells of each of its modes: a prior without a file.

    scenario : where sensors and bands come from, which telemetry does not tell; the defaults unless given
    Raises ValueError for a part that cannot be made from an identification.
    """
    prior, modes = priors.prior_of(told_by(identification, scenario or Scenario()), None, parts), identification.modes
    n, errors = len(modes), [mode.lgs_error for mode in modes]
    lines = tuple(mode.prior for mode in modes) if prior.lines else ()
    lgs_error = tuple(LgsError(e) if e else one for one, e in zip(prior.lgs_error, errors, strict=False))
    beams = tuple(
        replace(one, common=mode.target.turbulence, lgs=(e,) if e else one.lgs)
        for one, mode, e in zip(prior.beams, modes, errors, strict=False)
    )
    whole = {part: getattr(prior, part)[:n] for part in ("model", "noise", "spectra")}
    return replace(prior, lgs_error=lgs_error, lines=lines, beams=beams, **whole)
