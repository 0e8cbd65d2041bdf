"""Gaussian processes in time as filters: against the dense regression, closed forms of kernels, celerite and differences."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from wfsobs.observers.gp.kernels import Kernel, Matern, QuasiPeriodic, Sho, SquaredExponentialInTime, Sum
from wfsobs.observers.gp.likelihood import log_likelihood, regress
from wfsobs.typing import Array

DT, N, NOISE = 1e-3, 300, 0.014


def matern(rms: float, scale: float, order: int) -> Callable[[Array], Array]:
    """The closed forms (Rasmussen and Williams, 2006, eq. 4.14 and 4.17)."""

    def k(lag: Array) -> Array:
        x = np.sqrt(order) * lag / scale
        return rms**2 * {1: 1.0, 3: 1.0 + x, 5: 1.0 + x + x**2 / 3.0}[order] * np.exp(-x)

    return k


def oscillator(rms: float, omega: float, damping: float) -> Callable[[Array], Array]:
    def k(lag: Array) -> Array:
        s = np.sqrt(complex(1.0 - damping**2))
        x = omega * lag
        return (rms**2 * np.exp(-damping * x) * (np.cos(s * x) + damping / s * np.sin(s * x))).real

    return k


CLOSED: dict[str, tuple[Kernel, Callable[[Array], Array]]] = {
    "matern 1/2": (Matern(0.5, 0.1, 1), matern(0.5, 0.1, 1)),
    "matern 3/2": (Matern(0.5, 0.1, 3), matern(0.5, 0.1, 3)),
    "matern 5/2": (Matern(0.5, 0.1, 5), matern(0.5, 0.1, 5)),
    "narrow line": (Sho(0.02, 300.0, 1e-3), oscillator(0.02, 300.0, 1e-3)),
    "overdamped": (Sho(0.5, 7.0, 1.3), oscillator(0.5, 7.0, 1.3)),
    "slow": (Matern(0.5, 30.0, 5), matern(0.5, 30.0, 5)),
    "fast": (Matern(0.02, 2e-5, 3), matern(0.02, 2e-5, 3)),
}
CLOSED["sum"] = (
    Sum(tuple(CLOSED[name][0] for name in ("matern 5/2", "narrow line", "matern 1/2"))),
    lambda lag: sum(CLOSED[name][1](lag) for name in ("matern 5/2", "narrow line", "matern 1/2")),
)
RATIONAL: dict[str, Kernel] = {
    "quasi-periodic": QuasiPeriodic(0.1, 0.02, 0.5, 1.0, 8),
    "squared exponential": SquaredExponentialInTime(0.1, 0.02, 6),
}
LAGS = DT * np.arange(N)


def dense(covariance: Array, z: Array) -> tuple[Array, Array, Array, float]:
    """Prediction of every sample by those before it with its variance, the last mean of f, and the log-likelihood."""
    K = covariance[np.abs(np.subtract.outer(np.arange(N), np.arange(N)))]
    L = np.linalg.cholesky(K + NOISE**2 * np.eye(N))
    e = np.linalg.solve(L, z)
    last = K[-1] @ np.linalg.solve(L.T, e)
    total = -0.5 * e @ e - np.log(np.diag(L)).sum() - 0.5 * N * np.log(2.0 * np.pi)
    return z - np.diag(L) * e, np.diag(L) ** 2, last, float(total)


def drawn(covariance: Array, seed: int) -> Array:
    K = covariance[np.abs(np.subtract.outer(np.arange(N), np.arange(N)))]
    return np.linalg.cholesky(K + NOISE**2 * np.eye(N)) @ np.random.default_rng(seed).standard_normal(N)


@pytest.mark.parametrize("name", [*CLOSED, *RATIONAL])
def test_the_filter_is_the_dense_regression(name: str) -> None:
    """To 1e-10 of the rms; of kernels that are approximations, the rational kernel itself."""
    if name in CLOSED:
        kernel, closed = CLOSED[name]
        covariance = closed(LAGS)
    else:
        kernel = RATIONAL[name]
        covariance = kernel.state_space().covariance(LAGS)
    z = drawn(covariance, 1)
    ahead, innovation, last, total = dense(covariance, z)
    got = regress(kernel, NOISE, DT, z)
    assert np.abs(got.ahead - ahead).max() < 1e-10 * z.std()
    assert np.abs(got.innovation / innovation - 1.0).max() < 1e-10
    assert abs(got.mean[-1] - last) < 1e-10 * z.std()
    assert got.log_likelihood == pytest.approx(total, rel=1e-10)


@pytest.mark.parametrize("name", [*CLOSED, *RATIONAL])
def test_state_spaces_are_stationary_with_their_kernel(name: str) -> None:
    kernel, closed = CLOSED.get(name) or (RATIONAL[name], None)
    space = kernel.state_space()
    residual = space.F @ space.P + space.P @ space.F.T + space.B @ space.B.T
    assert np.abs(residual).max() < 1e-13 * np.abs(space.F).max() * np.abs(space.P).max()
    if closed is not None:
        np.testing.assert_allclose(space.covariance(LAGS), closed(LAGS), rtol=0, atol=1e-12 * closed(LAGS[:1])[0])
    A, Q = space.discretise(DT)
    # P = A P A' + Q to rounding of P
    np.testing.assert_allclose(A @ space.P @ A.T + Q, space.P, rtol=0, atol=1e-13 * np.abs(space.P).max())


def test_the_drive_of_a_slow_process_keeps_its_digits() -> None:
    """Q of a Matern 5/2 over a short step h is q h^(9 - i - j) / ((5 - i - j) ...), by its series; P - A P A' has none left."""
    kernel = Matern(1.0, 100.0, 5)
    rate = np.sqrt(5.0) / 100.0
    _, Q = kernel.state_space().discretise(DT)
    x = rate * DT
    density = 16.0 / 3.0  # of the drive of f'' over rate^2, per rate
    # leading terms: the drive integrated 0, 1 and 2 times; the next ones are 3 x smaller by about three times x
    want = density * np.array([[x**5 / 20, x**4 / 8, x**3 / 6], [x**4 / 8, x**3 / 3, x**2 / 2], [x**3 / 6, x**2 / 2, x]])
    np.testing.assert_allclose(Q, want, rtol=20 * x)


@pytest.mark.parametrize(("order", "distance"), [(2, 0.15), (4, 0.03), (6, 6e-3), (8, 2e-3)])
def test_a_squared_exponential_gets_closer_with_its_order(order: int, distance: float) -> None:
    """Its distance to the true kernel, over the variance: below what the docs state, above a third of it."""
    kernel = SquaredExponentialInTime(1.0, 0.02, order)
    worst = np.abs(kernel.state_space().covariance(LAGS) - kernel.exact(LAGS)).max()
    assert distance / 3.0 < worst < distance


def test_a_quasi_periodic_kernel_gets_closer_with_its_harmonics() -> None:
    """By a factor beyond 8 per harmonic from the fourth on: its Fourier coefficients fall as Bessel functions of order j at 1."""
    worst = [
        np.abs((k := QuasiPeriodic(1.0, 0.02, 0.5, 1.0, n)).state_space().covariance(LAGS) - k.exact(LAGS)).max()
        for n in (3, 4, 5, 6)
    ]
    assert all(8 * later < earlier for earlier, later in pairwise(worst)) and worst[-1] < 1e-5


def celerite(a: Array, c: Array, a_line: tuple[float, float, float, float], diagonal: float, z: Array) -> float:
    """Log-likelihood by the recursion of Foreman-Mackey et al. (AJ 154, 220, 2017, eq. 58), for real terms and one complex."""
    t = DT * np.arange(N)
    A, B, C, D = a_line
    U = np.vstack([*(np.full(N, x) for x in a), A * np.cos(D * t) + B * np.sin(D * t), A * np.sin(D * t) - B * np.cos(D * t)])
    V = np.vstack([*(np.ones(N) for _ in a), np.cos(D * t), np.sin(D * t)])
    decay = np.exp(-np.array([*c, C, C]) * DT)
    S, f = np.zeros((len(U), len(U))), np.zeros(len(U))
    d, w, previous, total = 0.0, np.zeros(len(U)), 0.0, 0.0
    for k in range(N):
        if k:
            S = np.outer(decay, decay) * (S + d * np.outer(w, w))
            f = decay * (f + w * previous)
        d = diagonal + sum(a) + A - U[:, k] @ S @ U[:, k]
        w = (V[:, k] - S @ U[:, k]) / d
        previous = z[k] - U[:, k] @ f
        total -= 0.5 * (previous**2 / d + np.log(2.0 * np.pi * d))
    return float(total)


def test_the_likelihood_of_celerite() -> None:
    """Methods that share nothing but the kernel, to 1e-10: Matern 1/2, a line, and Matern 3/2 as celerite has it (eps 1e-5)."""
    omega, damping, rms = 300.0, 0.03, 0.02
    root = np.sqrt(1.0 - damping**2)
    line = rms**2, rms**2 * damping / root, damping * omega, omega * root
    real = [0.25], [10.0]
    z = drawn(matern(0.5, 0.1, 1)(LAGS) + oscillator(rms, omega, damping)(LAGS), 2)
    kernel = Sum((Matern(0.5, 0.1, 1), Sho(rms, omega, damping)))
    assert regress(kernel, NOISE, DT, z).log_likelihood == pytest.approx(celerite(*real, line, NOISE**2, z), rel=1e-10)
    rate, eps = np.sqrt(3.0) / 0.05, 1e-5
    near = 0.09, 0.09 * rate / eps, rate, eps
    both = Sum((Matern(0.5, 0.1, 1), Matern(0.3, 0.05, 3)))
    # eps = 1e-5 is their approximation: its error is of the second order in eps t, below rounding here
    assert regress(both, NOISE, DT, z).log_likelihood == pytest.approx(celerite(*real, near, NOISE**2, z), rel=1e-10)


def model(p: Array) -> tuple[Kernel, float]:
    x = np.exp(p)
    parts = (
        Matern(x[0], x[1], 5),
        Sho(x[2], x[3], x[4]),
        QuasiPeriodic(x[5], x[6], 0.5, x[7], 3),
        SquaredExponentialInTime(x[8], x[9]),
    )
    return Sum(parts), x[10]


def test_gradients_are_those_of_differences() -> None:
    p = np.log([0.5, 0.1, 0.02, 300.0, 0.03, 0.1, 0.02, 1.0, 0.1, 0.05, NOISE])
    z = drawn(CLOSED["sum"][1](LAGS), 3)[:100]
    value, gradient = log_likelihood(model, p, DT, z)
    assert value == pytest.approx(regress(*model(p), DT, z).log_likelihood, rel=1e-12)
    for i, step in enumerate(np.eye(len(p)) * 1e-5):
        up, down = (regress(*model(p + s), DT, z).log_likelihood for s in (step, -step))
        # differences over 1e-5 keep 1e-9 of the value and are wrong by 1e-10 of the third derivative
        assert gradient[i] == pytest.approx((up - down) / 2e-5, rel=1e-6, abs=1e-6 * abs(value))


def test_missing_samples_say_nothing() -> None:
    """As if only the others were in the dense regression."""
    kernel, closed = CLOSED["sum"]
    z = drawn(closed(LAGS), 4)
    gone = z.copy()
    gone[[0, 7, 8, 9, 200, N - 1]] = np.nan
    there = ~np.isnan(gone)
    K = closed(np.abs(np.subtract.outer(LAGS, LAGS)))
    inverse = np.linalg.inv(K[np.ix_(there, there)] + NOISE**2 * np.eye(there.sum()))
    got = regress(kernel, NOISE, DT, gone)
    assert abs(got.mean[-1] - K[-1, there] @ inverse @ z[there]) < 1e-10 * z.std()
    assert got.variance[-1] == pytest.approx(K[-1, -1] - K[-1, there] @ inverse @ K[there, -1], rel=1e-9)
