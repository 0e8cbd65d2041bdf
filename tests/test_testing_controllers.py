"""The check of controllers accepts ours and refuses those that break a rule, each with the reason."""

from __future__ import annotations

import gc
from functools import partial
from typing import Any

import numpy as np
import pytest

from wfsobs.control.base import Controller
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.laws import integrator_law
from wfsobs.control.mirror import Law, Plant
from wfsobs.prior import Bands, Prior
from wfsobs.record import Measurements, Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.testing import QUICK, CheckError, check_controller

CALLS: list[int] = []


def half(_prior: Prior, _mode: int, plant: Plant, _settings: Any) -> Law:
    return integrator_law(plant.mirror, 0.5, 1.0)


def louder_every_time(prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    CALLS.append(0)
    return integrator_law(plant.mirror, 0.5 / len(CALLS), 1.0)


def unstable(_prior: Prior, _mode: int, plant: Plant, _settings: Any) -> Law:
    return integrator_law(plant.mirror, 1.2, 1.0)


def knows_the_scenario(scenario: Scenario, prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    return half(prior, mode, plant, settings)


class BackwardLaw(Law):
    """A law whose filter runs from the end of the record."""

    def run(self, z: np.ndarray) -> np.ndarray:
        return super().run(z[::-1])[::-1]


def backwards(prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    return BackwardLaw(**vars(half(prior, mode, plant, settings)))


def next_measurement(measured: Measurements, *_: Any) -> np.ndarray:
    return np.vstack([measured.z[1:], np.zeros((1, measured.n_modes))])


def own_command(measured: Measurements, *_: Any) -> np.ndarray:
    """What the loop that made the record commands at this very step."""
    return 0.1 * measured.u


def the_truth(measured: Measurements, *_: Any) -> np.ndarray:
    """Looks for it in the memory of the process."""
    for x in gc.get_objects():
        if isinstance(x, Record) and x.vibration is not None and x.y_lgs.shape == measured.y_lgs.shape:
            return x.vibration
    return np.zeros_like(measured.z)


def one_column(measured: Measurements, *_: Any) -> np.ndarray:
    return measured.z[:, 0]


def in_place(measured: Measurements, *_: Any) -> np.ndarray:
    measured.u[...] = 0.0
    return np.zeros_like(measured.z)


def of_settings(measured: Measurements, _prior: Prior, _plant: Plant, settings: Any, _watch: Any) -> np.ndarray:
    settings.control.gain = 0.7
    return np.zeros_like(measured.z)


def infinite(measured: Measurements, *_: Any) -> np.ndarray:
    out = np.zeros_like(measured.z)
    out[100] = np.inf
    return out


def none_where_still(measured: Measurements, *_: Any) -> np.ndarray:
    """Infinite where a measurement is for the first time that of the step before, as held ones are."""
    out, still = np.zeros_like(measured.z), (measured.z[1:] == measured.z[:-1]).all(axis=1)
    if still.any():
        out[np.argmax(still)] = np.inf
    return out


def predicting(predict: Any) -> Controller:
    return Controller("mine", "Mine", half, predict=predict, prior=(Bands,), settings=("control",))


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
def test_ours_pass(name: str) -> None:
    shorter = PRESETS["paper"]().replace({**QUICK, "run.duration": 0.8})
    check_controller(CONTROLLERS[name], shorter, alone=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lqg-multirate-multi", "integrator+gpr-offline"])
def test_ours_are_the_same_in_a_fresh_process(name: str) -> None:
    check_controller(CONTROLLERS[name])


@pytest.mark.slow
def test_one_of_a_few_lines_passes() -> None:
    check_controller(Controller("mine", "Mine", half))


@pytest.mark.parametrize(
    ("law", "reason"),
    [
        (louder_every_time, "gives two results: it keeps something between runs"),
        (unstable, "not within the unit circle"),
        (backwards, "looks ahead: measurements after step "),
        (partial(knows_the_scenario, Scenario()), "uses more than it is given: it reaches Run, Scenario"),
        (lambda prior, mode, plant, settings: 0.5, "takes a wfsobs.control.mirror.Law, not a float"),
    ],
)
def test_a_law_that_breaks_a_rule_is_refused_with_the_reason(law: Any, reason: str) -> None:
    CALLS.clear()
    with pytest.raises(CheckError, match=f"^mine: .*{reason}"):
        check_controller(Controller("mine", "Mine", law), alone=False)


@pytest.mark.parametrize(
    ("predict", "reason"),
    [
        (next_measurement, "looks ahead: measurements after step "),
        (own_command, "looks ahead: measurements after step "),
        (one_column, r"shape \(1500, 2\)"),
        (lambda *_: {}[1], "cannot run: KeyError: 1$"),
        (in_place, r"changes its arguments \(measurements\)"),
        (of_settings, r"changes its arguments \(settings\)"),
        (infinite, "a command is NaN or infinite$"),
        (none_where_still, "NaN or infinite after missing samples"),
    ],
)
def test_a_prediction_that_breaks_a_rule_is_refused_with_the_reason(predict: Any, reason: str) -> None:
    with pytest.raises(CheckError, match=f"^mine: .*{reason}"):
        check_controller(predicting(predict), alone=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("predict", "reason"),
    [
        (the_truth, "in a fresh process.* it uses more than it is given"),
        (lambda m, *_: 0.1 * m.z, "cannot run in a fresh process"),
    ],
)
def test_what_finds_the_truth_some_other_way_is_seen_in_a_fresh_process(predict: Any, reason: str) -> None:
    with pytest.raises(CheckError, match=f"^mine: .*{reason}"):
        check_controller(predicting(predict))


def test_the_truth_in_an_argument_would_be_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The door itself, left open: measurements that are the record."""
    from wfsobs import testing as module

    real = module.controller_arguments
    monkeypatch.setattr(module, "controller_arguments", lambda c, record, *rest: (record, real(c, record, *rest)[1]))
    with pytest.raises(CheckError, match="it reaches Record, turbulence, vibration"):
        check_controller(CONTROLLERS["lqg-kf-lgs"], alone=False)


def test_one_that_predicts_is_told_where_the_vibration_is() -> None:
    with pytest.raises(ValueError, match="'mine': with a prediction it needs Bands"):
        Controller("mine", "Mine", half, predict=next_measurement)
