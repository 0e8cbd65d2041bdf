"""The table of docs/data.md on what outliers cost: `python docs/scripts/outliers.py [seeds]`; one and a half minutes a seed.

The preset `ut4`, 20 s, with 1 % of the frames of a sensor off by 40, 10 and 6 times its noise, of the training data as well. Rms
errors over all seeds, in per cent above those of the clean record without a gate, of the worse mode.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import replace

import numpy as np

from wfsobs import PRESETS, observe, simulate
from wfsobs.evaluation.result import Result
from wfsobs.evaluation.scores import PREDICTION, SCORED, score
from wfsobs.observers import OBSERVERS
from wfsobs.record import Record, Training
from wfsobs.typing import Array

UT4 = PRESETS["ut4"]().replace({"run.duration": 20.0, "run.warm_up": 2.0})
LGS_NOISE = UT4.sensors.lgs_noise / np.sqrt(UT4.sensors.lgs_count)
"""Of the mean of the LGS [um]."""
SHARE, SIGMAS = 0.01, (40.0, 10.0, 6.0)
NAMES = tuple(name for name in OBSERVERS if name not in ("zero", "kf-asterism"))
Key = tuple[str, str, str]


def off(n: int, size: float, rng: np.random.Generator) -> Array:
    """Return errors (n, 1) [um] of one size and either sign in a share of n frames."""
    return size * (rng.random((n, 1)) < SHARE) * rng.choice([-1.0, 1.0], (n, 1))


def broken(record: Record, sensors: str, sigmas: float, seed: int) -> Record:
    """Return a record with outliers; sensors : LGS, NGS or both."""
    rng = np.random.default_rng(seed)
    training, y_ngs = record.training, record.y_ngs
    assert training is not None and training.open_loop_y is not None and y_ngs is not None and record.ratio is not None
    if sensors != "NGS":
        steps = off(len(training.y_lgs), sigmas * LGS_NOISE, rng)
        training = Training(training.y_lgs + steps, training.u, training.open_loop_y + steps)
        record = replace(record, training=training, y_lgs=record.y_lgs + off(record.n_steps, sigmas * LGS_NOISE, rng))
    if sensors != "LGS":
        record = replace(record, y_ngs=y_ngs + off(record.n_steps, sigmas * UT4.sensors.ngs_noise, rng))
    return record


def squares(result: Result) -> dict[Key, float]:
    """Return the mean square errors by observer, target and mode [um^2]."""
    return {(s.observer, s.target, s.mode): s.rms**2 for s in result.scores if s.target in SCORED}


def ratios(result: Result) -> dict[tuple[str, str], float]:
    """Return the rms of innovations over what each filter states of them, by observer and mode."""
    blind = replace(result.record, turbulence=None, vibration=None, y_ngs=None, ratio=None)  # with an NGS there is none
    scores = score(blind, result.estimates, warm_up=UT4.run.warm_up)
    return {(s.observer, s.mode): s.rms / s.calibration.sd for s in scores if s.target == PREDICTION and s.calibration}


if __name__ == "__main__":
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    sums: dict[str, dict[Key, float]] = defaultdict(lambda: defaultdict(float))
    stated: dict[str, list[float]] = defaultdict(list)
    for seed in range(1, seeds + 1):
        scenario = UT4.replace({"run.seed": seed})
        clean = simulate(scenario)
        result = observe(clean, scenario, observers=NAMES, gate=False)
        for (name, _), ratio in ratios(result).items():
            stated[name].append(ratio)
        found = {"": squares(result), "clean": squares(observe(clean, scenario, observers=NAMES))}
        for sensors in ("LGS", "NGS", "both"):
            for sigmas in SIGMAS:
                record = broken(clean, sensors, sigmas, seed)
                found[f"{sensors} {sigmas}"] = squares(observe(record, scenario, observers=NAMES))
        for case, values in found.items():
            for key, value in values.items():
                sums[case][key] += value
    columns = [["clean"], *([f"{sensors} {sigmas}" for sigmas in SIGMAS] for sensors in ("LGS", "NGS", "both"))]
    print("| Observer | Target | Innovations over stated | Clean | LGS | NGS | both |\n|---|---|---|---|---|---|---|")
    for name in NAMES:
        for target in SCORED:
            keys = [key for key in sums[""] if key[:2] == (name, target)]
            if not keys or (target == "turbulence" and OBSERVERS[name].targets != ("turbulence",)):
                continue
            worst = {case: max(100.0 * (np.sqrt(of[key] / sums[""][key]) - 1.0) for key in keys) for case, of in sums.items()}
            cells = (
                " / ".join(f"{worst[case]:.2f}" if case == "clean" else f"{worst[case]:.1f}" for case in one) for one in columns
            )
            span = f"{min(stated[name]):.2f} to {max(stated[name]):.2f}" if stated[name] else "-"
            print(f"| `{name}` | {target} | {span} | {' | '.join(cells)} |")
