"""What the last minute of a live loop says of itself: noise, turbulence, peaks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from wfsobs.evaluation.bound import bound_rms
from wfsobs.evaluation.bound_both import bound_rms_of_both
from wfsobs.evaluation.scores import BOUND, BOUND_BOTH
from wfsobs.identification import identify
from wfsobs.live.spectrum_of_minute import MinuteSpectrum, spectrum_of
from wfsobs.priors_from.identification import told_by
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.true_spectra import has_known_spectra

Bounds = Mapping[str, Mapping[str, list[float]]]
"""Bound -> target -> rms of every mode [um]."""


@dataclass(frozen=True)
class PeakFinding:
    """A peak: frequency [Hz] and its standard deviation, damping, rms [um]."""

    frequency: float
    frequency_std: float
    damping: float
    rms: float


@dataclass(frozen=True)
class Finding:
    """An identification as another process gives it.

    peaks    : of all modes together
    noise    : of the measurement, per mode [um]
    settings : of the scenario with the models that were found
    spectrum : of the measurement; None where too much of it is missing
    """

    peaks: tuple[PeakFinding, ...]
    noise: tuple[float, ...]
    settings: dict[str, Any]
    spectrum: MinuteSpectrum | None = None


def identify_frames(record: Record, settings: dict[str, Any]) -> Finding:
    """Identify a record; settings : of what is not identified. Raises RecordError."""
    result = identify(record)
    peaks = [
        PeakFinding(p.frequency.value, p.frequency.std, p.damping.value, max(n.value for n in p.rms if n is not None))
        for p in result.peaks
    ]
    told = told_by(result, Scenario.from_dict(settings))
    noise = tuple(mode.noise.value for mode in result.modes)
    return Finding(tuple(peaks), noise, told.to_dict(), spectrum_of(record.z, record.dt))


def bounds_of(settings: dict[str, Any]) -> dict[str, dict[str, list[float]]]:
    """Return bound -> target -> rms of every mode [um]; without those of spectra that are not known."""
    scenario = Scenario.from_dict(settings)
    if not has_known_spectra(scenario):
        return {}
    out: dict[str, dict[str, list[float]]] = {}
    for bound, rms_of in ((BOUND, bound_rms), (BOUND_BOTH, bound_rms_of_both)):
        modes = [rms_of(scenario, mode) for mode in range(len(scenario.modes))]
        out[bound] = {target: [one[target] for one in modes] for target in modes[0]}
    return out
