"""The paper's matrices against its sensor and mirror equations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.signal.statespace import disturbance_model, paper_matrices, sample_ar3, third_order_model

TURBULENCE, VIBRATION = Ar2(7.0686, 0.9, 0.5, 1e-3), Ar2(298.4, 0.03, 0.015, 1e-3)


def play(B: np.ndarray, n: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """y[k] = C x[k] of x[k+1] = A x[k] + B u[k] + v[k], with phi_dist and u of the same steps."""
    A, _, C = paper_matrices(TURBULENCE, VIBRATION)
    rng = np.random.default_rng(0)
    u, v = rng.standard_normal(n), np.zeros((n, 6))
    v[:, [0, 2]] = rng.standard_normal((n, 2))
    x = rng.standard_normal(6) * [1, 1, 1, 1, 0, 0]
    y, phi = np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k], phi[k] = C @ x, x[0] + x[2]
        x = A @ x + B * u[k] + v[k]
    return y, phi, u


def test_the_measurement_sees_the_command_of_two_steps_before() -> None:
    """y[k] = phi_dist[k-1] + u[k-2] (paper, eq. 3 to 5)."""
    _, B, _ = paper_matrices(TURBULENCE, VIBRATION)
    y, phi, u = play(B)
    assert np.abs(y[2:] - (phi[1:-1] + u[:-2])).max() < 1e-13


def test_with_the_printed_input_matrix_it_does_not() -> None:
    """B_u = (0, 1) as printed gives y[k] = phi_dist[k-1] + u[k-1], one step too early."""
    y, phi, u = play(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    assert np.abs(y[2:] - (phi[1:-1] + u[1:-1])).max() < 1e-13
    assert np.abs(y[2:] - (phi[1:-1] + u[:-2])).max() > 1.0


def test_matrices_are_those_printed() -> None:
    """Paper, eq. 7, all but B_u."""
    A, B, C = paper_matrices(TURBULENCE, VIBRATION)
    t, v = TURBULENCE, VIBRATION
    assert np.array_equal(
        A,
        [
            [t.a1, t.a2, 0, 0, 0, 0],
            [1, 0, 0, 0, 0, 0],
            [0, 0, v.a1, v.a2, 0, 0],
            [0, 0, 1, 0, 0, 0],
            [0, 0, 0, 0, 0, 0],
            [0, 0, 0, 0, 1, 0],
        ],
    )
    assert np.array_equal(B, [0, 0, 0, 0, 1, 0]) and np.array_equal(C, [0, 1, 0, 1, 0, 1])


@pytest.mark.parametrize(("n_turbulence", "n_vibration"), [(1, 0), (0, 1), (1, 1), (2, 3)])
def test_a_model_is_the_sum_of_its_processes(n_turbulence: int, n_vibration: int) -> None:
    turbulence = [Ar2(7.0 * (i + 1), 0.9, 0.5, 1e-3) for i in range(n_turbulence)]
    vibration = [Ar2(100.0 * (i + 1), 0.03, 0.02, 1e-3) for i in range(n_vibration)]
    model = disturbance_model(turbulence, vibration)
    rng = np.random.default_rng(1)
    state = rng.standard_normal(2 * (n_turbulence + n_vibration))
    x, after = model.pairs @ state, model.pairs @ model.A @ state
    now = {"turbulence": x[0 : 2 * n_turbulence : 2].sum(), "vibration": x[2 * n_turbulence :: 2].sum()}
    for target, row in model.outputs.items():
        assert row @ state == pytest.approx(now[target], abs=1e-14)
    # one step late: C x[k+1] is what the outputs said at step k
    assert model.C @ model.A @ state == pytest.approx(sum(now.values()), abs=1e-13)
    for i, p in enumerate([*turbulence, *vibration]):
        assert after[2 * i] == pytest.approx(p.a1 * x[2 * i] + p.a2 * x[2 * i + 1], abs=1e-13)
        assert after[2 * i + 1] == pytest.approx(x[2 * i], abs=1e-13)
    drive = np.diag([v for p in (*turbulence, *vibration) for v in (p.drive_variance, 0.0)])
    # 1e-12: phi[k+1] and phi[k] are nearly the same, so the zero of the second is a difference
    assert np.allclose(model.pairs @ model.Q @ model.pairs.T, drive, rtol=1e-9, atol=1e-12 * drive.max())
    # variance one, uncorrelated: the stationary covariance is the identity
    assert np.allclose(model.A @ model.A.T + model.Q, np.eye(len(state)), atol=1e-13)


@settings(max_examples=30)
@given(log_omega=st.floats(-7.0, 0.4), log_corner=st.floats(-7.0, 0.7), n=st.integers(1, 700))
def test_samples_of_third_order_are_those_of_its_model(log_omega: float, log_corner: float, n: int) -> None:
    p = Ar3(10.0**log_omega, 0.9, 10.0**log_corner, 0.5, 1.0)
    model, rng = third_order_model(p), np.random.default_rng(3)
    x, steps = rng.standard_normal(3), []
    for v in rng.standard_normal(n):
        steps.append(model.now @ x)
        x = model.A @ x + model.Q[:, 0] / np.sqrt(model.Q[0, 0]) * v
    assert sample_ar3(p, n, np.random.default_rng(3)) == pytest.approx(np.array(steps), abs=1e-12)


@pytest.mark.slow
def test_samples_of_third_order_have_its_autocovariance_from_the_first_on() -> None:
    """Against the integral of the density, over many short runs: at steps 0, 1, 4 and 40, with the first and with themselves."""
    p = Ar3(200.0, 0.6, 400.0, 0.5, 1e-3)
    runs = np.array([sample_ar3(p, 41, np.random.default_rng(i)) for i in range(4000)])
    f = (np.arange(100_000) + 0.5) * 5e-3  # 0 to 500 Hz
    S = p.psd(f) * 5e-3
    for k in (0, 1, 4, 40):
        true = S @ np.cos(2 * np.pi * f * k * p.dt)
        assert abs(np.mean(runs[:, 0] * runs[:, k]) - true) < 4.0 * p.rms**2 * np.sqrt(2.0 / 4000)
        assert np.var(runs[:, k]) == pytest.approx(p.rms**2, rel=4.0 * np.sqrt(2.0 / 4000))
