"""Every star as a sensor of its own: what a record holds, the filter, and its bound, against dense algebra and records."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import wfsobs
from wfsobs.evaluation.bound import bound, bound_rms
from wfsobs.evaluation.scores import half_width
from wfsobs.execution import run_observer
from wfsobs.live.board import SLOTS
from wfsobs.live.checks import check_slot
from wfsobs.observers import OBSERVERS
from wfsobs.observers.kalman.joint import AsterismEstimator
from wfsobs.observers.kalman.joint_model import ALIKE, FRAME_MEANS, MEANS, AsterismModel
from wfsobs.observers.step import StepError
from wfsobs.prior import Asterism, Lines, Prior
from wfsobs.priors_from.scenario import arguments, prior_of, usual_observers
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.gains import lyapunov
from wfsobs.signal.joint_states import PresentInputs, StateFilter, frame_shares
from wfsobs.signal.statespace import disturbance_model
from wfsobs.simulation.disturbance import line_width
from wfsobs.simulation.flow_spectra import star_basis
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.sensing import lgs_weights
from wfsobs.telemetry.records import load_record, save_record
from wfsobs.testing import check_observer, step_difference

STARS = wfsobs.PRESETS["paper"]().replace(
    {
        "turbulence.source": "frozen-flow",
        "turbulence.layers": [
            {"height": 0.0, "fraction": 0.5, "wind_direction": 0.0},
            {"height": 6000.0, "fraction": 0.5, "wind_direction": 70.0, "wind_factor": 1.5},
        ],
        "turbulence.outer_scale": 10.0,
        "turbulence.wind_speed": 20.0,
        "sensors.kind": "zernike",
        "sensors.lgs_count": 3,
        "sensors.lgs_radius": 20.0,
        "vibration.source": "ar2",
        "vibration.peaks": [{"frequency": 31.0, "damping": 0.02, "rms": [0.05, 0.04]}],
        "kalman.process_noise": "matched",
        "kalman.measurement_noise": "matched",
        "run.duration": 3.0,
        "run.warm_up": 0.5,
    }
)
"""Three LGS far from the axis, two layers, one broad line that is the AR(2) process of the model."""


@cache
def recorded() -> Record:
    return simulate(STARS)


def model_of(scenario: Scenario) -> AsterismModel:
    prior = prior_of(scenario, None, (Lines, Asterism))
    return AsterismModel(prior, scenario.multipeak, scenario.sensors.exposure_ratio)


def stated(scenario: Scenario, target: str, model: AsterismModel | None = None) -> np.ndarray:
    """Rms over the steps of a frame, (n_modes,) [um]."""
    return np.sqrt(np.mean((model or model_of(scenario)).plan(0.0, target)[1][:-1] ** 2, axis=0))


class TestRecord:
    def test_the_mean_of_the_stars_is_the_measurement(self) -> None:
        """The combination is the mean here; sums are in another order."""
        record = recorded()
        assert record.y_stars is not None and record.y_stars.shape == (record.n_steps, 3, 2)
        np.testing.assert_allclose(record.y_stars.mean(axis=1), record.y_lgs, rtol=0, atol=1e-13)
        np.testing.assert_allclose(record.z_stars.mean(axis=1), record.z, rtol=0, atol=1e-13)

    def test_a_combination_is_made_of_the_stars(self) -> None:
        """That of minimum variance, of pseudo-open-loop measurements, by its own weights."""
        scenario = STARS.replace({"sensors.lgs_combination": "minimum-variance"})
        record = simulate(scenario)
        np.testing.assert_allclose(np.einsum("kij,nij->nk", lgs_weights(scenario), record.z_stars), record.z, rtol=0, atol=1e-12)

    def test_stars_that_see_the_same_are_not_apart(self) -> None:
        record = simulate(STARS.replace({"sensors.lgs_radius": 0.0}))
        assert record.y_stars is None
        with pytest.raises(RecordError, match="no y_stars"):
            _ = record.z_stars

    def test_a_file_keeps_them(self, tmp_path: Path) -> None:
        record = replace(recorded(), y_stars=recorded().y_stars.copy())
        record.y_stars[100:110, 1] = np.nan
        save_record(tmp_path / "r.npz", record)
        np.testing.assert_array_equal(load_record(tmp_path / "r.npz").y_stars, record.y_stars)
        np.savez(tmp_path / "bad.npz", y_lgs=record.y_lgs, u=record.u, dt=record.dt, y_stars=record.y_stars[:, :, :1])
        with pytest.raises(RecordError, match=r"y_stars has shape \(3000, 3, 1\); expected \(3000, n_lgs, 2\)"):
            load_record(tmp_path / "bad.npz")


def test_lasers_that_are_out_have_no_number_and_the_estimates_have() -> None:
    """The first stars are those that work."""
    events = [{"kind": "laser", "start": 1.0, "duration": 0.5, "lasers": 1}]
    scenario = STARS.replace({"run.duration": 2.0, "events": events})
    record = simulate(scenario)
    np.testing.assert_array_equal(np.isnan(record.y_stars).sum(axis=0), [[0, 0], [0, 0], [500, 500]])
    assert all(np.isfinite(values).all() for values in run_observer("kf-asterism", record, scenario.before_events).values())


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_shares_are_those_of_a_simulation(lost: int) -> None:
    """Of the lifted recursion, written out step by step: powers of its matrices summed over a past of 40 times its memory;
    the last frames are not read, and the last of them is what the exposure has seen."""
    model = disturbance_model((), [Ar2(0.6, 0.1, 1.3, 1.0)])
    fast, slow = StateFilter(np.diag([0.0, 0.7]), np.array([1.0, 0.3])), StateFilter(np.diag([0.5]), np.array([0.5]))
    ratio, noise, frame_noise = 3, 0.4, 0.2
    found = frame_shares(fast, slow, ratio, model, noise, frame_noise, age=lost * ratio)
    n, past = len(model.A), 600
    S = lyapunov(model.A, model.Q)
    d_covariance = [S]
    for _ in range(past):
        d_covariance.append(model.A @ d_covariance[-1])  # E d[k + i] d[k]'
    # weights of z[k - a] in every state, and of the frames' noise
    for phase in range(ratio):
        age = lost * ratio + phase
        weights = np.zeros((3, past))
        for a in range(past):
            weights[:2, a] = np.linalg.matrix_power(fast.F, a) @ fast.G
            frame = (a - age) // ratio
            if a >= age:
                weights[2, a] = 0.5 * 0.5**frame / ratio
        r = np.array([(model.C @ d @ np.ravel(model.C)).item() for d in d_covariance[:past]])
        toeplitz = r[np.abs(np.subtract.outer(np.arange(past), np.arange(past)))]
        white = weights.copy()
        white[2] = 0.0
        states = weights @ toeplitz @ weights.T + noise**2 * white @ white.T
        states[2, 2] += frame_noise**2 * 0.25 / (1.0 - 0.25)
        np.testing.assert_allclose(found[phase].states, states, rtol=1e-9, atol=1e-12)
        cross = np.array([d_covariance[a] @ np.ravel(model.C) for a in range(past)]).T @ weights.T
        assert cross.shape == (n, 3)
        np.testing.assert_allclose(found[phase].disturbance, cross, rtol=1e-9, atol=1e-12)
        seen = np.zeros(past)
        seen[: ratio if lost and not phase else phase] = 1.0 / ratio
        mixed = seen @ toeplitz @ weights.T
        np.testing.assert_allclose(found[phase].exposure, mixed, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_what_it_states_is_near_the_bounds_and_below_that_of_the_mean() -> None:
    """With lines as wide as those of the record. Modes tell of one another: it may lie below the bound of single modes."""
    scenario = STARS.replace({"multipeak.line_width": line_width(STARS)})
    least, model = bound(STARS, information="asterism"), model_of(scenario)
    for target in ("turbulence", "vibration", "total"):
        found = stated(scenario, target, model)
        for mode in range(2):
            alone = bound_rms(STARS, mode, information="stars")[target]
            assert least[mode][target].rms * 0.999 < found[mode] < 1.06 * least[mode][target].rms
            assert 0.95 * alone < least[mode][target].rms < 1.001 * alone


@pytest.mark.slow
def test_errors_are_as_it_states() -> None:
    """Records of 3 s from eight seeds, after the first second: within three standard errors of the mean square."""
    squares: dict[str, list[np.ndarray]] = {"turbulence": [], "vibration": []}
    for seed in range(1, 9):
        scenario = STARS.replace({"run.seed": seed})
        record = simulate(scenario)
        found = run_observer("kf-asterism", record, scenario)
        for target, values in squares.items():
            values.append(np.mean((found[target] - record.truth(target))[1000:] ** 2, axis=0))
    for target, values in squares.items():
        mean, error = np.mean(values, axis=0), np.std(values, axis=0, ddof=1) / np.sqrt(len(values))
        assert (np.abs(mean - stated(STARS, target) ** 2) < 3.0 * error).all(), target


@pytest.mark.slow
def test_it_keeps_the_rules_of_observers() -> None:
    check_observer(OBSERVERS["kf-asterism"], STARS.replace({"run.duration": 1.5}), alone=False)


def test_steps_are_the_run_where_stars_and_frames_are_missing() -> None:
    record = replace(recorded(), y_stars=recorded().y_stars.copy(), y_ngs=recorded().y_ngs.copy())
    record.y_stars[500:700, 0] = record.y_stars[800:803] = np.nan
    record.y_ngs[600:640] = np.nan
    given = arguments(OBSERVERS["kf-asterism"], record, STARS)
    assert step_difference(OBSERVERS["kf-asterism"], *given) <= 1e-12
    found = OBSERVERS["kf-asterism"].estimate(*given)
    assert all(np.isfinite(values).all() for values in found.values())


def test_what_is_there_is_weighed_as_dense_algebra_does() -> None:
    """Of a random covariance of four inputs of two states each and one more state; the ridge of 1e-10 leaves 1e-7."""
    rng, stars = np.random.default_rng(5), 4
    root = rng.standard_normal((12, 9))
    each, basis = root.T @ root, star_basis(stars)
    turn = np.eye(9)
    turn[:8, :8] = np.kron(basis, np.eye(2))
    covariance, b = turn @ each @ turn.T, rng.standard_normal((3, 9))
    variance = np.sum(b @ np.linalg.inv(each) * b, axis=1) + 1.0
    found = PresentInputs([covariance], basis, 8)
    for present in (
        (True,) * 4,
        (False, True, True, True),
        (True, False, False, True),
        (False, False, True, False),
        (False,) * 4,
    ):
        weights, sd = found.estimate([(b @ turn.T, variance)] * 2, present)
        of_inputs = np.repeat(present, 2)
        for phase, kept in enumerate((np.append(of_inputs, True), np.append(of_inputs, False))):
            dense = np.zeros((3, 9))
            dense[:, kept] = b[:, kept] @ np.linalg.inv(each[np.ix_(kept, kept)])
            np.testing.assert_allclose(weights[phase] @ turn, dense, rtol=0, atol=1e-7 * np.abs(dense).max(initial=1.0))
            np.testing.assert_allclose(sd[phase] ** 2, variance - np.sum(dense * b, axis=1), rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("combination", ["mean", "minimum-variance"])
def test_the_next_measurement_is_missed_as_it_states(combination: str) -> None:
    """With all LGS and, of the mean, with one out: six seeds, within three standard errors of the mean square."""
    events, squares = [{"kind": "laser", "start": 2.0, "duration": 1.0, "lasers": 1}], []
    for seed in range(1, 7):
        scenario = STARS.replace({"run.seed": seed, "sensors.lgs_combination": combination, "events": events})
        record = simulate(scenario)
        found = OBSERVERS["kf-asterism"].estimate(*arguments(OBSERVERS["kf-asterism"], record, scenario.before_events))
        missed, sd = record.z[1:] - (found["turbulence"] + found["vibration"])[:-1], found.sd["next z"]
        squares.append(
            [(missed[at] ** 2).mean(axis=0) / np.mean(sd[at] ** 2, axis=0) for at in (slice(500, 1990), slice(2100, -1))]
        )
    mean, error = np.mean(squares, axis=0), np.std(squares, axis=0, ddof=1) / np.sqrt(len(squares))
    within = np.abs(mean - 1.0) < 3.0 * error
    assert within[0].all() and (error < 0.1)[0].all()
    assert within[1].all() if combination == "mean" else np.isnan(mean[1]).all()


@pytest.mark.slow
def test_its_bands_hold_what_they_say() -> None:
    """80 s at 250 Hz, in which errors are independent some 1000 times: 68 and 95 % within 2 percentage points in every phase."""
    scenario = STARS.replace({"sensors.lgs_rate": 250.0, "run.duration": 80.0, "vibration.synthesis": "gaussian"})
    record, ratio = simulate(scenario), scenario.sensors.exposure_ratio
    found = OBSERVERS["kf-asterism"].estimate(*arguments(OBSERVERS["kf-asterism"], record, scenario))
    for target, values in found.items():
        error, sd = (values - record.truth(target))[2000:], found.sd[target][2000:]
        for phase in range(ratio):
            for share in (0.68, 0.95):
                inside = np.abs(error[phase::ratio]) <= half_width(share) * sd[phase::ratio]
                assert abs(np.mean(inside) - share) < 0.02, (target, phase)


def without_first(prior: Prior) -> Prior:
    """Of an asterism of the stars but the first."""
    own = prior.asterism
    assert own is not None
    n = len(own.basis)
    turn = np.zeros((n, n + 1))
    turn[:-1, :-1], turn[-1, -1] = star_basis(n - 1) @ np.linalg.inv(own.basis)[1:], 1.0
    measurement, cross = np.einsum("ab,bidjk,cd->aicjk", turn, own.measurement, turn), np.einsum("ab,ibjk->iajk", turn, own.cross)
    fewer = replace(own, measurement=measurement, cross=cross, basis=star_basis(n - 1))
    return replace(prior, asterism=fewer)


def test_a_star_that_is_always_out_leaves_the_filter_of_the_others() -> None:
    """Estimates and what is stated of them, as by a filter that knows of no other star; the ridge leaves 1e-5 of them."""
    record = replace(recorded(), y_stars=recorded().y_stars.copy())
    record.y_stars[:, 0] = np.nan
    prior, settings, ratio = prior_of(STARS, None, (Lines, Asterism)), STARS.multipeak, STARS.sensors.exposure_ratio
    found, others = (
        AsterismEstimator(AsterismModel(prior, settings, ratio)),
        AsterismEstimator(AsterismModel(without_first(prior), settings, ratio)),
    )
    for k in range(600):
        for one, stars in ((found, slice(None)), (others, slice(1, None))):
            one.see_each(record.z_stars[k, stars])
            one.advance(record.z[k], record.z_ngs[k] if k and k % ratio == 0 else None, None)
        for target in ("turbulence", "vibration"):
            for frames in (0.0, 1.5):
                (a, sd), (b, other_sd) = found.predict(frames, target), others.predict(frames, target)
                np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * 0.1)
                np.testing.assert_allclose(sd, other_sd, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("lasers", [1, 3])
def test_errors_while_lasers_are_out_are_as_it_states(lasers: int) -> None:
    """From eight seeds, half a second after they went: within three standard errors of the mean square."""
    events = [{"kind": "laser", "start": 1.0, "duration": 2.0, "lasers": lasers}]
    squares: dict[str, list[np.ndarray]] = {"turbulence": [], "vibration": []}
    for seed in range(1, 9):
        record = simulate(STARS.replace({"run.seed": seed, "events": events}))
        given = arguments(OBSERVERS["kf-asterism"], record, STARS)
        found = OBSERVERS["kf-asterism"].estimate(*given)
        for target, values in squares.items():
            values.append(np.mean((found[target] - record.truth(target))[1500:] ** 2, axis=0))
    model, present = model_of(STARS), tuple(i < 3 - lasers for i in range(3))
    for target, values in squares.items():
        mean, error = np.mean(values, axis=0), np.std(values, axis=0, ddof=1) / np.sqrt(len(values))
        sd = model.plan(0.0, target, present)[1]
        assert (np.abs(mean - np.mean(sd[:-1] ** 2, axis=0)) < 3.0 * error).all(), target
        assert (sd > model.plan(0.0, target)[1]).all(), "with fewer it knows less"


def test_a_state_that_is_kept_while_stars_are_out_goes_on() -> None:
    """Bit by bit as a filter that was never kept: at frames where one star is out, all are, and one is again."""
    record, model, ratio = recorded(), model_of(STARS), STARS.sensors.exposure_ratio
    each = record.z_stars.copy()
    each[40:90, 1], each[60:70] = np.nan, np.nan
    whole, one = AsterismEstimator(model), AsterismEstimator(model)
    for k in range(120):
        if k in (50, 65, 80):
            saved, one = one.save(), AsterismEstimator(model)
            one.load(saved)
            np.testing.assert_array_equal(one.predict(0.0, "vibration"), whole.predict(0.0, "vibration"))
        for each_filter in (whole, one):
            each_filter.see_each(each[k])
            each_filter.advance(record.z[k], record.z_ngs[k] if k and k % ratio == 0 else None, None)
        np.testing.assert_array_equal(one.predict(0.0, "turbulence"), whole.predict(0.0, "turbulence"))


def test_before_the_first_frame_it_knows_less() -> None:
    sd = model_of(STARS).plan(0.0, "turbulence")[1]
    assert (sd[-1] > sd[:-1].max(axis=0)).all() and (sd[0] < sd[-2]).all(), "and most when a frame has just been read"


def test_where_all_see_the_same_it_refuses_and_runs_only_if_named() -> None:
    alike = STARS.replace({"sensors.lgs_radius": 0.0})
    assert "kf-asterism" not in usual_observers(alike) and "kf-asterism" in usual_observers(STARS)
    record = simulate(alike)
    (line,) = wfsobs.observe(record, alike, observers=["kf-asterism"]).failures
    assert line.reason == "kf-asterism left out: the record has no measurements of every LGS"
    with pytest.raises(ValueError, match=ALIKE):
        wfsobs.design("kf-asterism", alike)
    assert "kf-asterism" not in usual_observers(STARS, record), "a record of the mean alone"
    assert "kf-asterism" not in SLOTS
    with pytest.raises(SettingError, match="which no live source sends"):
        check_slot("kf-asterism")


def test_a_step_without_the_stars_is_refused_and_not_taken() -> None:
    observer = wfsobs.design("kf-asterism", STARS)
    with pytest.raises(StepError, match=r"update\(z, each=...\) of the shape \(3, 2\)"):
        observer.update(np.zeros(2))
    with pytest.raises(StepError, match="each is infinite"):
        observer.update(np.zeros(2), each=np.full((3, 2), np.inf))
    assert observer.frame == 0
    assert MEANS.G.size == FRAME_MEANS.G.size == 6
