"""Time the bounds of presets: of every row, mode and target, in a fresh process each.

    python scripts/measure_bounds.py [PRESET ...]

*First* is what the first run of a process takes, imports not counted; *next* is the same with other noise, so that nothing is
remembered but what no setting changes. Rows of all modes together, which stand beside their observers alone, have lines of
their own. Wall-clock time, and the processor's, of all threads, which does not count others at work on the machine [s].
"""

from __future__ import annotations

import subprocess
import sys
from time import perf_counter, process_time

import numpy as np

from wfsobs.app.work import one_blas_thread
from wfsobs.evaluation.bound import INFORMATION, bound, joint_observers, record_bounds
from wfsobs.evaluation.result import JOINT_BOUNDS
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS


def main(names: list[str]) -> None:
    """Print a line per preset and kind of row."""
    print(f"{'preset':20}{'rows':20}{'first':>8}{'next':>8}{'first, CPU':>12}{'next, CPU':>12}   s")
    for name in names or [name for name, preset in PRESETS.items() if not preset().events]:
        for observer in ("", *joint_observers(PRESETS[name](), JOINT_BOUNDS)):
            subprocess.run([sys.executable, __file__, "--one", name, observer], check=True)


def one(name: str, observer: str) -> None:
    """Print the line of a preset; observer : one of JOINT_BOUNDS, or empty."""
    one_blas_thread()
    scenario = PRESETS[name]()
    first, first_busy = times(scenario, observer)
    again, again_busy = times(scenario.replace({"sensors.lgs_noise": 1.01 * scenario.sensors.lgs_noise}), observer)
    label = JOINT_BOUNDS[observer] if observer else "of every mode"
    print(f"{name:20}{label:20}{first:8.2f}{again:8.2f}{first_busy:12.2f}{again_busy:12.2f}", flush=True)


def times(scenario: Scenario, observer: str) -> tuple[float, float]:
    """Return the time that the bounds take, and the processor's [s]."""
    start, busy = perf_counter(), process_time()
    if observer:
        bound(scenario, information=next(name for name, row in INFORMATION.items() if row == JOINT_BOUNDS[observer]))
    else:
        nothing = np.zeros((scenario.n_steps, len(scenario.modes)))
        record_bounds(scenario, Record(nothing, nothing, scenario.dt))
    return perf_counter() - start, process_time() - busy


if __name__ == "__main__":
    one(*sys.argv[2:]) if sys.argv[1:2] == ["--one"] else main(sys.argv[1:])
