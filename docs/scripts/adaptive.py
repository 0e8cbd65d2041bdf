"""The adaptive Kalman filter's figures in docs/model.md: its error beside filters that are told more, and after a jump of a
peak by 3 Hz. `adaptive.py [seeds]`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from wfsobs import PRESETS, Record, Scenario, simulate
from wfsobs.execution import run_observer

KNOWING, NAMES = "kf-multi", ("kf-adaptive", "kf-multi", "kf-lgs")
CASES = (("paper", 4.0), ("strong-turbulence", 4.0), ("ut4", 4.0), ("ut4", 8.0))
"""Preset, window [s]."""
DURATION, START = 24.0, 8.5
JUMP, WHEN = 3.0, 12.0
"""[Hz], [s]."""
PEAK: dict[str, Any] = {"frequency": 47.44, "damping": 0.004, "rms": [0.02, 0.02]}


def errors(scenario: Scenario, name: str, record: Record, target: str) -> np.ndarray:
    """Estimate minus truth, (n_steps, n_modes) [um]."""
    truth = record.truth(target)
    assert truth is not None
    return run_observer(name, record, scenario)[target] - truth


def rms(x: np.ndarray) -> np.ndarray:
    """Of every column."""
    return np.sqrt(np.mean(x**2, axis=0))


def records(scenario: Scenario, seeds: int) -> Iterator[tuple[Scenario, Record]]:
    """One of every seed."""
    for seed in range(1, seeds + 1):
        s = scenario.replace({"run.seed": seed, "run.duration": DURATION})
        yield s, simulate(s)


def against_knowledge(seeds: int) -> None:
    """Errors over those of the filter that knows all lines, median and largest of seeds and modes."""
    print("| Preset, window | vibration, `kf-adaptive` | `kf-lgs` | turbulence, `kf-adaptive` | `kf-lgs` |\n" + 5 * "|---" + "|")
    for preset, window in CASES:
        found: dict[tuple[str, str], list[np.ndarray]] = {}
        for s, record in records(PRESETS[preset]().replace({"adaptive.window": window}), seeds):
            for target in ("vibration", "turbulence"):
                error = {name: rms(errors(s, name, record, target)[round(START / s.dt) :]) for name in NAMES}
                for name in NAMES:
                    found.setdefault((target, name), []).append(error[name] / error[KNOWING])
        cells = [f"{np.median(x):.2f} ({np.max(x):.2f})" for (_, name), x in found.items() if name != KNOWING]
        print(f"| `{preset}`, {window:g} s | " + " | ".join(cells) + " |")


def after_a_jump(seeds: int) -> None:
    """Rms of the error of the vibration over half seconds, all seeds and modes together, over that before the jump."""
    s = PRESETS["paper"]().replace(
        {
            "vibration.source": "ar2",
            "vibration.peaks": [PEAK],
            "kalman.process_noise": "matched",
            "kalman.frequency": PEAK["frequency"],
            "kalman.damping": PEAK["damping"],
            "events": [{"kind": "peak", "peak": 0, "start": WHEN, "frequency_shift": JUMP}],
        }
    )
    squares: dict[str, list[np.ndarray]] = {name: [] for name in NAMES}
    for its, record in records(s, seeds):
        for name in NAMES:
            error = errors(its, name, record, "vibration")
            squares[name].append((error**2).mean(axis=1).reshape(-1, round(0.5 / its.dt)).mean(axis=1))
    print("\n| Seconds after the jump | " + " | ".join(f"`{name}`" for name in NAMES) + " |\n|---" + "|---" * len(NAMES) + "|")
    at = 2 * round(WHEN)
    mean = {name: np.mean(x, axis=0) for name, x in squares.items()}
    for first, last in ((0, 1), (1, 2), (2, 3), (3, 4), (4, 4.5), (4.5, 6), (6, 12)):
        part = slice(at + round(2 * first), at + round(2 * last))
        cells = [f"{np.sqrt(m[part].mean() / m[2 * round(START) - 7 : at].mean()):.2f}" for m in mean.values()]
        print(f"| {first:g} to {last:g} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    against_knowledge(count)
    after_a_jump(2 * count)
