"""The frozen-flow tasks: turbulence on the axis, and what the sensors see of it."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import numpy as np

from wfsobs.bench.measure import OURS, Row, measure_time, peak_memory_mb, row
from wfsobs.bench.sizes import Sizes
from wfsobs.progress import QUIET
from wfsobs.scenario import Scenario
from wfsobs.simulation.turbulence import SOURCES

ONE_LAYER: dict[str, Any] = {"turbulence.source": "frozen-flow"}
"""As the preset is otherwise: tip and tilt, one layer, two LGS on the axis and an NGS."""


def many_layers(sizes: Sizes) -> dict[str, Any]:
    """Modes up to the order and layers as the sizes say, four LGS beside the axis and an NGS."""
    return {
        "turbulence.source": "frozen-flow",
        "telescope.radial_order": sizes.order,
        "sensors.lgs_count": 4,
        "sensors.lgs_radius": 64.0,
        "turbulence.layers": [
            {"height": 2000.0 * i, "wind_factor": 0.4 + 0.2 * i, "wind_direction": 36.0 * i, "fraction": 0.1}
            for i in range(sizes.layers)
        ],
    }


def frozen(sizes: Sizes, _libraries: Collection[str]) -> Iterator[Row]:
    """Few modes in one layer and many in ten, through Shack-Hartmann sensors and through ideal ones."""
    for changes, repeats in ((ONE_LAYER, sizes.repeats), (many_layers(sizes), 1)):
        scenario = sizes.scenario(sizes.duration, changes)
        for variant, kind in ((OURS, "shack-hartmann"), ("ideal-sensors", "zernike")):
            made = scenario.replace({"sensors.kind": kind})
            seconds, _ = measure_time(lambda made=made: _make(made), repeats)
            yield row("frozen-flow", _size(scenario), variant, seconds, scenario.n_steps, peak_memory_mb=peak_memory_mb())


def _make(scenario: Scenario) -> None:
    SOURCES["frozen-flow"](scenario, scenario.n_steps, np.random.default_rng(1), QUIET)


def _size(scenario: Scenario) -> str:
    layers = len(scenario.turbulence.layers)
    return f"{scenario.run.duration:g} s, {len(scenario.modes)} modes, {layers} layer{'s' if layers > 1 else ''}"
