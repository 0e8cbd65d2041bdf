"""A controller in SPECULA: its filter class as a YAML file asks for it, and its FITS file in SPECULA's own filter."""

from pathlib import Path

import numpy as np
import pytest
import specula

specula.init(-1, precision=0)
from specula.base_value import BaseValue  # noqa: E402
from specula.data_objects.simul_params import SimulParams  # noqa: E402
from specula.data_objects.ssr_filter_data import SsrFilterData  # noqa: E402
from specula.lib.utils import get_type_hints, import_class  # noqa: E402
from specula.processing_objects.ssr_filter import SsrFilter  # noqa: E402

import wfsobs  # noqa: E402
from wfsobs.handover.write import write_design  # noqa: E402
from wfsobs.peers.controller import ControllerError  # noqa: E402
from wfsobs.scenario.configfile import save_scenario  # noqa: E402

FRAMES = 400


@pytest.fixture(scope="module")
def scenario() -> wfsobs.Scenario:
    return wfsobs.PRESETS["paper"]()


@pytest.fixture
def ours(scenario: wfsobs.Scenario, tmp_path: Path):
    save_scenario(scenario, tmp_path / "found.toml")
    filter_class = import_class("WfsobsFilter", ["wfsobs.peers"])
    assert "prior" in get_type_hints(filter_class)
    simul = SimulParams(pixel_pupil=8, pixel_pitch=1.0, time_step=1e-3)
    return filter_class(simul, controller="lqg-kf-multi", prior=str(tmp_path / "found.toml"), delay=1.0)


def close(one, disturbance: np.ndarray) -> np.ndarray:
    """Return the commands of a loop with a mirror that is read with :-1, all in nanometres."""
    y = BaseValue(value=np.zeros(2))
    one.inputs["delta_comm"].set(y)
    one.setup()
    sent, out, mirror = np.zeros(2), [], np.zeros(2)
    for k, row in enumerate(disturbance):
        y.value = row - mirror
        y.generation_time = k
        one.check_ready(k)
        one.trigger()
        one.post_trigger()
        mirror, sent = sent, np.array(one.out_comm.value)
        mirror = sent
        out.append(np.array(one.out_comm_no_delay.value))
    return np.array(out)


@pytest.fixture(scope="module")
def disturbance(scenario: wfsobs.Scenario) -> np.ndarray:
    return 1e3 * wfsobs.simulate(scenario.replace({"run.duration": 2.0})).z[:FRAMES]


def test_its_filter_class_is_the_controller(ours, scenario: wfsobs.Scenario, disturbance: np.ndarray) -> None:
    alone, u = wfsobs.design("lqg-kf-multi", scenario), np.zeros((FRAMES + 2, 2))
    for k, row in enumerate(disturbance):
        u[k] = alone.update(1e-3 * row + u[k - 2])
    np.testing.assert_allclose(close(ours, disturbance), -1e3 * u[:FRAMES], rtol=0, atol=1e-9 * np.abs(1e3 * u).max())


def test_its_file_in_the_filter_of_specula_gives_the_same(ours, scenario, disturbance, tmp_path: Path) -> None:
    write_design("lqg-kf-multi", scenario, "specula", tmp_path / "ssr.fits")
    theirs = SsrFilter(SsrFilterData.restore(str(tmp_path / "ssr.fits")), delay=1.0, output_uses_new_state=False)
    expected = close(ours, disturbance)
    # another order of the sums, over 400 frames of a closed loop
    np.testing.assert_allclose(close(theirs, disturbance), expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_mistake_in_the_file_is_told(tmp_path: Path) -> None:
    filter_class = import_class("WfsobsFilter", ["wfsobs.peers"])
    simul = SimulParams(pixel_pupil=8, pixel_pitch=1.0, time_step=1e-3)
    with pytest.raises(ControllerError, match="takes one of none"):
        filter_class(simul, controller="kf-multi", prior=str(tmp_path / "found.toml"))
