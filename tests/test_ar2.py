"""The AR(2) processes against Yule-Walker in long arithmetic, Lyapunov, quadrature and their own samples."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_lyapunov

from wfsobs.signal.autoregressive import Ar2, turbulence_corner

EXAMPLES = settings(max_examples=60, deadline=None, derandomize=True)
EPS = np.finfo(float).eps


def processes(slowest: float = 1e-6, least_damped: float = 1e-6) -> st.SearchStrategy[Ar2]:
    """Any process up to half the sampling rate: omega dt, damping and unit over many decades."""
    return st.builds(
        lambda log_angle, log_damping, log_rms, log_dt: Ar2(
            10**log_angle / 10**log_dt, min(10**log_damping, 1.0), 10**log_rms, 10**log_dt
        ),
        st.floats(np.log10(slowest), np.log10(np.pi)),
        st.floats(np.log10(least_damped), 0.0) | st.just(0.0),
        st.floats(-6.0, 3.0),
        st.floats(-5.0, -1.0),
    )


def exact(p: Ar2) -> tuple[mp.mpf, mp.mpf, mp.mpf, list[mp.mpf]]:
    """(a1, a2, drive variance, autocovariance of lags 0 ... 40) to 50 digits: the paper's eq. 1b and 1c, then the
    Yule-Walker equations r0 = a1 r1 + a2 r2 + v, r1 = a1 r0 + a2 r1, r[j] = a1 r[j-1] + a2 r[j-2]."""
    with mp.workdps(50):
        omega, xi, dt, rms = (mp.mpf(v) for v in (p.omega, p.damping, p.dt, p.rms))
        a1 = 2 * mp.exp(-xi * omega * dt) * mp.cos(omega * mp.sqrt(1 - xi**2) * dt)
        a2 = -mp.exp(-2 * xi * omega * dt)
        r = [rms**2, a1 / (1 - a2) * rms**2]
        for _ in range(2, 41):
            r.append(a1 * r[-1] + a2 * r[-2])
        return a1, a2, r[0] - a1 * r[1] - a2 * r[2], r


def test_corner_of_the_turbulence() -> None:
    """Paper, eq. 1d with Table 1: 0.6 pi * 2 * 15 / 8 = 2.25 pi rad/s; half the speed halves it."""
    assert turbulence_corner(15.0, 8.0, 1) == pytest.approx(2.25 * np.pi, rel=4 * EPS)
    assert turbulence_corner(7.5, 8.0, 1) == pytest.approx(1.125 * np.pi, rel=4 * EPS)
    assert turbulence_corner(15.0, 16.0, 2) == pytest.approx(0.6 * np.pi * 3 * 15 / 16, rel=4 * EPS)


@EXAMPLES
@given(processes())
def test_coefficients_and_drive_to_the_last_digits(p: Ar2) -> None:
    a1, a2, drive, _ = exact(p)
    # exp and cos of an argument of size x lose x eps each; the argument is at most pi here.
    assert abs(p.a1 - a1) <= 20 * EPS and abs(p.a2 - a2) <= 20 * EPS * abs(a2)
    # A product of factors each accurate to a few eps. Where sin or cos of the half angle is near its zero (the fastest,
    # least damped processes) the rounding of the angle counts (1 / distance) times.
    angle = p.omega * p.dt * np.sqrt(1 - p.damping**2)
    nearest_zero = max(abs(np.pi - angle), p.damping * p.omega * p.dt)
    assert abs(p.drive_variance / drive - 1) <= EPS * (50 + 50 / nearest_zero)
    assert np.array_equal(p.transition, [[p.a1, p.a2], [1.0, 0.0]])


@EXAMPLES
@given(processes(slowest=1e-3, least_damped=1e-3))
def test_state_covariance_is_the_lyapunov_solution(p: Ar2) -> None:
    drive = np.diag([p.drive_variance, 0.0])
    state = solve_discrete_lyapunov(p.transition, drive)
    r = p.autocovariance(2)
    # The double coefficients themselves fix the variance only to about eps / ((1 + a2) (1 - a1 - a2)).
    sensitivity = 1.0 / ((1 + p.a2) * (1 - p.a1 - p.a2)) + 1.0 / (1 + p.a1 - p.a2)
    assert np.abs(state - [[r[0], r[1]], [r[1], r[0]]]).max() <= 100 * EPS * sensitivity * r[0]


@EXAMPLES
@given(processes(), st.integers(1, 41))
def test_autocovariance_follows_yule_walker(p: Ar2, n: int) -> None:
    r = p.autocovariance(n)
    assert r.shape == (n,)
    error = max(abs(mp.mpf(float(value)) - wanted) for value, wanted in zip(r, exact(p)[3], strict=False))
    # Coefficients rounded by eps act like a drive of eps rms per step, which a slow process integrates twice: n^2 / 2.
    assert error <= 2 * EPS * (n**2 + 10) * p.rms**2
    assert r[0] == p.rms**2


@EXAMPLES
@given(processes(), st.floats(0.0, 1.0))
def test_psd_against_its_definition(p: Ar2, share: float) -> None:
    f = share * 0.5 / p.dt
    a1, a2, drive, _ = exact(p)
    with mp.workdps(50):
        q = mp.exp(-2j * mp.pi * mp.mpf(f) * mp.mpf(p.dt))
        density = 2 * mp.mpf(p.dt) * drive / abs(1 - a1 * q - a2 * q * q) ** 2
        pole = mp.exp(mp.mpc(-p.damping, mp.sqrt(1 - mp.mpf(p.damping) ** 2)) * mp.mpf(p.omega) * mp.mpf(p.dt))
        nearest = min(abs(1 - pole * q), abs(1 - mp.conj(pole) * q), abs(1 + pole))
    # Angles of at most pi are rounded by eps; so much the distance to the nearer pole is off.
    assert abs(p.psd(np.array([f]))[0] / density - 1) <= EPS * (100 + 50 / float(nearest))


@EXAMPLES
@given(processes(slowest=3e-3, least_damped=3e-3))
def test_psd_integrates_to_the_variance(p: Ar2) -> None:
    # The midpoint rule with N points over half the period of the spectrum, 2 N over all of it, gives r_0 - 2 r_2N
    # + ..., and r_2N < exp(-2 N xi omega dt) (1 + 2 N omega dt) r_0, the factor in front for damping near 1.
    points = int(np.ceil(20.0 / (p.damping * p.omega * p.dt))) + 8
    f = (np.arange(points) + 0.5) * (0.5 / p.dt) / points
    left_out = 2 * np.exp(-p.damping * p.omega * p.dt * 2 * points) * (1 + 2 * points * p.omega * p.dt)
    integral = p.psd(f).sum() * (0.5 / p.dt) / points
    # rounding: as in the test above, of the terms near the pole, which carry the integral
    rounding = EPS * (1000 + 100 / (p.damping * p.omega * p.dt))
    assert abs(integral / p.rms**2 - 1) <= left_out + rounding
    assert left_out < 1e-6


SAMPLED = [  # omega dt, damping: the paper's two, slow and fast extremes, critical damping, nearly a line
    (7.0686e-3, 0.9),
    (0.29843, 0.03),
    (1e-6, 0.9),
    (1e-5, 1e-6),
    (3.0, 0.5),
    (1.0, 1.0),
    (0.05, 1.0),
    (0.3, 1e-6),
    (2.9, 1e-6),
]


@pytest.mark.slow
@pytest.mark.parametrize(("angle", "damping"), SAMPLED)
def test_samples_are_stationary_from_the_first_step(angle: float, damping: float) -> None:
    """Over 6000 independent sequences of 12 steps: covariance of the steps 0, 1, 2 and 11 as in closed form."""
    p = Ar2(angle / 1e-3, damping, 0.7, 1e-3)
    count, n = 6000, 12
    rng = np.random.default_rng(12)
    x = np.array([p.sample(n, rng) for _ in range(count)])
    assert x.shape == (count, n)
    r = p.autocovariance(n)
    # The sample covariance of Gaussians has variance (r_0^2 + r_j^2) / count; 4.5 standard deviations, two-sided.
    for i in (0, 1, 2, n - 1):
        for j in (0, 1, n - 1):
            lag = abs(i - j)
            spread = np.sqrt((r[0] ** 2 + r[lag] ** 2) / count)
            assert abs(np.mean(x[:, i] * x[:, j]) - r[lag]) < 4.5 * spread
        assert abs(x[:, i].mean()) < 4.5 * p.rms / np.sqrt(count)
    # First differences have variance 2 (r_0 - r_1), tiny for a slow process: E d^2 within 4.5 of its relative spread.
    with mp.workdps(50):
        exact_r = exact(p)[3]
        difference = float(2 * (exact_r[0] - exact_r[1]))
    for step in (0, 5, n - 2):
        measured = np.mean((x[:, step + 1] - x[:, step]) ** 2)
        # besides the spread: differences of numbers of size rms are rounded by eps rms, the start by eps / (omega dt)^2
        assert abs(measured / difference - 1) < 4.5 * np.sqrt(2 / count) + 10 * EPS / angle**2


@pytest.mark.parametrize(("angle", "damping"), [(7.0686e-3, 0.9), (0.29843, 0.03), (1.5, 0.01), (2.9, 0.2)])
def test_a_long_sample_has_the_spectrum_of_the_process(angle: float, damping: float) -> None:
    """Averaged in 40 bands, the periodogram of a long sample over the closed form is 1."""
    p = Ar2(angle / 1e-3, damping, 0.7, 1e-3)
    n = 1 << 17
    rng = np.random.default_rng(3)
    x = p.sample(n, rng)
    f = np.fft.rfftfreq(n, p.dt)[1:-1]
    # Hann: the leakage of a plain periodogram from the peak would swamp the floor 120 dB below it.
    window = np.hanning(n + 1)[:-1]
    ratio = 2 * p.dt * np.abs(np.fft.rfft(x * window)[1:-1]) ** 2 / np.sum(window**2) / p.psd(f)
    bands = np.array_split(ratio, 40)[0:40]
    # Each ordinate is exponential of mean 1, neighbours under Hann correlated: variance 35/18 of the independent one.
    for band in bands:
        assert abs(np.mean(band) - 1) < 4.5 * np.sqrt(35 / 18 / band.size)


def test_rms_scales_and_zero_rms_is_silence() -> None:
    one = Ar2(300.0, 0.03, 1.0, 1e-3).sample(50, np.random.default_rng(0))
    milli = Ar2(300.0, 0.03, 1e-3, 1e-3).sample(50, np.random.default_rng(0))
    assert np.allclose(milli, 1e-3 * one, rtol=1e-12, atol=0)  # the same operations, scaled
    assert not Ar2(300.0, 0.03, 0.0, 1e-3).sample(50, np.random.default_rng(0)).any()
    assert Ar2(300.0, 0.03, 0.0, 1e-3).drive_variance == 0.0
