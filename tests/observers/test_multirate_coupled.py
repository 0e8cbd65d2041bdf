"""The coupled filter of both sensors and its bound, against dense algebra, simulated records and the filter of the LGS alone."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import wfsobs
from tests.observers.test_coupled import SHAKEN
from tests.test_mode_spectra import FLOW
from wfsobs.evaluation.bound import bound
from wfsobs.evaluation.scores import BOUND_BOTH, BOUND_BOTH_MODES, half_width
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.joint_model import INDEPENDENT_ON_BOTH, AsterismModel, coupled_model, flow_model
from wfsobs.pipeline import observe, run
from wfsobs.prior import Flow, FlowOfBoth, LgsStars, Lines
from wfsobs.priors_from.scenario import arguments, prior_of, usual_observers
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.mode_spectra import combined_spectra
from wfsobs.testing import check_observer, step_difference

OBSERVER = OBSERVERS["multirate-coupled"]
LONG = SHAKEN.replace({"telescope.radial_order": 1, "run.duration": 160.0})
simulated = cache(simulate)


def model_of(scenario: Scenario) -> AsterismModel:
    return coupled_model(
        prior_of(scenario, None, (Lines, FlowOfBoth, LgsStars)), scenario.multipeak, scenario.sensors.exposure_ratio
    )


def test_the_bound_is_that_of_dense_algebra() -> None:
    """From 150 measurements of the LGS and 30 NGS frames, in which the wind crosses the aperture 1.5 times, in five modes: in a
    step with a frame and three steps later. What is older helps by less than 1 %.
    """
    scenario = FLOW
    past, frames, n, ratio, m = 150, 30, 2**13, scenario.sensors.exposure_ratio, len(scenario.modes)
    frequency = np.hypot(np.fft.rfftfreq(n, scenario.dt), 1.0 / (n * scenario.dt))
    found = combined_spectra(scenario, frequency)
    among = np.fft.irfft(found.measurement, n) * (0.5 / scenario.dt)  # E y_i[k] y_j[k - lag]
    cross = np.fft.irfft(found.cross, n) * (0.5 / scenario.dt)
    own = np.fft.irfft(found.own, n)[:, 0] * (0.5 / scenario.dt)
    prior = prior_of(scenario, None, (Lines, FlowOfBoth))
    assert prior.asterism is not None
    least = bound(scenario, information="both-modes")
    for phase in (0, 3):
        # disturbance at the age a (of z[k - a]: phi[k - 1 - a]), and frames that are the mean of n of them
        ages = [(i, np.array([a])) for a in range(past) for i in range(m)]
        ages += [(m + i, phase + ratio * j + np.arange(ratio)) for j in range(frames) for i in range(m)]
        noise = [*np.tile(prior.asterism.noise, past), *np.tile(prior.asterism.ngs_noise, frames)]
        beam, at = np.array([b for b, _ in ages]), [a for _, a in ages]
        longest = phase + ratio * frames
        weights = np.zeros((len(ages), longest))
        for row, a in zip(weights, at, strict=True):
            row[a] = 1.0 / len(a)
        lags = np.arange(longest)
        covariance, b = np.zeros((len(ages), len(ages))), np.zeros((m, len(ages)))
        for i in range(2 * m):
            rows = beam == i
            b[:, rows] = cross[:, i, 1 : longest + 1] @ weights[rows].T
            for j in range(2 * m):
                toeplitz = among[i, j][(lags - lags[:, None]) % n]
                covariance[np.ix_(rows, beam == j)] = weights[rows] @ toeplitz @ weights[beam == j].T
        dense = np.sqrt(own - np.sum(np.linalg.solve(covariance + np.diag(np.square(noise)), b.T) * b.T, axis=0))
        got = np.sqrt([of["turbulence"].variance[phase] for of in least])
        assert (got < 1.001 * dense).all() and (got > [0.99, 0.96, 0.99, 0.99, 0.99][:m] * dense).all()


def test_without_the_ngs_it_is_the_coupled_filter() -> None:
    """With frames of no use. What it states and what it answers are of the same covariances, in another order."""
    faint = SHAKEN.replace({"sensors.ngs_noise": 10.0})
    both, alone = model_of(faint), flow_model(prior_of(faint, None, (Lines, Flow)), faint.multipeak)
    for target in ("turbulence", "vibration"):
        for frames in (0.0, 1.5):
            sd = both.plan(frames, target)[1]
            np.testing.assert_allclose(sd, np.broadcast_to(alone.plan(frames, target)[1][-1], sd.shape), rtol=1e-4)
    np.testing.assert_allclose(both.next_z_sd((True,))[0], alone.next_z_sd((True,))[0], rtol=1e-4)


def test_a_gain_of_the_lgs_for_the_vibration_is_known() -> None:
    """That of a combination of stars, above one: the error of the next measurement is as stated, within 5 % of its rms."""
    stars = {"sensors.lgs_count": 3, "sensors.lgs_radius": 60.0, "sensors.lgs_combination": "minimum-variance"}
    scenario = SHAKEN.replace({**stars, "telescope.radial_order": 1, "run.duration": 60.0, "sensors.ngs_noise": 0.05})
    record = simulated(scenario)
    given = arguments(OBSERVER, record, scenario)
    assert given[1].asterism is not None and (given[1].asterism.line_gain > 1.2).all()
    found = OBSERVER.estimate(*given)
    missed = (found["turbulence"] + found["vibration"])[1000:-1] - record.z[1001:]
    stated = np.sqrt(np.mean(found.sd["next z"][1000:-1] ** 2, axis=0))
    np.testing.assert_allclose(np.sqrt(np.mean(missed**2, axis=0)), stated, rtol=0.05)


def test_with_two_lgs_of_four_it_is_as_sure_as_with_two() -> None:
    """States are those of filters for four; with all four it is 2 to 11 % surer."""
    of_four, of_two = (model_of(SHAKEN.replace({"sensors.lgs_count": count})) for count in (4, 2))
    fewer = of_four.late(0, 2)
    for target in TARGETS:
        for frames in (0.0, 1.5):
            np.testing.assert_allclose(fewer.plan(frames, target)[1], of_two.plan(frames, target)[1], rtol=5e-3)
    np.testing.assert_allclose(fewer.next_z_sd((True,)), of_two.next_z_sd((True,)), rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kf-coupled", "multirate-coupled"])
def test_with_two_lgs_of_four_errors_are_as_stated(name: str) -> None:
    """From a second after they went out; steps are the run."""
    out = [{"kind": "laser", "start": 20.0, "duration": 140.0, "lasers": 2}]
    scenario = LONG.replace({"sensors.lgs_count": 4, "events": out})
    record, at = simulated(scenario), slice(round(21.0 / scenario.dt), -1)
    given = arguments(OBSERVERS[name], record, scenario)
    found = OBSERVERS[name].estimate(*given)
    for target in TARGETS:
        error = np.mean((found[target] - record.truth(target))[at] ** 2, axis=0)
        np.testing.assert_allclose(error, np.mean(found.sd[target][at] ** 2, axis=0), rtol=0.1)
    short = scenario.replace({"run.duration": 2.0, "events": [out[0] | {"start": 1.0, "duration": 0.5}]})
    assert step_difference(OBSERVERS[name], *arguments(OBSERVERS[name], simulated(short), short)) <= 1e-12


@pytest.mark.slow
def test_its_bands_hold_what_they_say() -> None:
    """160 s of tip and tilt at 250 Hz: 68 and 95 % within 2 percentage points, in every phase of the frames."""
    record, ratio = simulated(LONG), LONG.sensors.exposure_ratio
    found = OBSERVER.estimate(*arguments(OBSERVER, record, LONG))
    errors = {target: found[target] - record.truth(target) for target in OBSERVER.targets}
    errors["total"] = errors["turbulence"] + errors["vibration"]
    errors["next z"] = found["turbulence"] + found["vibration"] - np.roll(record.z, -1, axis=0)
    for target, every in errors.items():
        for phase in range(ratio):
            at = slice(2000 + phase, -1, ratio)
            for share in (0.68, 0.95):
                inside = np.mean(np.abs(every[at]) <= half_width(share) * found.sd[target][at])
                assert abs(inside - share) < 0.02, (target, phase)


@pytest.mark.slow
def test_it_keeps_the_rules_of_observers() -> None:
    check_observer(OBSERVER, SHAKEN.replace({"run.duration": 1.5}), alone=False)


@pytest.mark.slow
def test_without_the_lgs_it_goes_on_with_the_ngs() -> None:
    """For 0.4 s of every second: from 0.2 s on errors are as stated; steps are the run, with NGS frames lost as well."""
    record = simulated(LONG)
    at = np.arange(record.n_steps)
    gone, late = at % 250 < 100, (at % 250 >= 50) & (at % 250 < 100)
    lossy = replace(record, y_lgs=np.where(gone[:, None], np.nan, record.y_lgs))
    found = OBSERVER.estimate(*arguments(OBSERVER, lossy, LONG))
    for target, values in found.items():
        assert np.isfinite(values).all()
        error, sd = (values - record.truth(target))[2000:][late[2000:]], found.sd[target][2000:][late[2000:]]
        # of 150 gaps, in which errors are some two independent ones
        np.testing.assert_allclose(np.sqrt(np.mean(error**2, axis=0)), np.sqrt(np.mean(sd**2, axis=0)), rtol=0.1)
    short = LONG.replace({"run.duration": 4.0})
    record = simulated(short)
    frames = record.y_ngs.copy()
    frames[[5, 300, 305, 620]] = np.nan
    lossy = replace(record, y_lgs=np.where(gone[:1000, None], np.nan, record.y_lgs), y_ngs=frames)
    assert step_difference(OBSERVER, *arguments(OBSERVER, lossy, short)) <= 1e-12


@pytest.mark.slow
def test_with_ngs_frames_lost_it_is_as_sure_as_it_says() -> None:
    """Half of them at random, then ten in a row: errors are as stated to 10 %, whatever the number that are lost in a row up to
    four; ten in a row leave no more than a tenth above what the LGS alone do."""
    record, ratio = simulated(LONG), LONG.sensors.exposure_ratio
    due = np.arange(ratio, record.n_steps, ratio)
    at, rng = np.arange(due.size), np.random.default_rng(5)
    lost = np.where(at < due.size // 2, rng.random(due.size) < 0.5, at % 40 >= 30)
    frames, in_a_row = record.y_ngs.copy(), np.zeros(record.n_steps, dtype=int)
    frames[due[lost]] = np.nan
    for k, is_lost in zip(due, lost, strict=True):
        in_a_row[k : k + ratio] = in_a_row[k - 1] + 1 if is_lost else 0
    lossy = replace(record, y_ngs=frames)
    found = OBSERVER.estimate(*arguments(OBSERVER, lossy, LONG))
    alone = OBSERVERS["kf-coupled"].estimate(*arguments(OBSERVERS["kf-coupled"], record, LONG))["turbulence"]
    for n in (0, 1, 2, 3, 4):
        steps = np.flatnonzero(in_a_row == n)[300:]
        for target, values in found.items():
            error, sd = (values - record.truth(target))[steps], found.sd[target][steps]
            np.testing.assert_allclose(np.sqrt(np.mean(error**2, axis=0)), np.sqrt(np.mean(sd**2, axis=0)), rtol=0.1)
    steps = np.flatnonzero(in_a_row == 10)
    late, without = (np.sqrt(np.mean((x - record.turbulence)[steps] ** 2)) for x in (found["turbulence"], alone))
    assert late < 1.1 * without


def test_where_modes_are_independent_it_refuses_and_runs_only_if_named() -> None:
    scenario = wfsobs.PRESETS["paper"]().replace({"run.duration": 1.0, "run.warm_up": 0.1})
    (line,) = observe(simulated(scenario), scenario, observers=[OBSERVER.id]).failures
    assert line.reason == f"multirate-coupled left out: {INDEPENDENT_ON_BOTH}"
    assert OBSERVER.id not in usual_observers(scenario) and OBSERVER.id in usual_observers(FLOW)
    with pytest.raises(ValueError, match="the bound of each is its own"):
        bound(scenario, information="both-modes")


def test_its_bound_is_a_row_of_its_table_and_no_higher_than_that_of_single_modes() -> None:
    short = SHAKEN.replace({"run.duration": 2.0, "run.warm_up": 1.0})
    rows = {(s.observer, s.target, s.mode): s.rms for s in run(short, observers=[OBSERVER.id]).scores}
    for one, mode in zip(bound(short, information="both-modes"), short.modes, strict=True):
        for target in TARGETS:
            alone = rows[BOUND_BOTH, target, mode.name]
            assert rows[BOUND_BOTH_MODES, target, mode.name] == min(one[target].rms, alone)
            if target == "turbulence":
                assert one[target].rms < 0.97 * alone
