"""Spectra of frozen flow through lenslets, against the covariance of aliasing and against simulated records."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import welch

from wfsobs.scenario import Scenario
from wfsobs.sensors.shack_hartmann import Aliasing
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.flow_spectra import TurbulenceSpectra, flow_spectra
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.mode_spectra import lenslet_flow_spectra, true_lenslet_spectra
from wfsobs.simulation.sensor_noise import shack_hartmann
from wfsobs.typing import Array

pytestmark = pytest.mark.slow

FLOW = Scenario().replace(
    {
        "turbulence.source": "frozen-flow",
        "turbulence.wind_speed": 10.0,
        "sensors.kind": "shack-hartmann",
        "sensors.lgs_rate": 500.0,
        "sensors.lgs_noise": 0.0,
        "sensors.ngs_noise": 0.0,
        "loop.closed": False,
        "vibration.source": "none",
        "gpr_offline.training_size": 10,
        "gpr_offline.depth": 10,
        "gpr_online.training_size": 10,
    }
)
FREQUENCY = np.fft.rfftfreq(8192, 1.0 / 500.0)


def difference_variance(found: TurbulenceSpectra) -> float:
    """Return the variance of what the NGS measures less the truth."""
    density = found.own + found.ngs - 2.0 * found.ngs_cross.real
    return float(np.trapezoid(density, FREQUENCY))


@pytest.mark.parametrize("mode", [0, 1])
def test_what_lenslets_add_is_the_covariance_of_aliasing(mode: int) -> None:
    found, outer = lenslet_flow_spectra(FLOW, mode, FREQUENCY), FLOW.turbulence.outer_scale
    aliasing = Aliasing(shack_hartmann(FLOW, "ngs"))
    expected = sum(aliasing.covariance(layer.strength, outer)[mode, mode] for layer in atmosphere.layers(FLOW))
    # the mean over a step, and what is faster than 250 Hz, take 1 %; two rules of integration differ by as much
    assert difference_variance(found) == pytest.approx(expected, rel=0.02)


def test_the_truth_is_that_of_ideal_sensors() -> None:
    own, ideal = lenslet_flow_spectra(FLOW, 0, FREQUENCY).own, flow_spectra(FLOW, 0, FREQUENCY).own
    strong = ideal > 1e-6 * ideal.max()
    # nodes are finer; beyond ripples that are resolved, ideal ones have their mean alone
    assert own[strong] == pytest.approx(ideal[strong], rel=0.02)


def band_means(f: Array, density: Array) -> Array:
    """Return means over octaves from 8 Hz on."""
    return np.array([density[(f >= low) & (f < 2.0 * low)].mean() for low in (8.0, 16.0, 32.0, 64.0)])


@pytest.mark.parametrize(
    "changes", [{}, {"sensors.lgs_count": 3, "sensors.lgs_radius": 30.0, "sensors.ngs_direction": [10.0, 5.0]}]
)
def test_records_have_these_spectra(changes: dict[str, object]) -> None:
    scenario = FLOW.replace({**changes, "run.duration": 60.0})
    measured = simulate(scenario).z[:, 0]
    f, density = welch(measured, 500.0, nperseg=2048)
    found = lenslet_flow_spectra(scenario, 0, f).measurement
    ratio = band_means(f, density) / band_means(f, found)
    # some 29 stretches times 33 and more bins: 3 % and less; four times that
    assert ratio == pytest.approx(1.0, abs=0.12)
    # and would not be those of ideal sensors: from 32 Hz on aliasing is most of what is measured
    assert (band_means(f, density) / band_means(f, flow_spectra(scenario, 0, f).measurement))[-1] > 2.0


def test_all_the_rest_is_that_of_the_scenario() -> None:
    found = true_lenslet_spectra(FLOW, 0)
    assert found.signal["vibration"].max() == 0.0
    assert found.ngs.ratio == FLOW.sensors.exposure_ratio
    with pytest.raises(ValueError, match="aliasing is that of frozen flow"):
        true_lenslet_spectra(FLOW.replace({"turbulence.source": "ar2"}), 0)
