"""The table of docs/observers.md: computed error of observers that use both sensors, over the bound of both sensors."""

from __future__ import annotations

import sys
from collections.abc import Iterator

from wfsobs import PRESETS
from wfsobs.evaluation.bound import TOTAL
from wfsobs.evaluation.bound_both import bound_rms_of_both
from wfsobs.evaluation.exact_errors import exact_errors
from wfsobs.observers import OBSERVERS
from wfsobs.simulation.true_spectra import has_known_spectra

NAMES = ("multirate-multi", "multirate-optimal")
TARGETS = ("turbulence", "vibration", TOTAL)


def rows(preset: str) -> Iterator[str]:
    """Yield a row per mode: bounds [nm], and the ratio of each observer, by target."""
    scenario = PRESETS[preset]()
    found = {name: exact_errors(OBSERVERS[name], scenario) for name in NAMES}
    for mode in range(min(len(scenario.modes), 2)):
        least = bound_rms_of_both(scenario, mode)
        cells = [f"`{preset}`, {scenario.modes[mode].name}", " / ".join(f"{1e3 * least[target]:.2f}" for target in TARGETS)]
        cells += [
            " / ".join(f"{errors[mode][target].rms / least[target]:.3f}" for target in TARGETS) for errors in found.values()
        ]
        yield f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    print("| Preset, mode | bound of both [nm] | " + " | ".join(f"`{name}`" for name in NAMES) + " |")
    print("|---" * (2 + len(NAMES)) + "|")
    for preset in sys.argv[1:] or [name for name, make in PRESETS.items() if has_known_spectra(make())]:
        for row in rows(preset):
            print(row, flush=True)
