"""The table of docs/calibration.md: stated against actual errors and the coverage of the bands, tip, five seeds.

python docs/scripts/calibration.py [preset ...]
"""

from __future__ import annotations

import sys
from collections import defaultdict

import numpy as np

from wfsobs import PRESETS, run
from wfsobs.evaluation.scores import Calibration
from wfsobs.observers import OBSERVERS

SEEDS = range(1, 6)
LEFT_OUT = ("gpr-online",)
"""Those that take minutes over several seeds."""


def found(preset: str, observers: list[str]) -> dict[tuple[str, str], list[tuple[float, Calibration]]]:
    """(target, observer) -> (rms error [um], calibration) of every seed."""
    out = defaultdict(list)
    for seed in SEEDS:
        for score in run(PRESETS[preset]().replace({"run.seed": seed}), observers=observers).scores:
            if score.calibration is not None and score.mode == "tip":
                out[score.target, score.observer].append((score.rms, score.calibration))
    return out


def table(preset: str, observers: list[str]) -> str:
    """Return the rows of a preset."""
    rows = ["| Target | Observer | Error [nm] | Stated [nm] | in 68 % [%] | in 95 % [%] | CRPS [nm] |", "|---" * 7 + "|"]
    for (target, name), each in sorted(found(preset, observers).items()):
        error = np.sqrt(np.mean([e**2 for e, _ in each]))
        sd = np.sqrt(np.mean([c.sd**2 for _, c in each]))
        low, high, score = (np.mean([getattr(c, what) for _, c in each]) for what in ("within_68", "within_95", "crps"))
        cells = (f"{1e3 * error:.1f}", f"{1e3 * sd:.1f}", f"{100 * low:.0f}", f"{100 * high:.0f}", f"{1e3 * score:.2f}")
        rows.append(f"| {target} | `{name}` | {' | '.join(cells)} |")
    return "\n".join(rows)


if __name__ == "__main__":
    names = [name for name in OBSERVERS if name not in LEFT_OUT]
    for preset in sys.argv[1:] or ["paper", "ut4"]:
        print(f"`{preset}`:\n\n{table(preset, names)}\n", flush=True)
