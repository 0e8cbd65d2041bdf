"""A controller in the loop of another program: its unit, its sign, its delay, and what it refuses."""

from pathlib import Path

import numpy as np
import pytest

import wfsobs
from wfsobs.peers.wfsobs_filter import ControllerError, LoopController
from wfsobs.record import Sampling
from wfsobs.scenario.configfile import save_scenario

DT = 2e-3


@pytest.fixture
def prior(tmp_path: Path) -> str:
    save_scenario(wfsobs.PRESETS["paper"](), tmp_path / "found.toml")
    return str(tmp_path / "found.toml")


def test_it_is_the_controller_in_the_units_and_with_the_sign_of_the_loop(prior: str) -> None:
    scenario = wfsobs.PRESETS["paper"]().replace({"sensors.lgs_rate": 500.0, "control.delay": 3.0})
    alone = wfsobs.design("lqg-kf-multi", scenario, sampling=Sampling(2, DT))
    ours = LoopController(2, "lqg-kf-multi", prior, DT, delay=3.0, scale=1e-3)
    y = np.random.default_rng(1).normal(0.0, 0.1, (200, 2))
    y[50:55, 1] = np.nan
    expected = np.array([alone.update(row) for row in y])
    got = [ours.update(1e3 * row) for row in y]
    # nanometres and back round twice
    np.testing.assert_allclose(got, -1e3 * expected, rtol=0, atol=1e-10 * np.abs(1e3 * expected).max())
    ours.reset()
    np.testing.assert_array_equal([ours.update(1e3 * row) for row in y], got)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"controller": "lqg-multirate"}, "takes one of none, integrator, lqg-kf-lgs, lqg-kf-multi"),
        ({"delay": 0.5}, "delay = 0.5"),
        ({"scale": 0.0}, "scale = 0.0"),
    ],
)
def test_what_cannot_run_is_told_in_one_line(prior: str, changes: dict, message: str) -> None:
    given = {"n_modes": 2, "controller": "lqg-kf-multi", "prior": prior, "dt": DT} | changes
    with pytest.raises(ControllerError, match=message) as caught:
        LoopController(**given)
    assert "\n" not in str(caught.value)
