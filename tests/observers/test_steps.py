"""Observers frame by frame: the run over the record again, in every preset, with gaps and events."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import wfsobs
from wfsobs import PRESETS, simulate
from wfsobs.observers import OBSERVERS
from wfsobs.observers.kalman.step import matrix_power
from wfsobs.observers.step import StepError
from wfsobs.prior import Lines, Model
from wfsobs.priors_from.scenario import arguments, kalman_model, measurement_noise, prior_of
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.signal.riccati import steady_state
from wfsobs.testing import QUICK
from wfsobs.testing.steps import run_steps, step_difference

STEPS = [name for name, observer in OBSERVERS.items() if observer.step is not None]

ROUNDING, GPR = 1e-12, 1e-9
"""Differences over the std of an estimate: sums in another order; the kernel's condition number makes more of them in a GPR."""


def short(preset: str) -> Scenario:
    """The preset with a record of 0.8 s; events come at the same share of it."""
    s = PRESETS[preset]()
    events = [e.to_dict() | {k: getattr(e, k) * 0.8 / s.run.duration for k in ("start", "duration")} for e in s.events]
    return s.replace({**QUICK, "run.duration": 0.8, "events": events})


@cache
def with_gaps(preset: str) -> tuple[Record, Scenario]:
    """A record with missing measurements of all and of single modes, commands and NGS frames, some at the start."""
    scenario = short(preset)
    record = simulate(scenario)
    y, u, ngs = record.y_lgs.copy(), record.u.copy(), record.y_ngs.copy()
    n = record.ratio
    lost = np.unique(np.concatenate([[0, 1], np.arange(400, 412), np.random.default_rng(5).integers(500, 800, 30)]))
    y[lost], y[600, 0], u[[0, 500, 501]] = np.nan, np.nan, np.nan
    ngs[[n, 90 * n, 91 * n]] = ngs[100 * n, 0] = np.nan
    return replace(record, y_lgs=y, u=u, y_ngs=ngs), scenario.before_events


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", STEPS)
def test_steps_are_the_run_over_the_record(name: str, preset: str) -> None:
    record, scenario = with_gaps(preset)
    try:
        given = arguments(OBSERVERS[name], record, scenario)
    except ValueError:  # a vibration that is a table has no lines
        with pytest.raises(ValueError, match="table, not lines"):
            wfsobs.design(name, scenario, sampling=record.sampling)
        return
    assert step_difference(OBSERVERS[name], *given) <= (GPR if name.startswith("gpr") else ROUNDING)


def test_every_causal_observer_has_steps() -> None:
    assert [name for name, observer in OBSERVERS.items() if observer.step is None] == ["butterworth-ol"]


def test_the_public_door_gives_the_same() -> None:
    record, scenario = with_gaps("paper")
    for prior in (scenario, prior_of(scenario, record, (Model, Lines))):
        got = run_steps(wfsobs.design("kf-lgs", prior, scenario=scenario), record.measurements())
        batch = OBSERVERS["kf-lgs"].estimate(*arguments(OBSERVERS["kf-lgs"], record, scenario))
        np.testing.assert_allclose(got["vibration"], batch["vibration"], rtol=0, atol=ROUNDING * np.std(batch["vibration"]))


@pytest.mark.parametrize("frames", [1, 3, 0.5, 2.25])
def test_predictions_and_their_sd(frames: float) -> None:
    """Oracle: the textbook filter, its state moved on by the exponential of its poles."""
    scenario = short("paper")
    record = simulate(scenario)
    observer = wfsobs.design("kf-lgs", scenario)
    run_steps(observer, record.measurements())
    model, noise = kalman_model(scenario, 0, record.dt), measurement_noise(scenario, 0)[0]
    steady, x = steady_state(model.A, model.C, model.Q, np.array(noise**2)), np.zeros(4)
    for z in record.z[:, 0]:
        x = model.A @ x
        x = x + steady.L[:, 0] * (z - model.C @ x)
    values, vectors = np.linalg.eig(model.A)
    power = np.real(vectors @ np.diag(np.exp(frames * np.log(values))) @ np.linalg.inv(vectors))
    for target in ("turbulence", "vibration"):
        mean, sd = observer.predict(frames, target)
        row = model.outputs[target] @ power
        np.testing.assert_allclose(mean[0], row @ x, rtol=1e-9)
        if frames == int(frames):
            P = steady.posterior
            for _ in range(int(frames)):
                P = model.A @ P @ model.A.T + model.Q
            np.testing.assert_allclose(sd[0], np.sqrt(model.outputs[target] @ P @ model.outputs[target]), rtol=1e-9)


def test_sd_of_a_fraction_is_between_those_of_whole_frames() -> None:
    """To 1e-3: an AR(2) process is not exactly a sampled oscillator."""
    observer = wfsobs.design("kf-multi", PRESETS["paper"]())
    observer.update([0.0, 0.0])
    before, between, after = (observer.predict(f, "vibration")[1][0] for f in (4, 4.5, 5))
    assert before * (1 - 1e-3) < between < after * (1 + 1e-3)
    assert before < after


def test_a_power_composes() -> None:
    A = kalman_model(PRESETS["paper"](), 0, 1e-3).A
    np.testing.assert_allclose(matrix_power(A, 0.25) @ matrix_power(A, 0.75), A, atol=1e-12)


def test_a_design_takes_over_without_a_bump() -> None:
    """The same processes, other strengths: each goes on where it was. Fewer lines: the sums do."""
    record, scenario = with_gaps("ut4")
    for name, change in (
        ("kf-multi", {"kalman.lgs_noise": 0.05, "kalman.measurement_noise": "manual"}),
        ("kf-lgs", {"kalman.vibration_rms": 0.1, "kalman.process_noise": "manual"}),
    ):
        old = wfsobs.design(name, scenario, sampling=record.sampling)
        run_steps(old, record.measurements())
        new = wfsobs.design(name, scenario.replace(change), sampling=record.sampling)
        new.take_over(old)
        for target in old.targets:
            was = old.predict(0, target)[0]
            np.testing.assert_allclose(new.predict(0, target)[0], was, rtol=0, atol=1e-9 * np.std(record.vibration))
        new.update(record.z[-1])  # goes on


def refused(match: str):
    return pytest.raises(StepError, match=match)


def test_wrong_input_is_one_line_and_takes_no_frame() -> None:
    observer = wfsobs.design("multirate", PRESETS["paper"]())
    with refused(r"z takes the shape \(2,\)"):
        observer.update([0.0])
    with refused("infinite in frame 0"):
        observer.update([0.0, np.inf])
    with refused("one is due in every 5th"):
        observer.update([0.0, 0.0], [0.0, 0.0])
    assert observer.frame == 0
    observer.update([0.0, np.nan])
    with refused("it estimates turbulence"):
        observer.predict(0, "vibration")
    with refused("takes 0 or more"):
        observer.predict(-1)
    with refused("predict takes a target"):
        wfsobs.design("kf-lgs", PRESETS["paper"]()).predict(0)
    with refused("cannot run frame by frame"):
        wfsobs.design("butterworth-ol", PRESETS["paper"]())
    with refused("state is that of another design"):
        observer.load_state_dict(wfsobs.design("kf-lgs", PRESETS["paper"]()).state_dict())
    with refused("not from kf-lgs"):
        observer.take_over(wfsobs.design("kf-lgs", PRESETS["paper"]()))
