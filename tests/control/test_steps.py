"""Controllers frame by frame: the commands over the record again, in every preset, with gaps, events, delays and limits."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import wfsobs
from tests.records import short, third_of_pairs
from wfsobs import PRESETS
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.mirror import Law
from wfsobs.control.step import LinearLaws
from wfsobs.control.supervisor import SupervisedController
from wfsobs.observers.step import StepError
from wfsobs.priors_from.controllers import controller_arguments, own_settings, plant_of, prior_for
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.testing import run_loop

ROUNDING, GPR = 1e-12, 1e-9
"""Differences over the std of the commands: sums in another order; the kernel's condition number makes more of them in a GPR."""


@cache
def with_gaps(preset: str) -> tuple[Record, Scenario]:
    """A record of 0.8 s with missing measurements and NGS frames; events come at the same share of it."""
    record, scenario = short(preset)
    y, ngs, n = record.y_lgs.copy(), record.y_ngs.copy(), record.ratio
    y[np.r_[0, 1, 400:412, 500, 510]], y[600, 0] = np.nan, np.nan
    ngs[[n, 90 * n, 91 * n]] = ngs[100 * n, 0] = np.nan
    return replace(record, y_lgs=y, y_ngs=ngs), scenario.before_events


def difference(name: str, record: Record, scenario: Scenario) -> float:
    controller, settings, plant = CONTROLLERS[name], own_settings(CONTROLLERS[name], scenario), plant_of(scenario)
    told = prior_for(controller, scenario)
    measured, prior = controller_arguments(controller, record, settings, told)
    want, limited = controller.commands(controller.laws(told, plant, settings, record.n_modes), measured, prior, plant, settings)
    got = run_loop(wfsobs.design(name, scenario, sampling=record.sampling, train=record.training), measured)
    if plant.mirror.has_limits and name != "none":
        assert limited.any()
    return float(np.abs(got - want).max() / (want.std() or 1.0))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "preset"), third_of_pairs(CONTROLLERS, PRESETS)[::2])
def test_steps_are_the_run_over_the_record(name: str, preset: str) -> None:
    """On a sixth of the pairs: every controller on two presets or more, and two of them on each."""
    record, scenario = with_gaps(preset)
    assert difference(name, record, scenario) <= (GPR if "gpr" in name else ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize(
    "changes", [{"control.delay": 2.4}, {"control.stroke": 0.1, "control.rate": 0.01}], ids=["delay", "limits"]
)
def test_with_a_fraction_of_a_frame_of_delay_and_with_limits(name: str, changes: dict[str, float]) -> None:
    record, scenario = with_gaps("paper")
    assert difference(name, record, scenario.replace(changes)) <= (GPR if "gpr" in name else ROUNDING)


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_saved_state_and_a_reset(name: str) -> None:
    record, scenario = with_gaps("paper")
    one, other = (wfsobs.design(name, scenario, sampling=record.sampling, train=record.training) for _ in range(2))
    rows = np.nan_to_num(record.y_lgs[:300])
    ngs = [record.y_ngs[k] if k and k % record.ratio == 0 else None for k in range(300)]
    base = [one.update(y, n) for y, n in zip(rows, ngs, strict=True)]
    for y, n in zip(rows[:150], ngs[:150], strict=True):
        other.update(y, n)
    one.reset()
    one.load_state_dict(other.state_dict())
    np.testing.assert_array_equal([one.update(y, n) for y, n in zip(rows[150:], ngs[150:], strict=True)], base[150:])
    one.reset()
    np.testing.assert_array_equal([one.update(y, n) for y, n in zip(rows, ngs, strict=True)], base)


@pytest.mark.parametrize("name", ["lqg-kf-multi", "lqg-multirate-multi"])
def test_a_design_takes_over_without_a_bump(name: str) -> None:
    """The first commands of a design with other noise: near those that the old one would have given, where a start at rest is
    far off. Its own noise makes them differ by some percent."""
    record, scenario = with_gaps("paper")
    old = wfsobs.design(name, scenario, sampling=record.sampling)
    run_loop(old, record.measurements())
    changed = scenario.replace({"kalman.measurement_noise": "manual", "kalman.lgs_noise": 0.02, "kalman.ngs_noise": 0.012})
    new, rest = (wfsobs.design(name, changed, sampling=record.sampling) for _ in range(2))
    new.take_over(old)
    y = record.y_lgs[-1]
    want, got, cold = old.update(y), new.update(y), rest.update(y)
    assert np.abs(got - want).max() < 0.05 * np.abs(cold - want).max()


def test_a_limit_stops_an_integrator_beside_a_filter_in_another_mode() -> None:
    """Its commands are those beside another integrator, over the record and frame by frame, from a saved state too."""
    record, scenario = with_gaps("paper")
    integrator, settings = CONTROLLERS["integrator"], own_settings(CONTROLLERS["integrator"], scenario)
    plant = plant_of(scenario.replace({"control.stroke": 0.1, "control.rate": 20.0}))
    measured, prior = controller_arguments(integrator, record, settings, prior_for(integrator, scenario))
    laws = integrator.laws(prior, plant, settings, record.n_modes)
    mixed = (laws[0], replace(laws[1], gain=None))
    want, limited = integrator.commands(laws, measured, prior, plant, settings)
    got, _ = integrator.commands(mixed, measured, prior, plant, settings)
    assert limited[:, 0].mean() > 0.1
    np.testing.assert_allclose(got[:, 0], want[:, 0], rtol=0, atol=1e-14)
    steps, other, broken = (integrator.assemble(mixed, prior, plant, settings, record.sampling) for _ in range(3))
    np.testing.assert_allclose(run_loop(steps, measured), got, rtol=0, atol=1e-12)
    other.load_state_dict(steps.state_dict())
    broken.take_over(steps)
    commands = [controller.update(np.array([0.01, 0.02])) for controller in (steps, other, broken)]
    np.testing.assert_array_equal(commands[1:], [commands[0]] * 2)


def test_filters_of_a_longer_cycle_are_not_taken_over() -> None:
    """Their place in the cycle may be beyond the shorter one's."""
    step = np.eye(1), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1))
    long, brief = (LinearLaws([Law(PeriodicFilter([step] * n))]) for n in (5, 1))
    for _ in range(3):
        long.command(np.ones(1), None, np.zeros(1))
    with pytest.raises(StepError, match="cycles of another length"):
        brief.take_over(long)
    assert brief.command(np.ones(1), None, np.zeros(1)) == 0.0, "as it began"


def test_wrong_input_is_one_line_and_takes_no_frame() -> None:
    controller = wfsobs.design("lqg-multirate", PRESETS["paper"]())
    for given, match in (
        (([0.0],), r"y takes the shape \(2,\)"),
        (([0.0, np.inf],), "infinite in frame 0"),
        (([0.0, 0.0], [0.0, 0.0]), "one is due in every 5th"),
    ):
        with pytest.raises(StepError, match=match):
            controller.update(*given)
    assert controller.frame == 0
    with pytest.raises(StepError, match="not from integrator"):
        controller.take_over(wfsobs.design("integrator", PRESETS["paper"]()))
    with pytest.raises(StepError, match="state is that of another design"):
        controller.load_state_dict(wfsobs.design("integrator", PRESETS["paper"]()).state_dict())


@pytest.mark.parametrize(
    ("sent", "line"),
    [
        (np.zeros(3), r"lqg-kf-multi: amend: command takes the shape \(2,\), one number per mode, not \(3,\)"),
        (0.1, r"lqg-kf-multi: amend: command takes the shape \(2,\), one number per mode, not \(\)"),
        ([np.inf, 0.0], "lqg-kf-multi: amend: command is infinite in frame 0; .*"),
        ([0.0, np.nan], "lqg-kf-multi: amend: command has NaN; takes what the mirror was sent, finite numbers"),
        (np.ma.array([0.0, 0.1], mask=[0, 1]), "lqg-kf-multi: amend: command has NaN; .*"),
        ("ab", "lqg-kf-multi: amend: command takes real numbers, not text"),
    ],
)
@pytest.mark.parametrize("wrap", [lambda controller: controller, SupervisedController], ids=["alone", "supervised"])
def test_what_no_mirror_was_sent_is_one_line_and_changes_nothing(wrap: Any, sent: Any, line: str) -> None:
    controller, other = (wrap(wfsobs.design("lqg-kf-multi", PRESETS["paper"]())) for _ in range(2))
    for one in (controller, other):
        one.update([0.1, 0.2])
    with pytest.raises(StepError, match=f"^{line}$"):
        controller.amend(sent)
    for _ in range(3):
        np.testing.assert_array_equal(controller.update([0.1, 0.2]), other.update([0.1, 0.2]))
    controller.amend([0.0, 0.1])
    other.amend(np.array([0.0, 0.1]))
    np.testing.assert_array_equal(controller.update([0.1, 0.2]), other.update([0.1, 0.2]))
