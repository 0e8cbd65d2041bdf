"""Handles on the spectra: what of a scenario can be taken hold of in a figure, and the settings that a move of it changes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import pi
from typing import Any

from wfsobs.app.numerals import number
from wfsobs.observers.base import TURBULENCE
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.vibration import Peak
from wfsobs.settings.errors import SettingError
from wfsobs.signal.spectrum import resonance_rms
from wfsobs.simulation.turbulence import turbulence_process

PEAK, MODEL, BAND, CORNER, PROCESS = "peak", "model", "band", "corner", "process"
"""Kinds of handles."""

FAINTEST = 1e-4
"""Strength from which a peak grows that has none in a mode [um]."""

NEW_DAMPING, NEW_RMS = 0.01, 5e-3
"""Damping of a peak that is added, and its rms [um] where no height is given."""


@dataclass(frozen=True)
class Handle:
    """Something to take hold of.

    Attributes
    ----------
    kind : str
        PEAK, MODEL, BAND, CORNER or PROCESS.
    index : int
        Which of its list.
    label : str
        What it is called.
    frequency : float
        Where it is [Hz].
    rms : float or None
        Strength in the mode [um]; None where it has none to change.
    damping : float or None
        Damping; None where it has none to change.
    """

    kind: str
    index: int
    label: str
    frequency: float
    rms: float | None = None
    damping: float | None = None

    @property
    def id(self) -> str:
        """Name in messages."""
        return f"{self.kind}-{self.index}"

    @property
    def text(self) -> str:
        """Its values, for people."""
        strength = "" if self.rms is None else f", {number(1e3 * self.rms)} nm rms"
        return f"{self.frequency:.4g} Hz{strength}" + ("" if self.damping is None else f", damping {self.damping:.3g}")

    def at(self, frequency: float | None = None, strength: float = 1.0, damping: float = 1.0) -> Handle:
        """Return it at another frequency [Hz], its rms and its damping times a factor; what it does not have stays."""
        rms, own = self.rms, self.damping
        return replace(
            self,
            frequency=self.frequency if frequency in (None, self.frequency) else round_off(frequency),
            rms=rms if rms is None or strength == 1.0 else round_off(strength * max(rms, FAINTEST)),
            damping=own if own is None or damping == 1.0 else min(round_off(max(own, 1e-4) * damping), 1.0),
        )


def round_off(x: float) -> float:
    """Return a number with the four digits that a hand can set.

    >>> round_off(28.60612)
    28.61
    """
    return float(f"{x:.4g}")


def handles_of(scenario: Scenario, target: str, mode: int) -> list[Handle]:
    """List the handles of the spectrum of a target, in one mode."""
    return list((_turbulence if target == TURBULENCE else _vibration)(scenario, mode))


def highest_frequency(scenario: Scenario, kind: str) -> float:
    """Return how far a handle of a kind can be moved [Hz]: a peak to the cut-off, above which there is no vibration."""
    nyquist = 0.5 / scenario.dt
    cut_off = kind == PEAK and scenario.vibration.source == "peaks"
    return min(scenario.vibration.cutoff, nyquist) if cut_off else nyquist


def has_peaks(scenario: Scenario) -> bool:
    """Return whether the vibration is made of peaks, so that one can be added."""
    return scenario.vibration.source in ("peaks", "ar2")


def _vibration(s: Scenario, mode: int) -> Iterator[Handle]:
    if has_peaks(s):
        for i, peak in enumerate(s.vibration.peaks):
            rms = peak.rms[mode] if mode < len(peak.rms) else None
            yield Handle(PEAK, i, f"Peak {i + 1}", peak.frequency, rms, peak.damping)
    if s.kalman.peak == "manual":
        rms = s.kalman.vibration_rms if s.kalman.process_noise == "manual" and s.modes[mode].radial_order == 1 else None
        yield Handle(MODEL, 0, "Peak of the Kalman filters", s.kalman.frequency, rms, s.kalman.damping)
    for i, frequency in enumerate(s.butterworth.frequencies):
        yield Handle(BAND, i, f"Band {i + 1}", frequency)


def _turbulence(s: Scenario, mode: int) -> Iterator[Handle]:
    t = s.turbulence
    if t.source == "processes":
        for i, p in enumerate(t.processes):
            yield Handle(PROCESS, i, f"Process {i + 1}", p.frequency, p.rms[mode] if mode < len(p.rms) else None, p.damping)
    elif t.source in ("ar2", "ar3", "frozen-flow"):
        corner = turbulence_process(s, mode, s.dt).omega / (2.0 * pi)
        yield Handle(CORNER, 0, "Corner of the turbulence", corner, None if t.source == "frozen-flow" else t.rms)


def changes_of(scenario: Scenario, target: str, mode: int, to: Handle) -> dict[str, Any]:
    """Return the settings, dotted path -> value, that bring the handle of the same name to where `to` is.

    Raises SettingError where there is no such handle.
    """
    now = next((h for h in handles_of(scenario, target, mode) if h.id == to.id), None)
    if now is None:
        raise SettingError(f"there is no {to.id} to move")
    if to.kind == CORNER:  # a corner goes with the wind
        t = scenario.turbulence
        wind = t.wind_speed if to.frequency == now.frequency else round_off(t.wind_speed * to.frequency / now.frequency)
        values = {"turbulence.wind_speed": wind, "turbulence.rms": to.rms}
        return {path: v for path, v in values.items() if v is not None}
    if to.kind == BAND:
        bands = [*scenario.butterworth.frequencies]
        bands[to.index] = to.frequency
        return {"butterworth.frequencies": bands}
    if to.kind == MODEL:
        values = {"kalman.frequency": to.frequency, "kalman.damping": to.damping, "kalman.vibration_rms": to.rms}
        return {path: v for path, v in values.items() if v is not None}
    where = f"vibration.peaks.{to.index}" if to.kind == PEAK else f"turbulence.processes.{to.index}"
    out: dict[str, Any] = {f"{where}.frequency": to.frequency, f"{where}.damping": to.damping}
    if to.rms is not None:
        rms = [*(scenario.vibration.peaks if to.kind == PEAK else scenario.turbulence.processes)[to.index].rms]
        rms[mode] = to.rms
        out[f"{where}.rms"] = rms
    return out


def with_new_peak(scenario: Scenario, mode: int, frequency: float, height: float | None = None) -> dict[str, Any]:
    """Return the settings with one more peak, at a height of the spectrum [um^2/Hz].

    Raises SettingError where there are no peaks, and above the highest frequency of one.
    """
    if not has_peaks(scenario):
        raise SettingError(f"vibration.source = {scenario.vibration.source} has no peaks of its own: set it to peaks")
    if frequency > (highest := highest_frequency(scenario, PEAK)):
        raise SettingError(f"no peak above the cut-off of the vibration, {highest:g} Hz")
    rms = NEW_RMS if height is None else resonance_rms(height, frequency, NEW_DAMPING)
    strengths = [0.0] * max(mode + 1, 2)
    strengths[mode] = round_off(rms)
    peak = Peak.from_dict({"frequency": round_off(frequency), "damping": NEW_DAMPING, "rms": strengths})
    return {"vibration.peaks": [*(p.to_dict() for p in scenario.vibration.peaks), peak.to_dict()]}


def without_peak(scenario: Scenario, index: int) -> dict[str, Any]:
    """Return the settings without one of the peaks."""
    return {"vibration.peaks": [p.to_dict() for i, p in enumerate(scenario.vibration.peaks) if i != index]}
