"""The coupled filter and the bound of coupled modes, against dense algebra, simulated records and the independent filters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import wfsobs
from tests.test_mode_spectra import FLOW
from wfsobs.campaign.plan import parse_plan
from wfsobs.campaign.sweep import parse_axis, plan_sweep
from wfsobs.evaluation.bound import bound, bound_rms
from wfsobs.evaluation.exact_errors import exact_errors, is_predicted
from wfsobs.evaluation.scores import BOUND, BOUND_MODES, SCORED, half_width
from wfsobs.evaluation.verdict import verdict
from wfsobs.execution import run_observer
from wfsobs.live.checks import observers_on
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.observers import OBSERVERS
from wfsobs.observers.kalman.joint import JointEstimator
from wfsobs.observers.kalman.joint_model import INDEPENDENT, AsterismModel, flow_model
from wfsobs.pipeline import observe, run
from wfsobs.prior import Flow, Lines
from wfsobs.priors_from.scenario import arguments, has_prior, prior_of, usual_observers
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.mode_spectra import mode_spectra
from wfsobs.testing import check_observer

LINE = {"frequency": 31.0, "damping": 0.02, "rms": [0.05, 0.04]}
SHAKEN = FLOW.replace({"vibration.source": "peaks", "vibration.peaks": [LINE], "vibration.cutoff": 60.0})


def model_of(scenario: Scenario) -> AsterismModel:
    return flow_model(prior_of(scenario, None, (Lines, Flow)), scenario.multipeak)


def stated(scenario: Scenario, target: str = "turbulence") -> np.ndarray:
    return model_of(scenario).plan(0.0, target)[1][-1]


@pytest.mark.slow
def test_the_bound_is_that_of_dense_algebra() -> None:
    """From 400 measurements of each of five modes, in which the wind crosses the aperture four times, to 1 %; more of the past
    helps tilt, across the wind, by 5 %.
    """
    past, n, modes = 400, 2**15, range(5)
    frequency = np.hypot(np.fft.rfftfreq(n, FLOW.dt), 1.0 / (n * FLOW.dt))
    found = mode_spectra(FLOW, frequency)
    among = np.fft.irfft(found.measurement, n) * (0.5 / FLOW.dt)
    with_target = np.fft.irfft(found.cross, n)[:, :, 1 : past + 1] * (0.5 / FLOW.dt)  # z[k] is of step k - 1
    ages = np.arange(past)
    covariance = among[:, :, (ages - ages[:, None]) % n].transpose(0, 2, 1, 3).reshape(5 * past, 5 * past)
    noise = prior_of(FLOW, None, (Lines,)).lines[0].noise
    weights = np.linalg.solve(covariance + noise**2 * np.eye(5 * past), with_target.reshape(5, -1).T)
    explained = np.einsum("ti,it->t", with_target.reshape(5, -1), weights)
    own = np.fft.irfft(found.own, n)[:, 0] * (0.5 / FLOW.dt)
    dense = np.sqrt(own - explained)
    least = np.array([one["turbulence"].rms for one in bound(FLOW, information="modes")])
    assert (least < 1.001 * dense).all()
    np.testing.assert_allclose(np.delete(least, 1), np.delete(dense, 1), rtol=0.015)
    assert least[1] > 0.93 * dense[1]
    alone = [bound_rms(FLOW, mode)["turbulence"] for mode in modes]
    assert (least < 0.95 * np.array(alone)).all() and least[0] < 0.6 * alone[0]


@pytest.mark.slow
def test_its_bound_is_a_row_of_its_table_and_of_no_other() -> None:
    short = SHAKEN.replace({"run.duration": 2.0, "run.warm_up": 1.0})
    result = run(short, observers=["kf-coupled"])
    rows, alone = ({(s.target, s.mode): s.rms for s in result.scores if s.observer == row} for row in (BOUND_MODES, BOUND))
    names = [mode.name for mode in short.modes]
    least = bound(short, information="modes")
    found = {(target, name): one[target].rms for one, name in zip(least, names, strict=True) for target in SCORED}
    assert rows == {key: min(value, alone[key]) for key, value in found.items()}, "no higher than that of a mode by itself"
    assert not [s for s in run(short, observers=["zero"]).scores if s.observer == BOUND_MODES]
    said = verdict(short, result.record, result.estimates, result.scores, "turbulence", names[0])
    assert said is not None and "the theoretical limit using the LGS in all modes" in said.sentences()[0]


@pytest.mark.slow
def test_what_it_states_is_near_the_bound_and_below_the_independent_filters() -> None:
    alone = exact_errors(OBSERVERS["kf-multi"], SHAKEN)
    least = bound(SHAKEN, information="modes")
    for target in ("turbulence", "vibration", "total"):
        found = stated(SHAKEN, target)
        for mode in range(2):
            assert least[mode][target].rms * 0.999 < found[mode] < 1.05 * least[mode][target].rms
            assert found[mode] < alone[mode][target].rms


@pytest.mark.slow
def test_errors_are_as_it_states() -> None:
    """On records of 60 s through ideal sensors: errors go on for a second or so, so that each rms is known to some 5 %."""
    scenario = SHAKEN.replace({"run.duration": 60.0, "run.seed": 3})
    record = simulate(scenario)
    found = run_observer("kf-coupled", record, scenario)
    for target, truth in (("turbulence", record.turbulence), ("vibration", record.vibration)):
        error = np.sqrt(np.mean((found[target] - truth)[2000:] ** 2, axis=0))
        np.testing.assert_allclose(error[:2], stated(scenario, target)[:2], rtol=0.12)
    assert (found["vibration"][:, 2:] == 0.0).all()  # tip and tilt alone vibrate


@pytest.mark.slow
def test_its_bands_hold_what_they_say() -> None:
    """300 s of tip and tilt: 68 and 95 % within 2 percentage points."""
    scenario = SHAKEN.replace({"telescope.radial_order": 1, "run.duration": 300.0})
    record = simulate(scenario)
    found = OBSERVERS["kf-coupled"].estimate(*arguments(OBSERVERS["kf-coupled"], record, scenario))
    for target, values in found.items():
        error, sd = (values - record.truth(target))[2000:], found.sd[target][2000:]
        for share in (0.68, 0.95):
            assert abs(np.mean(np.abs(error) <= half_width(share) * sd) - share) < 0.02, target


@pytest.mark.parametrize("changes", [{}, {"telescope.radial_order": 3}, {"turbulence.source": "ar3"}])
def test_where_modes_are_independent_it_refuses_and_runs_only_if_named(changes: dict[str, object]) -> None:
    scenario = wfsobs.PRESETS["paper"]().replace({"run.duration": 1.0, "run.warm_up": 0.1, **changes})
    record = simulate(scenario)
    (line,) = observe(record, scenario, observers=["kf-coupled"]).failures
    assert line.reason == f"kf-coupled left out: {INDEPENDENT}"
    with pytest.raises(ValueError, match="modes tell nothing of one another"):
        wfsobs.design("kf-coupled", scenario)
    assert "kf-coupled" not in {*usual_observers(scenario), *observers_on(SimulatedLoop(scenario), scenario)}
    assert not has_prior(OBSERVERS["kf-coupled"], FLOW, n_modes=1), "as of a record of one mode"


def test_who_names_no_observer_has_it_where_modes_are_coupled() -> None:
    """In a run, in a live loop, and in plans of which every scenario has coupled modes."""
    assert "kf-coupled" in usual_observers(FLOW) and "kf-coupled" in observers_on(SimulatedLoop(FLOW), FLOW)
    wind, source = parse_axis("turbulence.wind_speed=5,10"), parse_axis("turbulence.source=frozen-flow,ar2")
    assert plan_sweep(FLOW, [wind], 1).observers == tuple(usual_observers(FLOW))
    for axes in ([source], [wind, source]):
        assert plan_sweep(FLOW, axes, 1).observers == tuple(name for name in usual_observers(FLOW) if "coupled" not in name)
    assert plan_sweep(FLOW, [source], 1, ["kf-coupled"]).observers == ("kf-coupled",)
    for presets, has in ((("higher-orders",), True), (("higher-orders", "paper"), False)):
        text = "\n".join(f'[[scenario]]\npreset = "{name}"' for name in presets)
        assert ("kf-coupled" in parse_plan(text, Path()).observers) == has


@pytest.mark.slow
def test_it_keeps_the_rules_of_observers() -> None:
    check_observer(OBSERVERS["kf-coupled"], SHAKEN.replace({"run.duration": 1.5}), alone=False)


def test_predictions_go_on_from_the_estimate() -> None:
    """A fraction of a step lies between; what is far ahead is as uncertain as the truth."""
    model = model_of(SHAKEN)
    for target, truth in (
        ("turbulence", np.sqrt(prior_of(SHAKEN, None, (Flow,)).flow.own.sum(axis=1))[:2]),
        ("vibration", [0.05, 0.04]),
    ):
        sd = np.array([model.plan(frames, target)[1][-1, :2] for frames in (0.0, 0.5, 1.0, 1.5, 2.0, 1e5)])
        assert (np.diff(sd, axis=0) > 0).all()
        np.testing.assert_allclose(sd[-1], truth, rtol=0.02)


def test_a_mode_is_told_by_the_others() -> None:
    """A pulse in one mode is answered in those of its parity across the wind, by `kf-multi` in its own alone."""
    observer = wfsobs.design("kf-coupled", FLOW)
    observer.update(np.array([0.1, 0.0, 0.0, 0.0, 0.0]))
    answer = np.abs(observer.predict(1, "turbulence")[0])
    assert isinstance(observer.estimator, JointEstimator)
    assert (answer[[0, 2, 4]] > 1e-4).all() and (answer[[1, 3]] < 1e-9).all()


def test_a_new_design_takes_over() -> None:
    old, new = (wfsobs.design("kf-coupled", SHAKEN.replace({"sensors.lgs_noise": noise})) for noise in (0.02, 0.0201))
    rng = np.random.default_rng(0)
    for _ in range(200):
        old.update(rng.standard_normal(5))
    new.take_over(old)
    np.testing.assert_allclose(new.predict(0, "turbulence")[0], old.predict(0, "turbulence")[0], atol=0.02)


def test_a_new_design_with_another_line_takes_over() -> None:
    """The turbulence is where it was, and so is the sum of the lines."""
    weak = {"frequency": 47.0, "damping": 0.02, "rms": [0.001, 0.001]}
    old, new = wfsobs.design("kf-coupled", SHAKEN), wfsobs.design("kf-coupled", SHAKEN.replace({"vibration.peaks": [LINE, weak]}))
    rng = np.random.default_rng(0)
    for _ in range(200):
        old.update(0.1 * rng.standard_normal(5))
    new.take_over(old)
    for target in ("turbulence", "vibration"):
        before = old.predict(0, target)[0]
        np.testing.assert_allclose(new.predict(0, target)[0], before, atol=0.05 * np.abs(before).max())


def test_figures_of_single_modes_leave_it_out() -> None:
    assert not is_predicted(OBSERVERS["kf-coupled"], "turbulence")
    with pytest.raises(ValueError, match="every mode by itself"):
        exact_errors(OBSERVERS["kf-coupled"], SHAKEN)
    with pytest.raises(ValueError, match="independent"):
        bound(FLOW.replace({"turbulence.source": "ar2"}), information="modes")
