"""The tables of docs/higher-orders.md on coupled modes: RMS error of turbulence by radial order: `[seeds] [case ...]`."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from wfsobs import PRESETS, observe, simulate
from wfsobs.evaluation.bound import bound
from wfsobs.scenario import Scenario

OBSERVERS = {"of the LGS": ("kf-lgs", "kf-multi", "kf-coupled"), "of both sensors": ("multirate-multi", "multirate-coupled")}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "axis": ("two LGS on the axis, their mean", {}),
    "slow": ("the same in wind of 5 m/s", {"turbulence.wind_speed": 5.0}),
    "fast": ("the same in wind of 30 m/s", {"turbulence.wind_speed": 30.0}),
}
BOUNDS = {"of the LGS": ("lgs", "modes"), "of both sensors": ("both", "both-modes")}
"""Sensors -> information of each mode by itself, and of all modes together."""


def errors(scenario: Scenario, seeds: int) -> dict[str, np.ndarray]:
    """Observer -> mean square error of each mode's turbulence over the seeds [um^2]."""
    names = [name for of in OBSERVERS.values() for name in of]
    squares: dict[str, list[list[float]]] = {name: [] for name in names}
    for seed in range(1, seeds + 1):
        one = scenario.replace({"run.seed": seed})
        result = observe(simulate(one), one, observers=names)
        for name in names:
            squares[name].append([s.rms**2 for s in result.scores if (s.observer, s.target) == (name, "turbulence")])
    return {name: np.mean(values, axis=0) for name, values in squares.items()}


def tables(changes: dict[str, Any], seeds: int) -> str:
    """Errors and bounds [nm], of the LGS and of both sensors."""
    scenario = PRESETS["higher-orders"]().replace(changes)
    found, out = errors(scenario, seeds), []
    orders = np.array([mode.radial_order for mode in scenario.modes])
    for sensors, (alone, together) in BOUNDS.items():
        columns = {f"`{name}`": found[name] for name in OBSERVERS[sensors]}
        for title, information in (("each mode by itself", alone), ("modes together", together)):
            least = bound(scenario, information=information)
            columns[f"Bound, {title}"] = np.array([one["turbulence"].rms ** 2 for one in least])
        out += [f"| Radial order, {sensors} | {' | '.join(columns)} |", "|---" * (1 + len(columns)) + "|"]
        for n in sorted(set(orders)):
            out.append(f"| {n} | {' | '.join(f'{1e3 * np.sqrt(x[orders == n].mean()):.1f}' for x in columns.values())} |")
        out.append("")
    return "\n".join(out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", type=int, nargs="?", default=10)
    parser.add_argument("cases", nargs="*", default=list(CASES))
    given = parser.parse_args()
    for case in given.cases:
        name, changes = CASES[case]
        print(f"{name[0].upper()}{name[1:]}:\n\n{tables(changes, given.seeds)}", flush=True)
