"""What learning from the record alone costs: errors of adaptive filters over the bound of both sensors. `told_nothing.py [seeds]
[preset ...]`. Records of 30 s, scored from 10 s on; rms over seeds."""

from __future__ import annotations

import sys
from time import perf_counter

import numpy as np

from wfsobs import PRESETS, simulate
from wfsobs.evaluation.bound_both import bound_rms_of_both
from wfsobs.execution import run_observer

NAMES = ("kf-adaptive", "multirate-adaptive", "multirate-multi")
"""The last one is told."""
DURATION, START = 30.0, 10.0
"""[s]"""
TARGETS = ("turbulence", "vibration")
TOLD = {"multipeak.turbulence_order": 3}


def table(preset: str, seeds: int) -> None:
    """Print a row per mode and target: bound [nm], error over bound by observer; and the seconds that each takes."""
    scenario = PRESETS[preset]().replace({"run.duration": DURATION, **TOLD})
    squares: dict[tuple[str, str], list[np.ndarray]] = {}
    seconds = dict.fromkeys(NAMES, 0.0)
    for seed in range(1, seeds + 1):
        s = scenario.replace({"run.seed": seed})
        record = simulate(s)
        for name in NAMES:
            start = perf_counter()
            found = run_observer(name, record, s)
            seconds[name] += perf_counter() - start
            for target in TARGETS:
                error = (found[target] - record.truth(target))[round(START / s.dt) :]
                squares.setdefault((name, target), []).append((error**2).mean(axis=0))
    for mode in range(min(len(scenario.modes), 2)):
        bound = bound_rms_of_both(scenario, mode)
        for target in TARGETS:
            errors = [np.sqrt(np.mean(squares[name, target], axis=0))[mode] for name in NAMES]
            cells = [f"{1e3 * error:.2f} = {error / bound[target]:.3f}" for error in errors]
            print(
                f"| `{preset}`, {scenario.modes[mode].name}, {target} | {1e3 * bound[target]:.2f} | {' | '.join(cells)} |",
                flush=True,
            )
    print(f"| `{preset}`, time [s] | | {' | '.join(f'{seconds[name] / seeds:.2f}' for name in NAMES)} |", flush=True)


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    print(f"| Preset, mode, target | bound of both [nm] | {' | '.join(f'`{name}` [nm]' for name in NAMES)} |")
    print("|---" * (2 + len(NAMES)) + "|")
    for chosen in sys.argv[2:] or ("paper", "ut4"):
        table(chosen, count)
