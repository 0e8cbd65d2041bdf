"""Steady-state gains: residual, symmetry, stability, other solvers, long iteration, long arithmetic."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from wfsobs.signal.autoregressive import Ar2, turbulence_corner
from wfsobs.signal.gains import RiccatiError, SteadyState, periodic_steady_state, steady_state
from wfsobs.signal.statespace import DisturbanceModel, disturbance_model

EPS = np.finfo(float).eps


def log_floats(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(np.log10(low), np.log10(high)).map(lambda x: 10**x)


@st.composite
def models(draw: st.DrawFn, peaks: int = 12, unit: tuple[float, float] = (1e-6, 1e3)) -> tuple[DisturbanceModel, float]:
    """Turbulence and up to `peaks` vibration lines as a telescope has them, in any unit, and a noise from far below to
    far above them. Returns (model, noise)."""
    scale = draw(log_floats(*unit))
    dt = draw(log_floats(5e-4, 1e-2))
    corner = turbulence_corner(draw(log_floats(2.0, 100.0)), draw(log_floats(1.0, 40.0)), draw(st.integers(1, 5)))
    turbulence = Ar2(corner, draw(st.floats(0.1, 1.0)), scale * draw(log_floats(0.03, 10.0)), dt)
    count = draw(st.integers(1, peaks))
    vibration = [
        Ar2(
            2 * np.pi * draw(log_floats(3.0, min(200.0, 0.45 / dt))),
            draw(st.just(1e-4) | log_floats(1e-4, 1.0)),
            scale * draw(log_floats(1e-3, 0.3)),
            dt,
        )
        for _ in range(count)
    ]
    return disturbance_model([turbulence], vibration), scale * draw(log_floats(1e-4, 10.0))


def check(model: DisturbanceModel, noise: float, found: SteadyState, tolerance: float = 2e-9) -> None:
    """The equations that define a steady-state filter, written out (paper, eq. 8)."""
    A, Q, P = model.A, model.Q, found.P
    C, R = model.C[None], np.array([[noise**2]])
    size = np.abs(P).max()
    right = A @ P @ A.T - A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + R) @ C @ P @ A.T + Q
    assert np.abs(right - P).max() <= tolerance * size
    # (I - L C) P (I - L C)' + L R L' is rounded at eps of what it sums, and an eigenvalue moves as much as all entries.
    reduced = np.eye(len(P)) - found.L @ C
    rounding = 8 * len(P) * EPS * max(1.0, float(np.linalg.norm(reduced, 2)) ** 2) * size
    for covariance in (P, found.posterior):
        assert np.abs(covariance - covariance.T).max() <= rounding
        assert np.linalg.eigvalsh(0.5 * (covariance + covariance.T)).min() >= -rounding
    # An inner product of n numbers is rounded at n eps of the sum of their sizes (Higham, Accuracy and Stability, section 3.1),
    # here once in the filter and once in the test. Where P is all but singular C P cancels: |C| |P| is far larger than |C P|. The
    # innovations' variance has two such products.
    once = 2 * (len(P) + 1) * EPS
    variance = C @ P @ C.T + R
    gain_rounding = once * (np.abs(P) @ np.abs(C.T) + 2 * np.abs(found.L) * (np.abs(C) @ np.abs(P) @ np.abs(C.T) + R)) / variance
    assert np.all(np.abs(found.L - P @ C.T / variance) <= gain_rounding)
    assert np.all(np.abs(found.K - A @ found.L) <= once * np.abs(A) @ np.abs(found.L))
    assert np.abs(np.linalg.eigvals(A - found.K @ C)).max() < 1.0
    assert np.abs(found.posterior - (P - found.L @ C @ P)).max() <= 1e-12 * size + 4 * rounding
    assert np.trace(found.posterior) <= np.trace(P) * (1 + 1e-12) + rounding


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True)
@given(models())
def test_every_telescope_has_a_filter(problem: tuple[DisturbanceModel, float]) -> None:
    model, noise = problem
    check(model, noise, steady_state(model.A, model.C, model.Q, np.array(noise**2)))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(models(peaks=4), st.integers(-12, 12))
def test_the_unit_does_not_matter(problem: tuple[DisturbanceModel, float], power: int) -> None:
    """In a unit 4^power larger everything scales by a power of two, which rounds nothing: equal to the last bits."""
    model, noise = problem
    one = steady_state(model.A, model.C, model.Q, np.array(noise**2))
    other = steady_state(model.A, model.C, model.Q * 16.0**power, np.array(noise**2 * 16.0**power))
    size = np.abs(one.P).max()
    assert np.abs(other.P / 16.0**power - one.P).max() <= 1e-9 * size
    assert np.abs(other.L - one.L).max() <= 1e-9 * np.abs(one.L).max()


@settings(max_examples=25, deadline=None, derandomize=True)
@given(models(peaks=2, unit=(0.3, 3.0)))
def test_where_scipy_works_both_agree(problem: tuple[DisturbanceModel, float]) -> None:
    model, noise = problem
    C = model.C[None]
    try:
        other = solve_discrete_are(model.A.T, C.T, model.Q, np.array([[noise**2]]))
    except (np.linalg.LinAlgError, ValueError):
        assume(False)
    K = model.A @ other @ C.T / (C @ other @ C.T + noise**2)
    closed = np.abs(np.linalg.eigvals(model.A - K @ C)).max()
    residual = np.abs(model.A @ other @ model.A.T + model.Q - K @ (C @ other @ C.T + noise**2) @ K.T - other).max()
    size = np.abs(other).max()
    assume(closed < 1.0 and residual < 1e-9 * size)
    found = steady_state(model.A, model.C, model.Q, np.array(noise**2))
    # an error in P comes from a residual through the closed loop's Lyapunov equation: times 1 / (1 - radius^2), here
    # for the larger of the residuals, both below 2e-9
    assert np.abs(found.P - other).max() <= 4e-9 / (1 - closed**2) * size


def test_scipy_is_often_there_to_compare_with() -> None:
    """The comparison above is not empty: of 40 plain models scipy solves nearly all."""
    rng = np.random.default_rng(0)
    solved = 0
    for _ in range(40):
        turbulence = Ar2(7.0686, 0.9, rng.uniform(0.1, 1.0), 1e-3)
        model = disturbance_model([turbulence], [Ar2(2 * np.pi * rng.uniform(10, 80), 0.03, 0.03, 1e-3)])
        noise = rng.uniform(0.005, 0.05)
        wanted = solve_discrete_are(model.A.T, model.C[:, None], model.Q, np.array([[noise**2]]))
        found = steady_state(model.A, model.C, model.Q, np.array(noise**2))
        # both have residuals of some 1e-12 of P, raised by 1 / (1 - radius^2) of about 1e3
        solved += bool(np.abs(found.P - wanted).max() < 1e-8 * np.abs(wanted).max())
    assert solved == 40


@pytest.mark.slow
@pytest.mark.parametrize("noise", [1e-3, 0.0141, 1.0])
@pytest.mark.parametrize(
    "peaks",
    [
        [(47.4969, 0.03, 0.015)],
        [(17.2, 0.01, 0.007), (47.4, 0.004, 0.008), (24.0, 5e-3, 0.004)],
    ],
)
def test_long_iteration_ends_at_the_solution(noise: float, peaks: list[tuple[float, float, float]]) -> None:
    """P[k+1] = A P A' - ... + Q from P = 0, until nothing moves any more: the plain way. The slowest closed loop
    here has radius 1 - 7.5e-4, so that 25,000 steps leave exp(-37) of the start."""
    turbulence = Ar2(7.0686, 0.9, 0.5, 1e-3)
    model = disturbance_model([turbulence], [Ar2(2 * np.pi * f, xi, rms, 1e-3) for f, xi, rms in peaks])
    A, C, P = model.A, model.C, np.zeros_like(model.Q)
    for _ in range(25_000):
        gain = P @ C / (C @ P @ C + noise**2)
        filtered = P - np.outer(gain, C @ P)
        P = A @ filtered @ A.T + model.Q
        P = 0.5 * (P + P.T)
    found = steady_state(model.A, model.C, model.Q, np.array(noise**2))
    # rounding of each of the last 1 / (1 - radius^2) ~ 1e4 steps counts: 1e4 eps, and a margin
    assert np.abs(found.P - P).max() < 1e-10 * np.abs(P).max()


def test_against_sixty_digits() -> None:
    """Structured doubling in 60 digits: the error of P is below 1e-10 of it, with one hardly damped line among
    ordinary ones."""
    turbulence = Ar2(7.0686, 0.9, 0.5, 1e-3)
    vibration = [Ar2(2 * np.pi * 47.5, 1e-4, 0.01, 1e-3), Ar2(2 * np.pi * 20, 0.02, 0.01, 1e-3)]
    model = disturbance_model([turbulence], vibration)
    found = steady_state(model.A, model.C, model.Q, np.array(0.0141**2))
    with mp.workdps(60):
        A, Q, R = mp.matrix(model.A.tolist()), mp.matrix(model.Q.tolist()), mp.mpf(0.0141**2)
        C = mp.matrix([model.C.tolist()])
        n, identity = A.rows, mp.eye(A.rows)
        a, g, h = A.T, C.T * C / R, Q
        for _ in range(40):  # structured doubling, far past convergence, in arithmetic that forgives it
            w = (identity + g * h) ** -1
            a, g, h = a * w * a, g + a * w * g * a.T, h + a.T * h * w * a
        residual = A * h * A.T - A * h * C.T * C * h * A.T / ((C * h * C.T)[0] + R) + Q - h
        assert mp.norm(residual, mp.inf) < mp.mpf(10) ** -45
        error = max(abs(h[i, j] - mp.mpf(float(found.P[i, j]))) for i in range(n) for j in range(n))
    assert error < 1e-10 * np.abs(found.P).max()


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    st.floats(-5.0, -1.0),
    log_floats(0.1, 100.0),
    log_floats(0.1, 100.0),
    log_floats(0.01, 1.0),
    st.floats(0.0, 1.0),
    log_floats(1e-4, 1.0),
    log_floats(1e-6, 100.0),
    log_floats(1e-6, 100.0),
    log_floats(1e-6, 100.0),
)
def test_whatever_can_be_set_gives_a_filter_or_says_why(
    log_dt: float,
    wind: float,
    diameter: float,
    xi: float,
    share: float,
    damping: float,
    strong: float,
    weak: float,
    noise: float,
) -> None:
    """The whole range of the settings, corners as slow as 1e-8 of the frame rate included."""
    dt = 10**log_dt
    frequency = 10 ** (-2 + share * (np.log10(min(5000.0, 0.499 / dt)) + 2))
    model = disturbance_model(
        [Ar2(turbulence_corner(wind, diameter, 1), xi, strong, dt)], [Ar2(2 * np.pi * frequency, damping, weak, dt)]
    )
    found = None
    try:
        found = steady_state(model.A, model.C, model.Q, np.array(noise**2))
    except RiccatiError as error:
        reason = str(error)
    if found is None:
        assert "\n" not in reason and len(reason) > 20
    else:
        check(model, noise, found)


def test_no_disturbance_needs_no_gain() -> None:
    model = disturbance_model([Ar2(7.0, 0.9, 0.0, 1e-3)], [Ar2(300.0, 0.03, 0.0, 1e-3)])
    found = steady_state(model.A, model.C, model.Q, np.array(1e-4))
    # A state of variance one that nothing is seen of: no gain, its own covariance, and outputs of zero.
    assert not found.L.any()
    assert np.allclose(found.P, np.eye(4), atol=1e-12) and np.allclose(found.posterior, found.P, atol=1e-12)
    assert not any(row.any() for row in model.outputs.values())


def test_more_noise_never_helps() -> None:
    model = disturbance_model([Ar2(7.0, 0.9, 0.5, 1e-3)], [Ar2(300.0, 0.03, 0.015, 1e-3)])
    T = model.pairs
    traces = [np.trace(T @ steady_state(model.A, model.C, model.Q, np.array(r)).P @ T.T) for r in np.geomspace(1e-10, 1e4, 15)]
    assert np.all(np.diff(traces) > 0)
    stationary = 2 * (0.5**2 + 0.015**2)
    assert traces[-1] < stationary and traces[-1] == pytest.approx(stationary, rel=0.01)


def test_two_sensors_are_one_of_their_joint_information() -> None:
    """Measurements of the same row with r1 and r2 equal one with 1 / (1 / r1 + 1 / r2)."""
    model = disturbance_model([Ar2(7.0, 0.9, 0.5, 1e-3)], [Ar2(300.0, 0.03, 0.015, 1e-3)])
    r1, r2 = 4e-4, 1e-4
    both = steady_state(model.A, np.vstack([model.C, model.C]), model.Q, np.diag([r1, r2]))
    one = steady_state(model.A, model.C, model.Q, np.array(1 / (1 / r1 + 1 / r2)))
    assert np.allclose(both.P, one.P, rtol=1e-9, atol=1e-12 * np.abs(one.P).max())
    assert np.allclose(both.L, one.L * [[r2 / (r1 + r2), r1 / (r1 + r2)]], rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("noise", [0.0, -1.0, np.nan])
def test_noise_must_be_above_zero(noise: float) -> None:
    model = disturbance_model([Ar2(7.0, 0.9, 0.5, 1e-3)], [])
    with pytest.raises(RiccatiError):
        steady_state(model.A, model.C, model.Q, np.array(noise))


def test_periodic_solution_around_the_cycle() -> None:
    """Every step of the cycle takes one P to the next, and with equal steps it is the steady solution."""
    model = disturbance_model([Ar2(7.0, 0.9, 0.5, 1e-3)], [Ar2(300.0, 0.03, 0.015, 1e-3)])
    C = np.vstack([model.C, model.C])
    silent = C * [[1.0], [0.0]]
    R = np.diag([4e-4, 1e-5])
    cycle = [(model.A, silent, model.Q, R)] * 4 + [(model.A, C, model.Q, R)]
    states = periodic_steady_state(cycle)
    for i, ((A, Cj, Q, Rj), state) in enumerate(zip(cycle, states, strict=True)):
        gain = state.P @ Cj.T @ np.linalg.inv(Cj @ state.P @ Cj.T + Rj)
        after = A @ (state.P - gain @ Cj @ state.P) @ A.T + Q
        assert np.allclose(after, states[(i + 1) % 5].P, rtol=0, atol=1e-10 * np.abs(state.P).max())
        assert np.allclose(state.L, gain, rtol=0, atol=1e-10)
    # a step that comes again as the same object is taken by halves, equal ones are taken one by one
    for one, other in zip(periodic_steady_state([tuple(step) for step in map(list, cycle)]), states, strict=True):
        assert np.allclose(one.P, other.P, rtol=0, atol=1e-10 * np.abs(one.P).max())
    steady = steady_state(model.A, model.C, model.Q, np.array(4e-4))
    for state in periodic_steady_state([(model.A, model.C[None], model.Q, np.array([[4e-4]]))] * 3):
        assert np.allclose(state.P, steady.P, rtol=0, atol=1e-10 * np.abs(steady.P).max())
