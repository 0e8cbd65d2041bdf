"""The table of docs/observers.md on every star by itself: RMS errors and bounds [nm], ten seeds, tip / tilt."""

from __future__ import annotations

import numpy as np

from wfsobs import PRESETS, observe, simulate
from wfsobs.evaluation.bound import bound
from wfsobs.scenario import Scenario

SEEDS = range(1, 11)
OBSERVERS = ("multirate-multi", "gp-both", "kf-asterism")
TARGETS = ("turbulence", "vibration", "total")
KINDS = {"ideal sensors": "zernike", "lenslets": "shack-hartmann"}


def errors(scenario: Scenario) -> dict[str, dict[str, list[float]]]:
    """Observer -> target -> rms of each mode over the seeds, after the warm-up [um]."""
    squares: dict[tuple[str, str], list[np.ndarray]] = {(name, target): [] for name in OBSERVERS for target in TARGETS}
    for seed in SEEDS:
        one = scenario.replace({"run.seed": seed})
        record = simulate(one)
        result, start = observe(record, one, observers=OBSERVERS), round(one.run.warm_up / record.dt)
        for name in OBSERVERS:
            parts = {t: result.estimate(name, t).values - record.truth(t) for t in TARGETS[:2]}
            parts["total"] = parts["turbulence"] + parts["vibration"]
            for target, error in parts.items():
                squares[name, target].append(np.mean(error[start:] ** 2, axis=0))
    return {name: {t: np.sqrt(np.mean(squares[name, t], axis=0)).tolist() for t in TARGETS} for name in OBSERVERS}


def bounds(scenario: Scenario) -> dict[str, dict[str, list[float]]]:
    """Bound -> target -> rms of each mode [um]."""
    rows = {"bound-both": "both", "bound-stars": "stars", "Bound, stars and modes together": "asterism"}
    found = {name: bound(scenario, information=information) for name, information in rows.items()}
    return {name: {t: [one[t].rms for one in by_mode] for t in TARGETS} for name, by_mode in found.items()}


def table(preset: str, kind: str) -> str:
    """Rows of one preset."""
    scenario = PRESETS[preset]().replace({"sensors.kind": KINDS[kind]})
    rows = errors(scenario) | bounds(scenario)
    text = [
        f"| {name} | {' | '.join(' / '.join(f'{1e3 * x:.1f}' for x in values[t]) for t in TARGETS)} |"
        for name, values in rows.items()
    ]
    return "\n".join([f"{preset}, {kind}:\n", "| | Turbulence | Vibration | Both |", "|---|---|---|---|", *text, ""])


if __name__ == "__main__":
    for kind in KINDS:
        for preset in ("galacsi-nfm", "galacsi-wfm"):
            print(table(preset, kind), flush=True)
