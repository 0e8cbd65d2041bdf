"""The tables of docs/higher-orders.md: RMS error of turbulence by radial order, preset `higher-orders`, ten seeds."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from wfsobs import PRESETS, observe, simulate

SEEDS = range(1, 11)
OBSERVERS = {
    "kf-lgs": "LGS KF",
    "kf-ngs": "NGS KF",
    "multirate": "Multi-rate KF",
    "multirate-optimal": "Optimal multi-rate KF",
    "zero": "Zero",
}
CASES: dict[str, dict[str, Any]] = {
    "two LGS on the axis, their mean": {},
    'four LGS at 17.5", their mean': {"sensors.lgs_count": 4, "sensors.lgs_radius": 17.5},
    'four LGS at 17.5", minimum variance': {
        "sensors.lgs_count": 4,
        "sensors.lgs_radius": 17.5,
        "sensors.lgs_combination": "minimum-variance",
    },
    "two LGS on the axis, NGS noise 50 nm": {"sensors.ngs_noise": 0.05},
    "two LGS on the axis, AR(2) turbulence": {"turbulence.source": "ar2"},
}


def errors(changes: dict[str, Any]) -> dict[tuple[int, str], float]:
    """(radial order, observer) -> rms error of turbulence [nm] over the modes of that order and the seeds."""
    squares = defaultdict(list)
    for seed in SEEDS:
        scenario = PRESETS["higher-orders"]().replace({**changes, "run.seed": seed})
        orders = {mode.name: mode.radial_order for mode in scenario.modes}
        for score in observe(simulate(scenario), scenario, observers=list(OBSERVERS)).scores:  # run has the bounds, too
            if score.target == "turbulence" and score.observer in OBSERVERS:
                squares[orders[score.mode], score.observer].append((1e3 * score.rms) ** 2)
    return {key: float(np.sqrt(np.mean(values))) for key, values in squares.items()}


def table(changes: dict[str, Any]) -> str:
    """The errors as a table."""
    found = errors(changes)
    head = ["Radial order", *OBSERVERS.values()]
    rows = [f"| {n} | " + " | ".join(f"{found[n, o]:.1f}" for o in OBSERVERS) + " |" for n in sorted({n for n, _ in found})]
    return "\n".join([f"| {' | '.join(head)} |", "|---" * len(head) + "|", *rows])


if __name__ == "__main__":
    for name, changes in CASES.items():
        print(f"{name[0].upper()}{name[1:]}:\n\n{table(changes)}\n", flush=True)
