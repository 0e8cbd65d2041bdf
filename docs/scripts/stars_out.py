"""The table of docs/observers.md on stars that are out, RMS errors [nm], tip / tilt: `docs/scripts/stars_out.py [seeds]`."""

from __future__ import annotations

import sys

import numpy as np

from wfsobs import PRESETS, simulate
from wfsobs.execution import run_observer
from wfsobs.observers.base import TARGETS
from wfsobs.scenario import Scenario

OBSERVERS = ("multirate-multi", "kf-asterism")
GAP = (1.0, 2.0)
"""From when to when stars are out [s]."""
LAYERS = [
    {"height": 0.0, "fraction": 0.5, "wind_direction": 0.0},
    {"height": 6000.0, "fraction": 0.5, "wind_direction": 70.0, "wind_factor": 1.5},
]
STARS = {
    "turbulence.source": "frozen-flow",
    "turbulence.layers": LAYERS,
    "turbulence.outer_scale": 10.0,
    "turbulence.wind_speed": 20.0,
    "sensors.kind": "zernike",
    "sensors.lgs_count": 3,
    "sensors.lgs_radius": 20.0,
    "vibration.source": "ar2",
    "vibration.peaks": [{"frequency": 31.0, "damping": 0.02, "rms": [0.05, 0.04]}],
    "kalman.process_noise": "matched",
    "kalman.measurement_noise": "matched",
    "run.duration": 3.0,
    "run.warm_up": 0.5,
}
"""Changes of `paper`: three LGS far from the axis, two layers, one broad line."""


def errors(scenario: Scenario, lasers: int, seeds: int) -> dict[str, list[str]]:
    """Observer -> turbulence and vibration, tip / tilt, while so many lasers are out."""
    start, end = GAP
    events = [{"kind": "laser", "start": start, "duration": end - start, "lasers": lasers}] if lasers else []
    squares: dict[tuple[str, str], list[np.ndarray]] = {(name, target): [] for name in OBSERVERS for target in TARGETS}
    cut = slice(round(start / scenario.dt), round(end / scenario.dt))
    for seed in range(1, seeds + 1):
        one = scenario.replace({"run.seed": seed, "events": events})
        record = simulate(one)
        for name in OBSERVERS:
            found = run_observer(name, record, one.before_events)
            for target in TARGETS:
                squares[name, target].append(np.mean((found[target] - record.truth(target))[cut] ** 2, axis=0))
    rms = {key: 1e3 * np.sqrt(np.mean(values, axis=0)) for key, values in squares.items()}
    return {name: [" / ".join(f"{x:.1f}" for x in rms[name, target]) for target in TARGETS] for name in OBSERVERS}


if __name__ == "__main__":
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 8
    found = [errors(PRESETS["paper"]().replace(STARS), lasers, seeds) for lasers in range(4)]
    for name in OBSERVERS:
        print(f"| {name} | {' | '.join(one[name][i] for i in range(len(TARGETS)) for one in found)} |")
