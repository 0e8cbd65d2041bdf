"""Settings that must go together, and the presets."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from wfsobs import PRESETS
from wfsobs.scenario import Scenario
from wfsobs.settings.priors import PAPER_PEAK_HZ
from wfsobs.settings.values import SettingError
from wfsobs.simulation.disturbance import vibration_variance

TABLE = {"frequency": [1.0, 2.0, 3.0], "tip": [1.0, 1.0, 1.0], "tilt": [1.0, 1.0, 1.0]}
FLOW: dict[str, Any] = {"turbulence.source": "frozen-flow"}
PSD: dict[str, Any] = {"vibration.source": "psd"}


@pytest.mark.parametrize(
    ("changes", "named", "limit"),
    [
        ({"run.duration": 2.0, "run.warm_up": 2.0}, "run.warm_up = 2", "2 s"),
        ({"vibration.peaks.1": {"frequency": 500.0}}, "vibration.peaks.1.frequency = 500", "500 Hz"),
        ({"sensors.lgs_rate": 90.0}, "vibration.peaks.0.frequency = 47.4969", "45 Hz"),
        ({"kalman.frequency": 600.0}, "kalman.frequency = 600", "500 Hz"),
        ({"butterworth.frequencies": [30.0, 1.0]}, "butterworth.frequencies.1 = 1", "500 Hz"),
        ({"butterworth.frequencies": [499.0]}, "butterworth.frequencies.0 = 499", "500 Hz"),
        ({"butterworth.bandwidth_online": 40.0}, "butterworth.frequencies.0 = 17.1", "20 Hz"),
        (PSD, "vibration.psd.frequency", "two frequencies"),
        (PSD | {"vibration.psd": TABLE | {"frequency": [1.0, 1.0, 3.0]}}, "vibration.psd.frequency", "increasing"),
        (PSD | {"vibration.psd": TABLE | {"tilt": [1.0]}}, "vibration.psd.tilt", "1 numbers"),
        ({"turbulence.source": "psd"}, "turbulence.psd.frequency", "two frequencies"),
        ({"turbulence.source": "psd", "turbulence.psd": TABLE | {"tip": []}}, "turbulence.psd.tip", "0 numbers"),
        (FLOW | {"turbulence.layers": []}, "turbulence.layers", "above 0"),
        (FLOW | {"turbulence.layers.0.fraction": 0.0}, "turbulence.layers", "above 0"),
        (FLOW | {"sensors.lgs_altitude": 8500.0}, "turbulence.layers.0.height = 8000", "7650 m"),
        (FLOW | {"turbulence.outer_scale": 2.0, "telescope.diameter": 39.0}, "turbulence.outer_scale = 2", "9.75 m"),
        (FLOW | {"turbulence.wind_speed": 0.1, "sensors.lgs_rate": 1e5}, "turbulence.layers.0.wind_factor = 1", "40 s"),
    ],
)
def test_settings_that_do_not_go_together(changes: dict[str, Any], named: str, limit: str) -> None:
    s = Scenario().replace(changes)
    with pytest.raises(SettingError, match=re.escape(named)) as caught:
        s.validate()
    assert limit in str(caught.value) and "\n" not in str(caught.value)


def test_what_goes_together_passes() -> None:
    Scenario().validate()
    Scenario().replace({"vibration.source": "psd", "vibration.psd": TABLE}).validate()
    Scenario().replace({"vibration.psd": {"frequency": [3.0, 1.0]}}).validate()  # a table that is not used
    Scenario().replace(FLOW).validate()
    Scenario().replace({"turbulence.layers": [], "sensors.lgs_altitude": 1000.0}).validate()  # layers that are not used
    Scenario().replace(FLOW | {"turbulence.layers": [{"fraction": 0.0}, {"height": 0.0, "fraction": 1e-6}]}).validate()


@pytest.mark.parametrize(("order", "count"), [(1, 2), (2, 5), (3, 9), (4, 14), (5, 20), (6, 27)])
def test_modes_up_to_an_order(order: int, count: int) -> None:
    modes = Scenario().replace({"telescope.radial_order": order}).modes
    assert len(modes) == count == len({mode.name for mode in modes})
    assert [mode.noll for mode in modes] == list(range(2, count + 2))
    assert [mode.name for mode in modes[:2]] == ["tip", "tilt"] and modes[-1].radial_order == order


@pytest.mark.slow
def test_a_pickled_scenario_is_whole_where_no_observer_is_known_yet() -> None:
    path = "multipeak.line_width"
    content = pickle.dumps(Scenario().replace({path: 0.123}))
    code = f"import pickle, sys; print(pickle.load(sys.stdin.buffer).{path})"
    assert subprocess.run([sys.executable, "-c", code], input=content, check=True, capture_output=True).stdout.split() == [
        b"0.123"
    ]


def test_steps_and_time_step() -> None:
    s = Scenario().replace({"run.duration": 2.5, "sensors.lgs_rate": 800.0})
    assert s.n_steps == 2000 and s.dt == 1 / 800
    assert Scenario().replace({"run.duration": 0.1, "sensors.lgs_rate": 10.0}).n_steps == 1


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_and_new_each_time(name: str) -> None:
    one, other = PRESETS[name](), PRESETS[name]()
    one.validate()
    assert one == other and one is not other
    one.vibration.peaks[0].rms[0] = 9.0
    assert PRESETS[name]() == other
    assert PRESETS[name].__doc__


def test_the_paper_preset_has_the_numbers_of_the_tables() -> None:
    """Tables 1 to 4 and section 2.4, transcribed from the paper's text."""
    s = PRESETS["paper"]()
    t, v, n, k, b = s.turbulence, s.vibration, s.sensors, s.kalman, s.butterworth
    assert (t.damping, t.wind_speed, s.telescope.diameter, s.modes[0].radial_order) == (0.9, 15.0, 8.0, 1)
    assert (k.frequency, k.damping, PAPER_PEAK_HZ) == (47.4969, 0.03, 47.4969)
    assert (n.lgs_rate, n.exposure_ratio) == (1000.0, 5)  # 200 Hz
    assert v.cutoff == 80.0
    assert b.frequencies == [17.1, 24.3, 34.1, 47.7, 54.3, 61.5]
    assert (b.bandwidth_offline, b.bandwidth_online, b.order) == (3.0, 2.0, 1)
    offline, online = s.gpr_offline, s.gpr_online
    assert (offline.signal_std, offline.length_scale, offline.training_size, offline.depth, offline.noise_std) == (
        10.0,
        300.0,
        1000,
        407,
        0.13,
    )
    assert (online.signal_std, online.length_scale, online.training_size, online.depth, online.noise_std) == (
        30.0,
        300.0,
        511,
        170,
        0.1,
    )
    assert offline.inputs == online.inputs == "u-y"
    # stated in the preset's docstring: vibration of 15.5 nm on tip, r_NGS < r_LGS / 2
    assert np.sqrt(vibration_variance(s, 0)) == pytest.approx(0.0155, abs=0.0001)
    assert n.ngs_noise**2 < n.lgs_noise**2 / n.lgs_count
