"""What learning from the record alone costs: errors of adaptive filters over the bound of both sensors. `told_nothing.py [seeds]
[preset ...]`. Records of 30 s, cut from a synthesis 32 times as long, scored from 10 s on; rms over seeds.

A cell has three numbers.

- The error [nm], and its ratio to the bound. The bound is that of endless records, with every filter long settled; the errors are
  those of these records, which differ from it by chance and by their start. The filter that is told all pays both.
- Paired: the ratio to the error of the told filter on the same records, times the computed ratio of that filter to the bound
  under the true spectra (`exact_errors`). What both filters owe to these records cancels; what is left is the price of learning.
  Its standard error is that of a jackknife over seeds. For the told filter it is the computed ratio itself.

Times are of the processor.
"""

from __future__ import annotations

import argparse
from time import process_time

import numpy as np

from wfsobs import PRESETS, simulate
from wfsobs.evaluation.bound import bound_rms
from wfsobs.evaluation.exact_errors import exact_errors
from wfsobs.execution import run_observer
from wfsobs.observers import OBSERVERS
from wfsobs.scenario import Scenario
from wfsobs.simulation import disturbance
from wfsobs.typing import Array

NAMES = ("kf-adaptive", "multirate-adaptive", "multirate-multi")
"""The last one is told."""
DURATION, START = 30.0, 10.0
"""[s]"""
TARGETS = ("turbulence", "vibration")
TOLD = {"multipeak.turbulence_order": 3}
SYNTHESIS = {"vibration.synthesis": "gaussian"}
"""Not as `paper` has it, of the record's own length: vibration would be a comb of lines at multiples of 1 / 30 s."""


def square_errors(scenario: Scenario, seeds: int, first: int = 1) -> tuple[Array, Array]:
    """Return mean square errors (names, targets, seeds, modes) [um^2], and the processor time of each observer per record [s]."""
    squares, seconds = np.empty((len(NAMES), len(TARGETS), seeds, len(scenario.modes))), np.zeros(len(NAMES))
    for seed in range(seeds):
        s = scenario.replace({"run.seed": first + seed})
        record = simulate(s)
        for i, name in enumerate(NAMES):
            start = process_time()
            found = run_observer(name, record, s)
            seconds[i] += process_time() - start
            for j, target in enumerate(TARGETS):
                error = (found[target] - record.truth(target))[round(START / s.dt) :]
                squares[i, j, seed] = (error**2).mean(axis=0)
    return squares, seconds / seeds


def rms_ratio(squares: Array, told: Array) -> tuple[float, float]:
    """Return the ratio of two rms over seeds, of mean squares (seeds,), and its standard error by the jackknife."""
    n = len(squares)
    left = np.sqrt((squares.sum() - squares) / (told.sum() - told)) if n > 1 else np.full(1, np.nan)
    return float(np.sqrt(squares.sum() / told.sum())), float(np.sqrt((n - 1) * np.mean((left - left.mean()) ** 2)))


def table(preset: str, seeds: int, first: int) -> None:
    """Print a row per mode and target, and the seconds that each observer takes."""
    scenario = PRESETS[preset]().replace({"run.duration": DURATION, **TOLD, **SYNTHESIS})
    squares, seconds = square_errors(scenario, seeds, first)
    exact = exact_errors(OBSERVERS[NAMES[-1]], scenario)
    for mode in range(min(len(scenario.modes), 2)):
        bound = bound_rms(scenario, mode, information="both")
        for j, target in enumerate(TARGETS):
            computed, of_all = exact[mode][target].rms / bound[target], squares[:, j, :, mode]
            cells = []
            for of_one in of_all:
                error, (ratio, spread) = np.sqrt(of_one.mean()), rms_ratio(of_one, of_all[-1])
                paired = f"{ratio * computed:.3f} ± {spread * computed:.3f}"
                cells += [f"{1e3 * error:.2f} = {error / bound[target]:.3f}", paired]
            cells[-1] = f"{computed:.3f}"
            which = f"`{preset}`, {scenario.modes[mode].name}, {target}"
            print(f"| {which} | {1e3 * bound[target]:.2f} | {' | '.join(cells)} |", flush=True)
    print(f"| `{preset}`, time [s] | | {' | | '.join(f'{time:.2f}' for time in seconds)} | |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("seeds", type=int, nargs="?", default=3)
    parser.add_argument("presets", nargs="*", default=["paper", "ut4"])
    parser.add_argument("--first", type=int, default=1, help="The first seed; the others are those after it.")
    parser.add_argument(
        "--line-width",
        type=float,
        help="of the true lines of the simulation [Hz]; by default a sixteenth of the resolution of the record",
    )
    a = parser.parse_args()
    if a.line_width:
        disturbance.SHARPER = 1.0 / (a.line_width * DURATION)
    heads = [f"`{name}` [nm] | {'computed' if name == NAMES[-1] else 'paired'}" for name in NAMES]
    print(f"| Preset, mode, target | bound of both [nm] | {' | '.join(heads)} |")
    print("|---" * (2 + 2 * len(NAMES)) + "|")
    for preset in a.presets:
        table(preset, a.seeds, a.first)


if __name__ == "__main__":
    main()
