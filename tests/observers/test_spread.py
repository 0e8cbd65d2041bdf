"""What observers state of their errors: true where their models are, the same frame by frame, and scored properly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import pi

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.special import ndtr

import wfsobs
from tests.records import ON_PAPER
from wfsobs.evaluation.scores import calibration, crps, half_width
from wfsobs.observers import OBSERVERS
from wfsobs.observers.gpr.offline import HELD, train
from wfsobs.observers.gpr.online import predict_sliding
from wfsobs.observers.gpr.windows import SquaredExponential
from wfsobs.observers.kalman.filters import MultiPeak
from wfsobs.prior import LgsError, Noise, Prior
from wfsobs.priors_from.scenario import observer_settings, prior_of
from wfsobs.record import Measurements
from wfsobs.signal.autoregressive import Ar2
from wfsobs.tuning.trials import log_marginal_likelihood
from wfsobs.typing import Array

RECORDS, STEPS, SETTLED, RATIO = 200, 3000, 1000, 5

WITH_MODEL = ["kf-lgs", "kf-multi", "kf-ngs", "multirate", "multirate-optimal", "multirate-multi", "gp-lgs", "gp-both"]


def told(name: str, between: str, records: int = RECORDS) -> tuple[Prior, object]:
    """The prior of one mode of the paper's preset, as often as there are records, and the settings."""
    scenario = wfsobs.PRESETS["paper"]().replace({"kalman.ngs_between_frames": between})
    observer = OBSERVERS[name]
    one = prior_of(scenario, None, (*observer.parts(observer_settings(observer, scenario)), Noise))
    slow = Ar2(2 * pi * 2.0, 0.9, 0.03, scenario.dt)  # of 2 Hz, so that a record of seconds holds many of its times
    prior = replace(
        one,
        model=one.model[:1] * records,
        noise=one.noise[:1] * records,
        lgs_error=(LgsError(slow),) * records if one.lgs_error else (),
        stars=one.stars[:1] * records,
        lines=one.lines[:1] * records,
        beams=tuple(replace(beams, lgs=(slow,)) for beams in one.beams[:1]) * records,
    )
    return prior, observer_settings(observer, scenario)


def own_record(name: str, prior: Prior, rng: np.random.Generator) -> tuple[Measurements, dict[str, Array]]:
    """Records drawn from the observer's own model, one per column, and the truth."""

    def draw(process: Ar2) -> Array:
        return np.column_stack([process.sample(STEPS, rng) for _ in range(RECORDS)])

    dt = 1e-3
    if prior.lines:
        lines, least = prior.lines[0], MultiPeak().line_width * pi
        peaks = [Ar2(2 * pi * f, max(xi, least / (2 * pi * f)), rms, dt) for f, xi, rms in lines.lines]
        truth = {"turbulence": sum(draw(p) for p in lines.turbulence), "vibration": sum(draw(p) for p in peaks)}
    else:
        truth = {"turbulence": draw(prior.model[0].turbulence), "vibration": draw(prior.model[0].vibration)}
    lgs, ngs = prior.noise[0]
    total = truth["turbulence"] + truth["vibration"]
    late = np.vstack([np.zeros((1, RECORDS)), total[:-1]])
    y = late + lgs * rng.standard_normal(late.shape)
    for slow in (*(error.process for error in prior.lgs_error[:1]), *(p for beams in prior.beams[:1] for p in beams.lgs)):
        y[1:] += draw(slow)[:-1]
    y_ngs = np.full_like(y, np.nan)
    for k in range(RATIO, STEPS, RATIO):
        seen = total[k - 1] if name == "multirate" else total[k - RATIO : k].mean(axis=0)
        y_ngs[k] = seen + ngs * rng.standard_normal(RECORDS)
    return Measurements(y, np.zeros_like(y), dt, y_ngs, RATIO), truth


@pytest.mark.slow
@pytest.mark.parametrize(("name", "between"), [(name, "hold") for name in WITH_MODEL] + [("kf-ngs", "propagate")])
def test_bands_hold_what_they_say_where_the_model_is_true(name: str, between: str) -> None:
    """200 records of the observer's own model, per target and phase of the NGS frame: within 2 percentage points."""
    prior, settings = told(name, between)
    measurements, truth = own_record(name, prior, np.random.default_rng(7))
    found = OBSERVERS[name].estimate(measurements, prior, settings)
    errors = {target: found[target] - truth[target] for target in OBSERVERS[name].targets}
    if len(errors) == 2:
        errors["total"] = errors["turbulence"] + errors["vibration"]
        ahead = np.vstack([measurements.z[1:], np.full((1, RECORDS), np.nan)])
        errors["next z"] = found["turbulence"] + found["vibration"] - ahead
    assert set(errors) <= found.sd.keys()
    for target, every in errors.items():
        error, sd = every[SETTLED:-1], found.sd[target][SETTLED:-1]
        for phase in range(RATIO):
            e, s = error[phase::RATIO], sd[phase::RATIO]
            for share in (0.68, 0.95):
                assert abs(np.mean(np.abs(e) <= half_width(share) * s) - share) < 0.02
            # 200 records of some ten independent errors each: their mean square is known to 5 %
            assert np.sqrt(np.mean(e**2)) == pytest.approx(float(np.sqrt(np.mean(s**2))), rel=0.05)


@pytest.mark.parametrize("name", [*WITH_MODEL, "kf-adaptive"])
def test_stated_frame_by_frame_as_over_a_record(name: str) -> None:
    """The numbers of `predict(0)`; its form loses 1e-13 of the signal's variance, 1e-9 of the error's."""
    scenario = wfsobs.PRESETS["paper"]().replace({"run.duration": 0.6, "run.warm_up": 0.1, "adaptive.window": 0.3})
    record = wfsobs.simulate(scenario)
    found = wfsobs.observe(record, scenario, observers=[name])
    step = wfsobs.design(name, scenario)
    sd = {target: np.full((record.n_steps, 2), np.nan) for target in step.targets}
    for k in range(record.n_steps):
        due = k > 0 and k % RATIO == 0
        step.update(record.z[k], record.z_ngs[k] if due else None)
        for target in step.targets:
            sd[target][k] = step.predict(0, target)[1]
    for estimate in found.estimates:
        np.testing.assert_allclose(estimate.sd, sd[estimate.target], rtol=1e-8)
        assert np.isfinite(sd[estimate.target][350:]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_PAPER)
def test_every_observer_with_a_model_states_something(name: str) -> None:
    changes = {"run.duration": 2.0, "gpr_online.training_size": 20, "gpr_offline.training_size": 50, "adaptive.window": 0.5}
    if name == "gpr-adaptive":  # half a second is too short for it to be sure of a line
        changes |= {"run.duration": 3.0, "adaptive.window": 1.0}
    known = slice(round(changes["run.duration"] * 500), None)
    found = wfsobs.run(wfsobs.PRESETS["paper"]().replace(changes), observers=[name])
    with_model = name.startswith(("kf", "multirate", "gp"))
    assert found.estimates
    for estimate in found.estimates:
        assert (estimate.sd is not None) == with_model
        if estimate.sd is not None:
            assert estimate.sd.shape == estimate.values.shape
            stated = np.isfinite(estimate.sd)
            assert not stated[np.isnan(estimate.values)].any() and stated[known].all()
            # zero where its model has no vibration: what was identified in a short window
            assert (estimate.sd[known] >= 0).all() and ("adaptive" in name or (estimate.sd[known] > 0).all())
    for score in found.scores:
        if score.observer == name:
            assert (score.calibration is not None) == with_model, score.target


def test_without_a_truth_the_next_measurement_is_stated() -> None:
    """By who estimates the whole disturbance; in the row, and there the rms of what is stated is that of the errors to 5 %."""
    scenario = wfsobs.PRESETS["paper"]().replace({"run.duration": 20.0, "vibration.source": "ar2"})
    record = replace(wfsobs.simulate(scenario), turbulence=None, vibration=None)
    by_frames = wfsobs.observe(record, scenario, observers=["kf-multi", "multirate", "ridge"])
    assert all(s.calibration is None for s in by_frames.scores)  # of the mean over a frame nothing is stated
    found = wfsobs.observe(replace(record, y_ngs=None, ratio=None), scenario, observers=["kf-multi", "ridge"])
    (row,) = (s for s in found.scores if s.observer == "kf-multi" and s.mode == "tip")
    assert row.target == "next z" and row.calibration is not None
    assert row.calibration.sd == pytest.approx(row.rms, rel=0.05)
    assert not [s for s in (*by_frames.scores, *found.scores) if s.observer in ("multirate", "ridge")]


KERNEL = SquaredExponential(1.0, 2.0, 0.1)


def functions_of_windows(signals: Array, depth: int, rng: np.random.Generator, count: int) -> Array:
    """Draw functions of the windows (n, count) of a signal (n,) from the Gaussian process itself."""
    n = len(signals)
    padded = np.concatenate([np.zeros(depth - 1), signals])
    windows = np.lib.stride_tricks.sliding_window_view(padded, depth)
    distance = np.sum((windows[:, None] - windows[None]) ** 2, axis=-1)
    K = KERNEL.variance * np.exp(-0.5 * distance / KERNEL.length_scale**2)
    return np.linalg.cholesky(K + 1e-10 * np.eye(n)) @ rng.standard_normal((n, count))


def offline(x: Array, f: Array) -> tuple[Array, Array]:
    sd = np.full(len(x), np.nan)
    mean = train(x[:, None], f, 4, 100, KERNEL).predict(x[:, None], sd=sd)
    return mean[110:], sd[110:]


def online(x: Array, f: Array) -> tuple[Array, Array]:
    mean, variance = predict_sliding(x[:, None], f, 4, 50, KERNEL)
    return mean[110:], np.sqrt(variance[110:] - KERNEL.noise_std**2)


@pytest.mark.slow
@pytest.mark.parametrize("regression", [offline, online])
def test_a_gpr_is_right_about_itself(regression: Callable[[Array, Array], tuple[Array, Array]]) -> None:
    """200 functions drawn from its prior, learnt from noisy targets, with its own hyper-parameters."""
    rng = np.random.default_rng(3)
    x = rng.standard_normal(300)
    truth = functions_of_windows(x, 4, rng, RECORDS)
    inside = []
    for f in truth.T:
        mean, sd = regression(x, f + KERNEL.noise_std * rng.standard_normal(len(f)))
        # sd is held over some steps: of the errors of offline regression those of the steps that it is of
        every = HELD if regression is offline else 1
        at = slice(-(107 - HELD * 7) % HELD if regression is offline else 0, None, every)
        inside.append([np.mean(np.abs(mean - f[110:])[at] <= half_width(share) * sd[at]) for share in (0.68, 0.95)])
    np.testing.assert_allclose(np.mean(inside, axis=0), [0.68, 0.95], atol=0.02)


@pytest.mark.slow
def test_a_gpr_is_right_about_itself_with_numbers_fitted_by_likelihood() -> None:
    """The same of 100 training windows each, of whose kernel nothing is known but the depth: within two percentage points. The
    three numbers are those of the greatest marginal likelihood; about them they scatter, the noise by a tenth."""
    rng, m, inside, numbers = np.random.default_rng(3), 100, [], []
    at, best = slice(3 + HELD * (m // HELD + 1), None, HELD), np.log([2.0, 1.0, 0.5])  # steps that the standard deviation is of
    for _ in range(RECORDS):
        x = rng.standard_normal(m + 300)
        (f,) = functions_of_windows(x, 4, rng, 1).T
        targets = f + KERNEL.noise_std * rng.standard_normal(len(f))

        def cost(p: Array, x: Array = x, targets: Array = targets) -> float:
            return -log_marginal_likelihood(x[:, None], targets, 4, 3, m, SquaredExponential(*np.exp(p)))

        simplex = best + np.vstack([np.zeros(3), 0.2 * np.eye(3)])
        best = minimize(cost, best, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 0.05, "fatol": 0.05}).x
        found = np.exp(best)
        sd = np.full(len(x), np.nan)
        mean = train(x[:, None], targets, 4, m, SquaredExponential(*found)).predict(x[:, None], sd=sd)
        inside.append([np.mean(np.abs(mean - f)[at] <= half_width(share) * sd[at]) for share in (0.68, 0.95)])
        numbers.append(found)
    np.testing.assert_allclose(np.mean(inside, axis=0), [0.68, 0.95], atol=0.02)
    np.testing.assert_allclose(np.median(numbers, axis=0), [KERNEL.signal_std, KERNEL.length_scale, KERNEL.noise_std], rtol=0.1)


@pytest.mark.parametrize(("error", "sd"), [(0.0, 1.0), (0.3, 1.0), (-2.0, 0.5), (5.0, 0.1), (1e-3, 7.0)])
def test_crps_is_the_integral_that_defines_it(error: float, sd: float) -> None:
    """Of (F(x) - [x >= 0])^2, where F is the distribution of -error + sd N(0, 1)."""

    def square(x: float) -> float:
        return float(ndtr((x + error) / sd) - (x >= 0.0)) ** 2

    low, high = min(0.0, -error) - 12 * sd, max(0.0, -error) + 12 * sd
    points = sorted([0.0, -error])
    whole = sum(quad(square, a, b, epsabs=1e-13)[0] for a, b in zip([low, *points], [*points, high], strict=True))
    assert float(crps(np.array([error]), np.array([sd]))[0]) == pytest.approx(whole, rel=1e-8)


def test_a_calibration() -> None:
    rng = np.random.default_rng(0)
    error = 2.0 * rng.standard_normal(200_000)
    right, sure, unsure = (calibration(error, np.full(error.shape, sd)) for sd in (2.0, 1.0, 4.0))
    assert right is not None and sure is not None and unsure is not None
    assert right.sd == 2.0 and right.within_68 == pytest.approx(0.68, abs=0.004)
    assert right.within_95 == pytest.approx(0.95, abs=0.002)
    # a Gaussian that is right scores sd / sqrt(pi); mean to 3e-3 with 2e5 errors
    assert right.crps == pytest.approx(2.0 / np.sqrt(pi), rel=5e-3)
    assert sure.within_95 < 0.7 and unsure.within_95 > 0.999
    assert right.crps < min(sure.crps, unsure.crps)
    nothing = np.full(3, np.nan)
    assert calibration(np.zeros(3), nothing) is None
    assert crps(np.array([-3.0]), np.array([0.0]))[0] == 3.0
