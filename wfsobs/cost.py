"""Estimates of the computing time and memory of a run, from its settings.

Measured as processor time on the machine of docs/benchmarks.md (2 virtual cores of an AMD EPYC, one BLAS thread),
10 s to 300 s of record, m from 20 to 2048, d from 20 to 2000; there a run of the paper's takes 0.62 s without the adaptive
GPR, the estimate is 0.69 s.
The depth and the exposure ratio cost next to nothing. Modes run side by side on two cores, except those of the adaptive filter,
whose steps are too small for that. A busy machine takes two to three times as long: the estimate only tells a
moment from a wait.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from wfsobs.atmosphere import FIELD
from wfsobs.dependence import observers_reached
from wfsobs.observers import OBSERVERS
from wfsobs.observers.gpr.windows import AT_ONCE
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import TRAINING_MARGIN

REST = "rest"
"""What is not one of the observers whose time is estimated by itself."""


def run_seconds(scenario: Scenario, observers: Sequence[str] | None = None) -> float:
    """Estimate the time of simulation, every observer or these ids, and the scores [s].

    >>> from wfsobs.scenario.presets import paper
    >>> round(run_seconds(paper()), 1), round(run_seconds(paper().replace({"run.duration": 300})))
    (1.2, 47)
    """
    return sum(
        seconds for part, seconds in part_seconds(scenario).items() if part == REST or observers is None or part in observers
    )


def rerun_seconds(before: Scenario, now: Scenario) -> float:
    """Estimate the time of a run where the results of other settings are known [s].

    >>> from wfsobs.scenario.presets import paper
    >>> round(rerun_seconds(paper(), paper().replace({"multipeak.line_width": 0.5})), 1)
    0.0
    """
    reached, parts = observers_reached(before, now), part_seconds(now)
    return float(sum(seconds for name, seconds in parts.items() if reached is None or name in reached))


def part_seconds(scenario: Scenario) -> dict[str, float]:
    """Estimate the parts of `run_seconds` [s]: the two GPR, the adaptive filter, and all else as REST."""
    n, n_modes, offline = scenario.n_steps, len(scenario.modes), scenario.gpr_offline
    training = offline.depth + offline.training_size + round(TRAINING_MARGIN * scenario.sensors.lgs_rate)
    air = _steps_of_air(scenario)
    return {
        **{
            o.id: _observer_seconds(o.seconds, None if o.group is None else getattr(scenario, o.group), n, n_modes, scenario.dt)
            for o in OBSERVERS.values()
            if o.seconds is not None
        },
        REST: 2.5e-6 * n_modes * (n + training) + frozen_flow_seconds(scenario, air + training),
    }


def _observer_seconds(estimate: Callable[..., float], *of: Any) -> float:
    """Return the time of an observer of any package [s]; none where it cannot tell, as the limit of time holds all the same."""
    try:
        seconds = float(estimate(*of))
    except Exception:
        return 0.0
    return seconds if seconds >= 0.0 else 0.0


def _steps_of_air(scenario: Scenario) -> int:
    """Return the number of steps of turbulence, at least those of the record."""
    return max(scenario.n_steps, round(scenario.turbulence_duration * scenario.sensors.lgs_rate))


def frozen_flow_seconds(scenario: Scenario, n_steps: int) -> float:
    """Estimate the time of frozen flow and its sensors [s]; zero for other sources.

    For every aperture's width of a layer and every beam, 3 ms and 0.3 ms for each mode, and a tenth of that through ideal
    sensors. Where stars may be far apart against the aperture, waves are closer.
    """
    t, s = scenario.turbulence, scenario.sensors
    if t.source != "frozen-flow":
        return 0.0
    duration, diameter = n_steps / s.lgs_rate, scenario.telescope.diameter
    widths = sum(
        (1.0 + duration * t.wind_speed * layer.wind_factor / diameter) * 0.5 * (1.0 + FIELD * layer.height / diameter)
        for layer in t.layers
    )
    beams = 2 + (s.lgs_count if s.lgs_radius > 0 else 1)
    finest = max(40, s.lenslets.lgs_subapertures, s.lenslets.ngs_subapertures)
    each = 0.1 if s.kind == "zernike" else (finest / 40) ** 2
    return each * widths * beams * (2.8e-3 + 0.26e-3 * len(scenario.modes))


def run_bytes(scenario: Scenario) -> float:
    """Estimate the peak memory of a run [bytes], both modes at once.

    Measured from 10 s to 300 s of record and m from 20 to 2048, where it is within a third: the data of every
    step, additional turbulence for a growing wind, and the windows of the larger GPR, or the waves of frozen flow in
    progress.

    >>> from wfsobs.scenario.presets import paper
    >>> round(run_bytes(paper()) / 1e6), round(run_bytes(paper().replace({"run.duration": 300})) / 1e6)
    (108, 282)
    """
    n_modes = len(scenario.modes)
    windows = max(100e3 * scenario.gpr_online.training_size, 35e3 * scenario.gpr_offline.training_size)
    waves = 0.0
    if scenario.turbulence.source == "frozen-flow":
        waves = 20e6 * (n_modes if scenario.sensors.kind == "shack-hartmann" else 1)
    kept = 300.0 * scenario.n_steps + 140.0 * (_steps_of_air(scenario) - scenario.n_steps)
    return n_modes * kept + max(min(n_modes, AT_ONCE) * windows, waves)
