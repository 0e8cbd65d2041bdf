"""The tables of docs/higher-orders.md on coupled modes: RMS error of turbulence by radial order, ten seeds."""

from __future__ import annotations

from typing import Any

import numpy as np

from wfsobs import PRESETS, observe, simulate
from wfsobs.evaluation.bound import bound_rms
from wfsobs.evaluation.bound_modes import bound_rms_of_modes
from wfsobs.scenario import Scenario

SEEDS = range(1, 11)
OBSERVERS = ("kf-lgs", "kf-multi", "kf-coupled")
CASES: dict[str, dict[str, Any]] = {
    "two LGS on the axis, their mean": {},
    "the same in wind of 5 m/s": {"turbulence.wind_speed": 5.0},
    "the same in wind of 30 m/s": {"turbulence.wind_speed": 30.0},
}


def errors(scenario: Scenario) -> dict[str, np.ndarray]:
    """Observer -> mean square error of each mode's turbulence over the seeds [um^2]."""
    squares: dict[str, list[list[float]]] = {name: [] for name in OBSERVERS}
    for seed in SEEDS:
        one = scenario.replace({"run.seed": seed})
        result = observe(simulate(one), one, observers=OBSERVERS)
        for name in OBSERVERS:
            squares[name].append([s.rms**2 for s in result.scores if (s.observer, s.target) == (name, "turbulence")])
    return {name: np.mean(values, axis=0) for name, values in squares.items()}


def table(changes: dict[str, Any]) -> str:
    """Errors and bounds [nm]."""
    scenario = PRESETS["higher-orders"]().replace(changes)
    columns = errors(scenario)
    columns["Bound, each mode by itself"] = np.array(
        [bound_rms(scenario, i)["turbulence"] ** 2 for i in range(len(scenario.modes))]
    )
    columns["Bound, modes together"] = np.array([one["turbulence"] ** 2 for one in bound_rms_of_modes(scenario)])
    orders = np.array([mode.radial_order for mode in scenario.modes])
    lines = [f"| {' | '.join(['Radial order', *(f'`{c}`' if c in OBSERVERS else c for c in columns)])} |", "|---" * 6 + "|"]
    rows = {n: [f"{1e3 * np.sqrt(x[orders == n].mean()):.1f}" for x in columns.values()] for n in sorted(set(orders))}
    return "\n".join([*lines, *(f"| {n} | {' | '.join(row)} |" for n, row in rows.items())])


if __name__ == "__main__":
    for name, changes in CASES.items():
        print(f"{name[0].upper()}{name[1:]}:\n\n{table(changes)}\n", flush=True)
