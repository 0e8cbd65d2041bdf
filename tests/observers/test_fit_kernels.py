"""Kernels fitted to records by likelihood: standard deviations, the dense likelihood, and observers that are told of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import sqrtm

import wfsobs
from wfsobs import RecordError
from wfsobs.observers.gp import Kernel, Matern, Poles, QuasiPeriodic, Sho, SquaredExponentialInTime, Sum, kernels_of
from wfsobs.prior import Lines
from wfsobs.priors_from.scenario import prior_of
from wfsobs.record import Record
from wfsobs.typing import Array

DT, NOISE = 2e-3, 0.02
AIR, LINE = Matern(0.3, 0.05, 3), Sho(0.05, 250.0, 0.06)


def drawn(kernel: Kernel, n: int, modes: int, seed: int) -> Record:
    """A record whose z is the kernel's own state space and white noise."""
    space, rng = kernel.state_space(), np.random.default_rng(seed)
    A, Q = space.discretise(DT)
    root, drive = (np.real(sqrtm(x)) for x in (space.P, Q))
    x, z = root @ rng.standard_normal((len(A), modes)), np.empty((n, modes))
    for k in range(n):
        z[k], x = space.h @ x, A @ x + drive @ rng.standard_normal((len(A), modes))
    z += NOISE * rng.standard_normal(z.shape)
    return Record(z, np.zeros_like(z), DT, delay=1)


def dense(kernel: Kernel, noise: float, z: Array) -> float:
    """Log-likelihood of the samples that there are, by Cholesky."""
    there = np.isfinite(z)
    covariance = kernel.state_space().covariance(DT * np.arange(len(z)))
    K = covariance[np.abs(np.subtract.outer(np.arange(len(z)), np.arange(len(z))))][np.ix_(there, there)]
    L = np.linalg.cholesky(K + noise**2 * np.eye(there.sum()))
    e = np.linalg.solve(L, z[there])
    return float(-0.5 * e @ e - np.log(np.diag(L)).sum() - 0.5 * len(e) * np.log(2.0 * np.pi))


@pytest.mark.slow
def test_numbers_are_within_their_standard_deviations() -> None:
    record = drawn(Sum((AIR, LINE)), 1200, 3, 1)
    record.y_lgs[500:560] = np.nan  # the lasers are out
    found = wfsobs.fit_kernels(record, turbulence=[Matern(0.2, 0.08, 3)], vibration=[Sho(0.03, 240.0, 0.05)], noise=0.03)
    truth = {"turbulence.0.rms": 0.3, "turbulence.0.scale": 0.05, "vibration.0.rms": 0.05, "vibration.0.omega": 250.0}
    truth |= {"vibration.0.damping": 0.06, "noise": NOISE}
    assert [set(mode.numbers) for mode in found.modes] == [set(truth)] * 3
    # In logarithms, in which the likelihood of positive numbers is more nearly normal.
    z = [np.log(x.value / truth[name]) / (x.std / x.value) for mode in found.modes for name, x in mode.numbers.items()]
    # 18 numbers: the mean square of independent ones is 1 +- 0.33; rms and length scale, rms and damping go together
    assert np.abs(z).max() < 4.0 and 0.2 < np.mean(np.square(z)) < 2.3


def test_the_maximum_and_its_curvature_are_those_of_the_dense_likelihood() -> None:
    """With a tenth of the samples missing."""
    record = drawn(AIR, 250, 1, 2)
    record.y_lgs[np.random.default_rng(1).random(250) < 0.1] = np.nan
    (mode,) = wfsobs.fit_kernels(record, turbulence=[AIR], noise=NOISE).modes
    z, best = record.y_lgs[1:, 0], np.log([number.value for number in mode.numbers.values()])
    assert list(mode.numbers) == ["turbulence.0.rms", "turbulence.0.scale", "noise"] and mode.noise == mode.numbers["noise"]

    def at(*moves: Array) -> float:
        rms, scale, noise = np.exp(best + np.sum(moves, axis=0))
        return dense(Matern(rms, scale, 3), noise, z)

    step = 0.02 * np.eye(3)
    assert mode.log_likelihood == pytest.approx(at(step[0], -step[0]), rel=1e-9)
    curvature = np.array([[(at(a, b) - at(a, -b) - at(-a, b) + at(-a, -b)) / 0.04**2 for b in step] for a in step])
    std = np.sqrt(np.diag(np.linalg.inv(-curvature)))
    # Differences over 0.04 of a likelihood whose third derivative is some three times its second.
    assert [x.std / x.value for x in mode.numbers.values()] == pytest.approx(std, rel=0.02)
    slope = np.array([(at(a) - at(-a)) / 0.04 for a in step])
    assert np.abs(slope * std).max() < 0.02, "in standard deviations from the maximum"


TOLD = {
    "oscillators": ((Sho(0.3, 30.0, 0.4),), ()),
    "matern": ((Matern(0.3, 0.05, 5),), (Matern(0.03, 1.5e-3, 1),)),
    "squared exponential": ((SquaredExponentialInTime(0.3, 0.05, 6),), ()),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TOLD)
def test_observers_are_told_of_what_was_found(name: str) -> None:
    """Learnt on one record, used on another."""
    air, colour = TOLD[name]
    found = wfsobs.fit_kernels(drawn(Sum((*air, LINE, *colour)), 400, 2, 3), turbulence=air, vibration=[LINE], background=colour)
    scenario, other = found.scenario(), drawn(Sum((*air, LINE, *colour)), 400, 2, 4)
    lines = prior_of(scenario, other, (Lines,)).lines
    lags = DT * np.arange(50)
    for mode, told in zip(found.modes, lines, strict=True):
        assert told.noise == pytest.approx(mode.noise.value, rel=1e-9)
        for kernel, parts in zip(kernels_of(told, scenario.gp), (mode.turbulence, mode.vibration), strict=False):
            want = Sum(parts).state_space().covariance(lags)
            np.testing.assert_allclose(kernel.state_space().covariance(lags), want, rtol=0, atol=1e-9 * want[0])
    assert (scenario.gp.background_rms > 0) == bool(colour)
    result = wfsobs.observe(other, scenario, observers=["gp-lgs"])
    ahead = result.estimate("gp-lgs", "turbulence").values + result.estimate("gp-lgs", "vibration").values
    left = (other.y_lgs[101:] - ahead[100:-1]).std()
    # The filter's prediction of the next measurement: no better than the noise, and far better than the signal.
    assert NOISE < left < 0.5 * other.y_lgs.std()


@pytest.mark.slow
def test_what_cannot_be_fitted_is_refused_in_one_line() -> None:
    record = drawn(AIR, 150, 1, 5)
    with pytest.raises(ValueError, match="there is no kernel to fit"):
        wfsobs.fit_kernels(record)
    for kernel in (Poles(1.0, (-1.0 + 0j,)), Sum((AIR, LINE))):
        with pytest.raises(ValueError, match="cannot be fitted"):
            wfsobs.fit_kernels(record, turbulence=[kernel])
    with pytest.raises(RecordError, match="fewer than 100 samples"):
        wfsobs.fit_kernels(drawn(AIR, 80, 1, 5), turbulence=[AIR])
    found = wfsobs.fit_kernels(record, turbulence=[AIR], vibration=[QuasiPeriodic(0.05, 0.02, 0.5, 1.0, 1)])
    with pytest.raises(ValueError, match="observers take"):
        found.scenario()


@pytest.mark.parametrize(
    ("start", "line"),
    [
        ({"turbulence": [Matern(0.0, 0.05)]}, r"turbulence\.0\.rms = 0\.0: takes a number above 0 to start from"),
        ({"vibration": [LINE, Sho(0.05, -250.0, 0.06)]}, r"vibration\.1\.omega = -250\.0: takes a number above 0"),
        ({"turbulence": [AIR], "noise": 0.0}, r"noise = 0\.0: takes a number above 0 to start from"),
        ({"turbulence": AIR}, r"turbulence: takes a sequence of kernels, not a Matern"),
        ({"background": [3]}, r"background\.0: takes a kernel, not a int"),
    ],
)
def test_a_search_that_cannot_start_is_refused_in_one_line(start: dict[str, Any], line: str) -> None:
    with pytest.raises(ValueError, match=f"^{line}"):
        wfsobs.fit_kernels(drawn(AIR, 150, 1, 5), **start)


def test_a_search_that_ends_short_of_the_maximum_states_no_deviation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rms, held at a tenth above a start that is five times too small; the curvature there is positive all the same."""
    monkeypatch.setattr("wfsobs.identification.kernels.FARTHEST", 1.1)
    (mode,) = wfsobs.fit_kernels(drawn(AIR, 400, 1, 3), turbulence=[Matern(0.06, 0.05, 3)], noise=NOISE).modes
    rms = mode.numbers["turbulence.0.rms"]
    assert rms.value == pytest.approx(0.066, rel=1e-6) and np.isnan(rms.std)
