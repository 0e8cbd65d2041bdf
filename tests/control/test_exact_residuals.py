"""The computed residual against theory in frequency, the bound where the model is the truth, and the bound of `ut4`."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.records import MATCHED
from wfsobs.closed_loop.design import design, exact_residuals
from wfsobs.closed_loop.run import closed_loop
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.bound import bound_rms
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate


@pytest.mark.parametrize("name", ["integrator", "lqg-kf-lgs", "lqg-kf-multi"])
@pytest.mark.parametrize("delay", [1.0, 2.0, 2.4])
def test_a_time_invariant_law_leaves_what_its_transfer_function_does(name: str, delay: float) -> None:
    s = MATCHED.replace({"control.delay": delay})
    for found, designed in zip(exact_residuals(name, s), design(s, [name]).laws[name], strict=True):
        # the one by a long response, the other by a spline through the transfer function
        assert found.phases == pytest.approx([designed.predicted_rms] * s.sensors.exposure_ratio, rel=1e-5)


@pytest.mark.parametrize("delay", [1.0, 2.0, 3.0])
def test_where_the_truth_is_the_model_it_is_the_bound_of_the_prediction(delay: float) -> None:
    s = MATCHED.replace({"control.delay": delay})
    for mode, found in enumerate(exact_residuals("lqg-multirate-multi", s)):
        least = bound_rms(s, mode, int(delay) - 1, information="both")["total"]
        assert 1.0 - 1e-5 < found.rms / least < 1.0001, "the bound is met to what its search leaves"


def test_records_leave_it_at_every_step_of_a_cycle() -> None:
    """A wrong model: one peak of a vibration of two. 12 records of 20 s."""
    name, ratio = "lqg-multirate", MATCHED.sensors.exposure_ratio
    s = MATCHED.replace(
        {
            "vibration.peaks": [
                *MATCHED.to_dict()["vibration"]["peaks"],
                {"frequency": 20.0, "damping": 0.05, "rms": [0.03, 0.03]},
            ],
            "run.duration": 20.0,
        }
    )
    plan, squares = design(s, [name]), []
    for seed in range(12):
        (outcome,) = closed_loop(simulate(s.replace({"run.seed": seed + 1})), plan).outcomes
        assert outcome.residual is not None
        squares.append((outcome.residual[500:] ** 2).reshape(-1, ratio, 2).mean(axis=0))
    found = np.array([error.variance for error in exact_residuals(name, s)]).T
    # The residual of step k is that of the command before it.
    mean, scatter = np.mean(squares, axis=0), np.std(squares, axis=0, ddof=1) / np.sqrt(12)
    assert np.abs(mean - found).max() < 4.0 * scatter.max(), "ten figures, at four standard errors"


@pytest.mark.slow
def test_ut4_with_two_frames_is_near_the_bound() -> None:
    s = PRESETS["ut4"]()
    for mode, found in enumerate(exact_residuals("lqg-multirate-multi", s)):
        assert 1.0 < found.rms / bound_rms(s, mode, 1, information="both")["total"] < 1.05


def test_what_has_none_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="none: the exact residual is that of a stable linear law"):
        exact_residuals("none", MATCHED)
    monkeypatch.setitem(CONTROLLERS, "mine", replace(CONTROLLERS["integrator+gpr-online"], id="mine"))
    for name in ("integrator+gpr-online", "mine"):
        with pytest.raises(ValueError, match=rf"{re.escape(name)}: the exact"):
            exact_residuals(name, MATCHED)
    with pytest.raises(ValueError, match="not known"):
        exact_residuals("integrator", PRESETS["lost-frames"]())
