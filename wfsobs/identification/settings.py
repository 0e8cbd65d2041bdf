"""The settings of a scenario that state an identification, mode by mode."""

from __future__ import annotations

from collections.abc import Sequence
from math import pi, sqrt
from typing import Any

from wfsobs.prior import Lines
from wfsobs.scenario import Scenario
from wfsobs.sensors.modes import order_of
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3

HIGHEST, LARGEST, LEAST = 50_000.0, 1e4, 1e-6
"""Limits of a scenario's settings: frequency of a peak [Hz], rms [um], minimum damping of a process."""
MATCHED: dict[str, Any] = {
    "sensors.noise_from": "nm",
    "sensors.lgs_combination": "mean",
    "sensors.tip_tilt_indetermination": False,
    "kalman.process_noise": "matched",
    "kalman.measurement_noise": "matched",
    "kalman.peak": "matched",
}
"""Settings by which filters take the models as they are told."""
WIDTHS = ("bandwidth_offline", "bandwidth_online")


def base_scenario(n_modes: int, dt: float, base: Scenario | None) -> Scenario:
    """Return a scenario for telemetry of so many modes at steps of dt [s], without events, which name peaks by their number."""
    changes = {"telescope.radial_order": order_of(n_modes), "sensors.lgs_rate": 1.0 / dt}
    out = (base or Scenario()).before_events.replace(changes)
    return out.replace(band_settings(out, 0.5 / dt))


def model_settings(priors: Sequence[Lines], scenario: Scenario) -> dict[str, Any]:
    """Return dotted path -> value of the settings that give the filters these models, one per mode.

    For sensors as in the scenario. No two modes share a process or a peak: they stay as different as their numbers are.
    """
    modes = len(priors)
    smooth = [_process(p, _alone(p.rms, i, modes)) for i, prior in enumerate(priors) for p in prior.turbulence]
    lines = sorted((line, i) for i, prior in enumerate(priors) for line in prior.lines)
    peaks = [{"frequency": line.frequency, "damping": line.damping, "rms": _alone(line.rms, i, modes)} for line, i in lines]
    changes: dict[str, Any] = {
        "turbulence.source": "processes" if smooth else "none",
        "turbulence.processes": smooth,
        "vibration.source": "peaks" if peaks else "none",
        "vibration.peaks": peaks,
        "sensors.lgs_noise_per_mode": [min(p.noise * sqrt(scenario.sensors.lgs_count), LARGEST) for p in priors],
    }
    if lines:
        strongest, highest = max((line for line, _ in lines), key=lambda line: line.rms), lines[-1][0].frequency
        changes |= {
            "vibration.cutoff": min(max(scenario.vibration.cutoff, 1.2 * highest), HIGHEST),
            "kalman.frequency": strongest.frequency,
            "kalman.damping": strongest.damping,
        }
    return changes


def band_settings(scenario: Scenario, nyquist: float) -> dict[str, Any]:
    """Return dotted path -> value of the settings of bands, without those above half the rate [Hz].

    Where none remains there is one in the middle.
    """
    b = scenario.butterworth
    widest = 0.5 * max(b.bandwidth_offline, b.bandwidth_online)
    inside = [f for f in b.frequencies if widest < f < nyquist - widest]
    changes: dict[str, Any] = {} if inside == b.frequencies else {"butterworth.frequencies": inside or [0.5 * nyquist]}
    if not inside:
        changes |= {f"butterworth.{name}": min(getattr(b, name), 0.5 * nyquist) for name in WIDTHS}
    if scenario.kalman.frequency >= nyquist:
        changes["kalman.frequency"] = 0.5 * nyquist
    return changes


def _process(p: Ar2 | Ar3, rms: list[float]) -> dict[str, Any]:
    return {
        "frequency": p.omega / (2 * pi),
        "damping": max(p.damping, LEAST),
        "rms": rms,
        "third_corner": p.corner / p.omega if isinstance(p, Ar3) else 0.0,
    }


def _alone(rms: float, mode: int, modes: int) -> list[float]:
    """Return the strength per mode of a process of one mode."""
    return [min(rms, LARGEST) if i == mode else 0.0 for i in range(modes)]
