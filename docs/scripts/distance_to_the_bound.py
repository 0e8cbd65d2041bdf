"""The tables of docs/observers.md: computed error of observers that use both sensors, over the bound of both sensors.

`distance_to_the_bound.py [preset ...]` computes, `distance_to_the_bound.py --records [preset ...]` holds records against it, with
`--lenslets` those of Shack-Hartmann sensors against spectra that have their aliasing.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from math import sqrt

import numpy as np

from wfsobs import PRESETS
from wfsobs.evaluation.bound import bound_rms
from wfsobs.evaluation.exact_errors import exact_errors
from wfsobs.execution import run_observer
from wfsobs.observers import OBSERVERS
from wfsobs.record import TOTAL, Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.mode_spectra import true_lenslet_spectra
from wfsobs.simulation.true_spectra import has_known_spectra
from wfsobs.typing import Array

NAMES = ("multirate-multi", "multirate-optimal")
TARGETS = ("turbulence", "vibration", TOTAL)
SEEDS = range(1, 21)
LONG = {"run.duration": 20.0, "run.warm_up": 10.0, "loop.closed": False}
"""Records after what filters take to settle."""
ENDLESS = {"vibration.synthesis": "gaussian"}
"""Of a period sixteen times as long."""
LENSLETS, RECORDS = "--lenslets", "--records"


def rows(preset: str) -> Iterator[str]:
    """Yield a row per mode: bounds [nm], and the ratio of each observer, by target."""
    scenario = PRESETS[preset]()
    found = {name: exact_errors(OBSERVERS[name], scenario) for name in NAMES}
    for mode in range(min(len(scenario.modes), 2)):
        least = bound_rms(scenario, mode, information="both")
        cells = [f"`{preset}`, {scenario.modes[mode].name}", " / ".join(f"{1e3 * least[target]:.2f}" for target in TARGETS)]
        cells += [
            " / ".join(f"{errors[mode][target].rms / least[target]:.3f}" for target in TARGETS) for errors in found.values()
        ]
        yield f"| {' | '.join(cells)} |"


def confirmed_rows(preset: str, has_lenslets: bool) -> Iterator[str]:
    """Yield a row per mode and target: rms computed, rms over the records [nm], their ratio, standard errors between them."""
    scenario = PRESETS[preset]().replace(LONG | ENDLESS | ({} if has_lenslets else {"sensors.kind": "zernike"}))
    spectra = [true_lenslet_spectra(scenario, mode) for mode in range(len(scenario.modes))] if has_lenslets else []
    expected = exact_errors(OBSERVERS[NAMES[0]], scenario, spectra=spectra)
    squares = np.array([square_errors(NAMES[0], simulate(scenario.replace({"run.seed": seed})), scenario) for seed in SEEDS])
    for mode in range(min(len(scenario.modes), 2)):
        for i, target in enumerate(TARGETS):
            found, computed = squares[:, i, mode], float(expected[mode][target].variance.mean())
            off = (found.mean() - computed) / (found.std(ddof=1) / sqrt(len(found)))
            rms, mean = 1e3 * sqrt(computed), 1e3 * sqrt(found.mean())
            which = f"`{preset}`, {scenario.modes[mode].name}, {target}"
            yield f"| {which} | {rms:.2f} | {mean:.2f} | {mean / rms:.3f} | {off:+.1f} |"


def square_errors(name: str, record: Record, scenario: Scenario) -> Array:
    """Return the mean square errors of an observer of one record after the warm-up, (targets, modes) [um^2]."""
    after = round(scenario.run.warm_up / record.dt)
    estimates = run_observer(name, record, scenario)
    errors = np.array([values[after:] - np.asarray(record.truth(target))[after:] for target, values in estimates.items()])
    return np.mean(np.concatenate([errors, errors.sum(axis=0, keepdims=True)]) ** 2, axis=1)


if __name__ == "__main__":
    options = {word for word in sys.argv[1:] if word.startswith("--")}
    presets = [name for name in sys.argv[1:] if name not in options]
    heads = ["Preset, mode", "bound of both [nm]", *(f"`{name}`" for name in NAMES)]
    if RECORDS in options:
        heads = [f"`{NAMES[0]}`", "computed [nm]", "records [nm]", "ratio", "standard errors"]
    print(f"| {' | '.join(heads)} |")
    print("|---" * len(heads) + "|")
    for preset in presets or [name for name, make in PRESETS.items() if has_known_spectra(make())]:
        for row in confirmed_rows(preset, LENSLETS in options) if RECORDS in options else rows(preset):
            print(row, flush=True)
