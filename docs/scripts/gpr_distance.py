"""The table of docs/gaussian-processes.md of how far windows are from the bound: `gpr_distance.py [seeds] [scenario ...]`.

Vibration, records of 10 s, scored from 4.1 s on, rms over seeds.
"""

from __future__ import annotations

import sys

import numpy as np

from wfsobs import PRESETS, simulate
from wfsobs.evaluation.bound import bound_rms
from wfsobs.execution import run_observer

NAMES = ("zero", "gpr-offline", "gpr-online", "ridge-30", "gpr-adaptive", "kf-adaptive")
SCENARIOS = {
    "paper": PRESETS["paper"](),
    "strong-turbulence": PRESETS["strong-turbulence"](),
    "ut4": PRESETS["ut4"](),
    "ut4-floor": PRESETS["ut4-floor"](),
    "faint": PRESETS["paper"]().replace({"sensors.lgs_noise": 0.08}),
    "slow-loop": PRESETS["paper"]().replace({"sensors.lgs_rate": 400.0}),
    "lines": PRESETS["peak-jump"]().replace({"run.duration": 10.0, "sensors.lgs_low_frequency_rms": 0.0, "events": []}),
}
START = 4.1
"""[s]"""


def table(name: str, seeds: int) -> None:
    """Print a row per mode: both bounds [nm], and error [nm] and error over the bound of the LGS of every observer."""
    scenario, squares = SCENARIOS[name], {observer: [] for observer in NAMES}
    for seed in range(1, seeds + 1):
        s = scenario.replace({"run.seed": seed})
        record = simulate(s)
        for observer, found in squares.items():
            error = (run_observer(observer, record, s)["vibration"] - record.vibration)[round(START / s.dt) :]
            found.append(np.mean(error**2, axis=0))
    for mode in range(2):
        alone, both = bound_rms(scenario, mode)["vibration"], bound_rms(scenario, mode, information="both")["vibration"]
        errors = [np.sqrt(np.mean(found, axis=0))[mode] for found in squares.values()]
        cells = [f"{1e3 * error:.2f} = {error / alone:.2f}" for error in errors]
        print(
            f"| `{name}`, {scenario.modes[mode].name} | {1e3 * alone:.2f}, {1e3 * both:.2f} | {' | '.join(cells)} |", flush=True
        )


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    print(f"| Scenario, mode | bound of the LGS, of both [nm] | {' | '.join(f'`{name}`' for name in NAMES)} |")
    print("|---" * (2 + len(NAMES)) + "|")
    for chosen in sys.argv[2:] or SCENARIOS:
        table(chosen, count)
