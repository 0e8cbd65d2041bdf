"""Challengers against textbook formulas and known limits."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from wfsobs_arena.challengers import CHALLENGERS
from wfsobs_arena.challengers.avc import lock_lines
from wfsobs_arena.challengers.coupled_ar import NormalEquations
from wfsobs_arena.challengers.gru import FILE, predict_gru, stored_weights
from wfsobs_arena.challengers.imm import run_mixture, to_pairs
from wfsobs_arena.challengers.predictive import ORDER, PENALTY, PredictiveLaw
from wfsobs_arena.challengers.rls import MEMORY, histories, predict_rls
from wfsobs_arena.challengers.subspace import fit_subspace, joint_moments

from wfsobs.closed_loop.design import design
from wfsobs.control.base import Controller
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.mirror import Mirror
from wfsobs.observers.base import TARGETS, Observer
from wfsobs.observers.kalman.filters import steady_filter
from wfsobs.prior import Model
from wfsobs.priors_from.controllers import controller_arguments, own_settings, plant_of, prior_for
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.gains import steady_state
from wfsobs.signal.statespace import disturbance_model
from wfsobs.simulation.loop import simulate
from wfsobs.testing import check_controller, check_observer


@pytest.mark.slow
@pytest.mark.parametrize("name", CHALLENGERS)
def test_challengers_keep_the_rules(name: str) -> None:
    algorithm = CHALLENGERS[name].algorithm
    if isinstance(algorithm, Observer):
        check_observer(algorithm, alone=False)
    else:
        check_controller(algorithm, alone=False)


def test_without_forgetting_rls_is_ridge_least_squares() -> None:
    z = np.random.default_rng(2).standard_normal((400, 2)).cumsum(axis=0)
    predicted, weights = predict_rls(z, 3, 1.0, 0.1)
    H = histories(z, 3)
    batch = np.linalg.solve(H[:-1].T @ H[:-1] + 0.1 * np.eye(6), H[:-1].T @ z[1:])
    np.testing.assert_allclose(weights, batch, rtol=0, atol=1e-8)  # 400 rank-one updates, condition 1e5
    np.testing.assert_allclose(predicted[-1], H[-1] @ batch, rtol=1e-6)


def test_forgetting_weighs_the_past_exponentially() -> None:
    z = np.random.default_rng(3).standard_normal((300, 1)).cumsum(axis=0)
    _, weights = predict_rls(z, 2, 0.98, 0.1)
    H, n = histories(z, 2), len(z)
    w = 0.98 ** np.arange(n - 2, -1, -1)
    batch = np.linalg.solve((H[:-1].T * w) @ H[:-1] + 0.1 * 0.98 ** (n - 1) * np.eye(2), (H[:-1].T * w) @ z[1:])
    np.testing.assert_allclose(weights, batch, rtol=0, atol=1e-8)  # rounding of 300 updates


@pytest.mark.parametrize("delay", [1.0, 2.0, 2.25])
def test_predictive_control_commands_what_least_squares_say_of_the_steps_on_which_it_acts(delay: float) -> None:
    rng, n, dt = np.random.default_rng(8), 300, 1e-3
    z = rng.standard_normal((n, 2)).cumsum(axis=0) * 0.05
    law = PredictiveLaw(Mirror(delay), dt, 2)
    u = np.array([law.command(now, None, np.zeros(2)) for now in z])
    # a delay of 2.25 frames: a command acts on three quarters of z[k + 2] and a quarter of z[k + 3]
    ahead = {1.0: {1: 1.0}, 2.0: {2: 1.0}, 2.25: {2: 0.75, 3: 0.25}}[delay]
    lag, H = max(ahead), histories(z, ORDER)
    outputs = np.sum([a * z[j : n - lag + j] for j, a in ahead.items()], axis=0)
    # the penalty is forgotten from the first frame on, also in the `lag` frames before there is an output
    w = np.exp(-dt / MEMORY * np.arange(n - lag - 1, -1, -1.0))
    left = (H[: n - lag].T * w) @ H[: n - lag] + PENALTY * np.exp(-dt / MEMORY * n) * np.eye(2 * ORDER)
    batch = np.linalg.solve(left, (H[: n - lag].T * w) @ outputs)
    np.testing.assert_allclose(u[-1], -H[-1] @ batch, rtol=1e-5)  # 300 rank-one updates, condition 1e5


@pytest.mark.slow
def test_predictive_control_comes_between_the_integrator_and_the_bound() -> None:
    """A pure line and resonances, without the slow error of the LGS. The rms of 4 s scatters by a few per cent about its mean."""
    changes = {"run.duration": 8.0, "vibration.synthesis": "gaussian", "sensors.lgs_low_frequency_rms": 0.0}
    scenario = PRESETS["peak-jump"]().replace(changes).before_events
    record, plant = simulate(scenario), plant_of(scenario)
    assert record.turbulence is not None and record.vibration is not None
    truth, left = record.turbulence + record.vibration, {}
    for controller in (CHALLENGERS["predictive-rls"].algorithm, CONTROLLERS["integrator"]):
        assert isinstance(controller, Controller)
        settings = own_settings(controller, scenario)
        measured, prior = controller_arguments(controller, record, settings, prior_for(controller, scenario))
        laws = controller.laws(prior, plant, settings, measured.n_modes)
        u, _ = controller.commands(laws, measured, prior, plant, settings)
        left[controller.id] = np.sqrt(np.mean((truth + plant.mirror.correction(u))[4000:] ** 2))
    bound = np.sqrt(np.mean(np.square(design(scenario, []).bounds["bound"])))
    assert 0.95 * bound < left["predictive-rls"] < 0.8 * left["integrator"]


def test_coupled_autoregression_is_least_squares_of_all_blocks_and_finds_the_order() -> None:
    rng, n = np.random.default_rng(4), 6000
    A1, A2 = np.array([[0.9, 0.3], [-0.2, 0.8]]), np.array([[-0.5, 0.0], [0.1, -0.4]])
    z = np.zeros((n, 2))
    for k in range(2, n):
        z[k] = A1 @ z[k - 1] + A2 @ z[k - 2] + rng.standard_normal(2)
    H, sums = histories(z, 10), NormalEquations(2, 10)
    for start in range(0, n - 1, 1000):
        stop = min(start + 1000, n - 1)
        sums.add(H[start:stop], z[start + 1 : stop + 1])
    batch = np.linalg.lstsq(H[:-1, :6], z[1:], rcond=None)[0]
    np.testing.assert_allclose(sums.fit(3).weights, batch, rtol=0, atol=1e-6)  # the penalty of 1e-7 over n = 6000
    found = sums.best((1, 2, 5, 10))
    assert found.order == 2
    truth = np.vstack([A1.T, A2.T])
    np.testing.assert_allclose(found.weights, truth, rtol=0, atol=0.06)  # five standard errors of 1 / sqrt(n)
    np.testing.assert_allclose(found.covariance, np.eye(2), rtol=0, atol=0.1)  # five of sqrt(2 / n)


def peak(frequency: float) -> Model:
    return Model(Ar2(6.6, 0.9, 0.5, 1e-3), Ar2(2 * np.pi * frequency, 0.01, 0.03, 1e-3), 0.014, 0.01)


def test_one_hypothesis_is_the_kalman_filter_and_so_are_equal_ones() -> None:
    model, rng = peak(47.0), np.random.default_rng(6)
    z = rng.standard_normal(4000).cumsum() * 0.005
    own = model.disturbance()
    steady, states = steady_filter(own, model.lgs_noise)
    expected = steady.run(z[:, None])
    one = to_pairs(own)
    rows = one.output_rows(TARGETS)
    single = run_mixture(z, [one], model.lgs_noise, 1.0, rows)
    # it starts from the stationary covariance; after 3 s the slowest part of the start has died out by exp(-0.01 * 295 * 3)
    np.testing.assert_allclose(single.values[3000:], expected[3000:], rtol=0, atol=1e-3 * np.std(expected))
    sd = np.sqrt(np.einsum("ra,ab,rb->r", own.output_rows(TARGETS), states.posterior, own.output_rows(TARGETS)))
    np.testing.assert_allclose(np.sqrt(single.variances[-1]), sd, rtol=1e-3)
    twice = run_mixture(z, [one, one], model.lgs_noise, 0.99, rows)
    np.testing.assert_allclose(twice.values, single.values, rtol=0, atol=1e-9)  # rounding
    np.testing.assert_allclose(twice.probabilities, 0.5, rtol=0, atol=1e-9)


def test_the_hypothesis_that_made_the_record_gets_probable() -> None:
    rng, models = np.random.default_rng(7), [to_pairs(peak(f).disturbance()) for f in (44.0, 50.0)]
    made = peak(50.0)
    disturbance = made.turbulence.sample(6000, rng) + made.vibration.sample(6000, rng)
    z = np.concatenate([[0.0], disturbance[:-1]]) + 0.014 * rng.standard_normal(6000)
    found = run_mixture(z, models, 0.014, 0.9995, models[0].output_rows(TARGETS))
    assert found.probabilities[2000:, 1].mean() > 0.9


@pytest.mark.slow
def test_phase_locked_loops_lock_on_pure_lines() -> None:
    t = np.arange(20_001) * 1e-3
    clean = np.column_stack([0.03 * np.cos(2 * np.pi * 47.9 * t + 1.0), 0.01 * np.cos(2 * np.pi * 48.2 * t)])
    found = lock_lines(clean[:-1], [30.0, 48.0], 1.0, 1e-3, level=0.0)
    # after 20 s of loops of 0.5 Hz only the ripple of demodulation is left, of the order of bandwidth over frequency
    np.testing.assert_allclose(found.frequencies[:, 1], [47.9, 48.2], rtol=0, atol=0.02)
    np.testing.assert_allclose(found.magnitudes[:, 1], [0.03, 0.01], rtol=0.05)
    error = (found.values - clean[1:])[-5000:]
    assert (np.sqrt(np.mean(error**2, axis=0)) < 0.05 * np.sqrt(np.mean(clean**2, axis=0))).all()
    far = lock_lines(clean[:-1], [40.0], 1.0, 1e-3, level=0.0)
    assert (np.abs(far.frequencies - 40.0) <= 1.0 + 1e-9).all()  # no line leaves its band


def test_the_subspace_predictor_finds_the_states_and_predicts_like_the_kalman_filter() -> None:
    rng, n = np.random.default_rng(8), 20_000
    # the sum of two processes of two states each, and noise
    one, two = Ar2(2 * np.pi * 20.0, 0.3, 1.0, 1e-3), Ar2(2 * np.pi * 150.0, 0.05, 1.0, 1e-3)
    z = (one.sample(n, rng) + two.sample(n, rng) + 0.3 * rng.standard_normal(n))[:, None]
    past, future = 40, 10
    H = histories(z, past)
    found = fit_subspace(joint_moments(H, z, 0, n - future, future), n - future, 1, past)
    assert found.order == 4
    model = disturbance_model([one], [two])
    steady = steady_state(model.A, model.C, model.Q, np.array(0.3**2))
    optimal = float(model.C @ steady.P @ model.C + 0.3**2)
    error = np.var((H[:-1] @ found.weights - z[1:])[past:])
    # five standard errors of a variance over n = 20,000, sqrt(2 / n) each; what the fit of 4 states costs is less
    assert error == pytest.approx(optimal, rel=0.05)
    assert found.covariance[0, 0] == pytest.approx(error, rel=0.01)  # the start of the record is in one of them


@pytest.fixture(scope="module")
def training() -> ModuleType:
    """The script that trains the network."""
    path = Path(__file__).parents[1] / "train_gru.py"
    spec = importlib.util.spec_from_file_location("train_gru", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def small_weights(rng: np.random.Generator) -> dict[str, np.ndarray]:
    shapes = {"W": (4, 9), "U": (3, 9), "b": (9,), "v": (4,), "w": (3,)}
    return {name: 0.5 * rng.standard_normal(shape) for name, shape in shapes.items()}


def test_the_network_is_a_gated_recurrent_unit() -> None:
    rng = np.random.default_rng(9)
    p, z = small_weights(rng), rng.standard_normal((40, 1)).cumsum(axis=0)

    def logistic(x: float) -> float:
        return 1.0 / (1.0 + math.exp(-x))

    h, square, weight = [0.0] * 3, 0.0, 0.0
    for k in range(40):
        step = [z[k - j, 0] - z[k - j - 1, 0] if k - j > 0 else 0.0 for j in range(4)]
        square, weight = math.exp(-1e-3) * square + step[0] ** 2, math.exp(-1e-3) * weight + 1.0
        s = math.sqrt(square / weight) + 1e-12
        x = [d / s for d in step]
        drive = [sum(x[i] * p["W"][i, j] for i in range(4)) + p["b"][j] for j in range(9)]
        r, g = ([logistic(drive[o + j] + sum(h[i] * p["U"][i, o + j] for i in range(3))) for j in range(3)] for o in (0, 3))
        c = [math.tanh(drive[6 + j] + sum(r[i] * h[i] * p["U"][i, 6 + j] for i in range(3))) for j in range(3)]
        h = [(1 - g[j]) * h[j] + g[j] * c[j] for j in range(3)]
        expected = z[k, 0] + s * (sum(x[i] * p["v"][i] for i in range(4)) + sum(h[j] * p["w"][j] for j in range(3)))
        assert predict_gru(p, z[: k + 1])[k, 0] == pytest.approx(expected, rel=1e-10, abs=1e-10)


def test_the_network_is_trained_along_its_gradient(training: ModuleType) -> None:
    rng = np.random.default_rng(10)
    p, x, target = small_weights(rng), rng.standard_normal((6, 2, 4)), rng.standard_normal((6, 2))
    h = rng.standard_normal((2, 3))
    _, gradient, _ = training.loss_gradient(p, x, target, h)
    for name, value in p.items():
        along = rng.standard_normal(value.shape)
        two = [training.loss_gradient({**p, name: value + e * along}, x, target, h)[0] for e in (1e-5, -1e-5)]
        # central differences: an error of the order of 1e-10
        assert float(np.sum(gradient[name] * along)) == pytest.approx((two[0] - two[1]) / 2e-5, abs=1e-8)


@pytest.mark.slow
def test_the_stored_network_is_small_and_predicts_better_than_the_last_measurement() -> None:
    assert FILE.stat().st_size < 100_000
    scenario = PRESETS["ut4"]().replace({"run.duration": 3.0, "run.seed": 99})
    z = simulate(scenario).z
    after = slice(500, -1)
    error = predict_gru(stored_weights(), z)[after] - z[501:]
    assert np.std(error) < 0.9 * np.std(z[after] - z[501:])
