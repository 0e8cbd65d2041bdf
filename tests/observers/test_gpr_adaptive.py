"""The adaptive GPR against dense Gaussian processes: its smoother, its regression, and what it makes of records."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from scipy.integrate import quad

import wfsobs
from tests.records import short
from wfsobs import PRESETS, simulate
from wfsobs.evaluation.scores import calibration
from wfsobs.execution import run_observer
from wfsobs.observers.gpr.adaptive import (
    RATIOS,
    factor_of,
    fit_bands,
    learn,
    nothing_learnt,
    schedule_of,
    smoother,
    standing,
    weight_covariance,
    whitener_of,
    window_products,
)
from wfsobs.observers.step import StepError
from wfsobs.record import Record, RecordError, Sampling
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.gains import steady_state
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.signal.statespace import disturbance_model
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.search import expected_above_zero, missed_variance

DT = 1e-3
TURBULENCE = Ar2(2.0 * np.pi * 3.0, 0.7, 0.4, DT)
LINE = Ar2(2.0 * np.pi * 40.0, 0.02, 0.02, DT)
NOISE = 0.02


def test_the_smoother_is_the_dense_regression_on_all_measurements() -> None:
    """Covariances of the whole window from the recursion of the state, which begins with that of the filter's prediction."""
    model, n = disturbance_model([TURBULENCE], [LINE]), 60
    P = steady_state(model.A, model.C, model.Q, np.array(NOISE**2)).P
    size = len(model.A)
    covariance = np.zeros((n, size, n, size))
    for i in range(n):
        covariance[i, :, i] = P if i == 0 else model.A @ covariance[i - 1, :, i - 1] @ model.A.T + model.Q
        for j in range(i + 1, n):
            covariance[i, :, j] = covariance[i, :, j - 1] @ model.A.T
            covariance[j, :, i] = covariance[i, :, j].T
    of_z = np.einsum("a,iajb,b->ij", model.C, covariance, model.C) + NOISE**2 * np.eye(n)
    row = model.outputs["vibration"]
    cross = np.einsum("a,iajb,b->ij", row, covariance, model.C)
    z = np.random.default_rng(1).standard_normal(n)
    expected = cross @ np.linalg.solve(of_z, z)
    got = smoother(model, "vibration", NOISE).run(z)
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())


def test_the_variance_of_the_smoother_is_that_of_the_two_sided_wiener_filter() -> None:
    """The integral of S_v (S_z - S_v) / S_z; on a grid of 2^18 frequencies it is exact to 1e-6 for a line this wide."""
    f = np.fft.rfftfreq(2**18, DT)
    line, rest = LINE.psd(f), TURBULENCE.psd(f) + 2.0 * DT * NOISE**2
    density = line * rest / (line + rest)
    expected = (density.sum() - 0.5 * (density[0] + density[-1])) * f[1]
    assert smoother(disturbance_model([TURBULENCE], [LINE]), "vibration", NOISE).variance == pytest.approx(expected, rel=1e-6)


def windows(depth: int, m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Samples, targets, the windows (m, depth) that end at 2 depth and later, newest first, and a covariance of weights."""
    rng = np.random.default_rng(3)
    x = rng.standard_normal(2 * depth + m)
    X = sliding_window_view(x, depth)[depth + 1 : depth + 1 + m, ::-1]
    covariance = LINE.autocovariance(depth)
    return x, X @ (covariance * 100.0) + 0.3 * rng.standard_normal(m), X, covariance


@pytest.mark.parametrize("depth", [1, 7, 40])
def test_products_of_windows_slide(depth: int) -> None:
    x, targets, X, _ = windows(depth, 90)
    gram, along = window_products(x, targets, 2 * depth, depth)
    np.testing.assert_allclose(gram, X.T @ X, rtol=0.0, atol=1e-12 * len(X))
    np.testing.assert_allclose(along, X.T @ targets, rtol=0.0, atol=1e-12 * len(X))
    np.testing.assert_allclose(window_products(x, targets, depth, depth)[0][0, 0], np.sum(x[depth : depth + 90] ** 2), rtol=1e-12)


def test_the_weights_are_dense_regression_on_the_same_windows() -> None:
    """k(x)' (K + sigma_n^2 I)^-1 f with the kernel x'C x', its likeliest noise and its standard deviations."""
    x, targets, X, covariance = windows(40, 300)
    got, L = fit_bands(x, targets, 80, covariance), factor_of(covariance)
    K, m = X @ L @ L.T @ X.T, len(X)
    inverse = np.linalg.inv(K + got.ratio * np.eye(m))
    scale = targets @ inverse @ targets / m  # s^2, likeliest
    new = np.random.default_rng(4).standard_normal((5, 40))
    expected = new @ L @ L.T @ X.T @ inverse @ targets
    np.testing.assert_allclose(new @ got.weights, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())
    assert got.noise == pytest.approx(np.sqrt(scale * got.ratio), rel=1e-9)
    variance = scale * np.diag(K - K @ inverse @ K)
    assert got.spread == pytest.approx(np.sqrt(variance.mean()), rel=1e-6)

    def likelihood(ratio: float) -> float:
        M = K + ratio * np.eye(m)
        return -0.5 * (m * np.log(targets @ np.linalg.solve(M, targets)) + np.linalg.slogdet(M)[1])

    step = RATIOS[1] / RATIOS[0]
    assert likelihood(got.ratio) > max(likelihood(got.ratio * step), likelihood(got.ratio / step))


def test_the_factor_is_that_of_the_kernel() -> None:
    covariance = LINE.autocovariance(60)
    L, lags = factor_of(covariance, 1e-3), np.arange(60)
    expected = covariance[np.abs(lags[:, None] - lags)] / covariance[0]
    assert np.abs(L @ L.T - expected).max() < 1e-3  # what a pivoted factor leaves is largest on the diagonal
    assert L.shape[1] < 30  # one damped line has few dimensions


def test_inputs_are_white_where_there_is_the_continuum_alone() -> None:
    """Of variance one, at all frequencies: |1 / H|^2 (S_turbulence + noise) = 2 dt."""
    fit = Spectrum(NOISE, DT, TURBULENCE, (LINE,))
    F, G, H, J = whitener_of(fit)
    f = np.linspace(1.0, 450.0, 40)
    gains = [J + H @ np.linalg.solve(np.exp(2j * np.pi * one * DT) * np.eye(len(F)) - F, G) for one in f]
    density = np.abs(np.ravel(gains)) ** 2 * Spectrum(NOISE, DT, TURBULENCE).psd(f)
    np.testing.assert_allclose(density, 2.0 * DT, rtol=1e-9)


def test_weights_follow_the_lines() -> None:
    """Their spectrum is S_v S_c / S_z: with a line alone, the covariance is that of a narrow band at its frequency."""
    covariance = weight_covariance(Spectrum(NOISE, DT, TURBULENCE, (LINE,)), 400)
    spectrum = np.abs(np.fft.rfft(covariance * np.hanning(800)[400:], 4000))
    assert abs(np.argmax(spectrum) * 0.25 - 40.0) < 1.0
    assert np.abs(covariance).max() == covariance[0] > 0.0


def test_a_peak_that_is_worth_little_is_no_line() -> None:
    """Its gain of likelihood in white noise alone is about one half per parameter; that of the line hundreds."""
    rng = np.random.default_rng(5)
    z = LINE.sample(4000, rng) + NOISE * rng.standard_normal(4000)
    weak = Ar2(2.0 * np.pi * 200.0, 0.01, 1e-4, DT)
    found = standing(Spectrum(NOISE, DT, None, (LINE, weak)), z - z.mean())
    assert found.resonances == (LINE,)


def test_it_finds_the_best_filter_of_a_process() -> None:
    """Learnt from 8 s its error is 1 to 1.1 times that of the Kalman filter of the truth, on 20 s that it has not seen."""
    rng = np.random.default_rng(6)
    vibration = LINE.sample(28_001, rng)
    z = TURBULENCE.sample(28_001, rng)
    z[1:] += vibration[:-1]  # measured one step late
    z = z[1:] + NOISE * rng.standard_normal(28_000)
    truth = vibration[1:]
    found = learn(z[:8000], DT, 300, 20, 5.0, nothing_learnt(300))
    x = PeriodicFilter([found.whitener]).run((z - found.mean)[:, None])[:, 0]
    errors = (np.convolve(x, found.weights)[: len(z)] - truth)[8000:]
    model = disturbance_model([TURBULENCE], [LINE])
    P = steady_state(model.A, model.C, model.Q, np.array(NOISE**2)).posterior
    row = model.outputs["vibration"]
    best = np.sqrt(row @ P @ row)
    rms = np.sqrt(np.mean(errors**2))
    assert 0.97 * best < rms < 1.1 * best  # 20 s scatter by 2 %
    assert 0.9 * rms < found.sd < 1.5 * rms  # and it knows, but not that no line hides in the turbulence of 0.4 um


def test_where_no_line_stands_out_it_answers_zero() -> None:
    z = np.random.default_rng(7).standard_normal(3000)
    found = learn(TURBULENCE.sample(3000, np.random.default_rng(8)) + NOISE * z, DT, 100, 20, 5.0, nothing_learnt(100))
    assert not found.weights.any()
    assert 0.0 < found.sd < 0.5 * 0.4  # what may be missed: less than the turbulence
    still = np.zeros((1500, 1))
    got = run_observer("gpr-adaptive", Record(still, still, DT), PRESETS["paper"]().replace({"adaptive.window": 1.0}))
    first = Sampling(1, DT).delay + 500
    assert np.isnan(got["vibration"][:first]).all()
    assert not got["vibration"][first:].any()


def test_what_cannot_be_identified_leaves_what_was_learnt_last() -> None:
    last = nothing_learnt(10)
    assert learn(np.full(200, np.nan), DT, 10, 20, 5.0, last) is last


@pytest.mark.slow
def test_it_learns_the_vibration_ahead() -> None:
    """A line far above the noise: five frames ahead its error is that of the truth's own innovations, not that of the lag."""
    rng = np.random.default_rng(9)
    line = Ar2(2.0 * np.pi * 40.0, 1e-3, 0.1, DT)
    vibration = line.sample(3001, rng)
    z = vibration[:-1] + 0.005 * rng.standard_normal(3000)
    scenario = PRESETS["paper"]().replace({"adaptive.window": 1.0})
    step = wfsobs.design("gpr-adaptive", scenario, sampling=Sampling(1, DT), horizon=5)
    out = []
    for value in z:
        step.update([value])
        out.append(float(step.predict(5)[0][0]))
    truth = vibration[1:]
    error = np.array(out)[1500:2900] - truth[1505:2905]
    late = truth[1500:2900] - truth[1505:2905]
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(late**2))


def test_refusals() -> None:
    record, scenario = short("paper")
    with pytest.raises(RecordError, match=r"half of adaptive\.window and one more are 50003"):
        run_observer("gpr-adaptive", record, scenario.replace({"adaptive.window": 100.0}))
    with pytest.raises(StepError, match="600 frames ahead: takes less than an eighth"):
        wfsobs.design("gpr-adaptive", scenario, sampling=record.sampling, horizon=600)


@pytest.mark.slow
def test_in_strong_turbulence_it_beats_thirty_taps_and_zero() -> None:
    """Tip and tilt, rms over seeds 1 to 10; nothing beats the bound of 13.17 and 11.72 nm by more than its scatter."""
    squares: dict[str, list[np.ndarray]] = {"gpr-adaptive": [], "ridge-30": [], "zero": []}
    for seed in range(1, 11):
        scenario = PRESETS["strong-turbulence"]().replace({"run.seed": seed})
        record = simulate(scenario)
        for name, found in squares.items():
            error = (run_observer(name, record, scenario)["vibration"] - record.vibration)[4100:]
            found.append(np.mean(error**2, axis=0))
    rms = {name: 1e3 * np.sqrt(np.mean(found, axis=0)) for name, found in squares.items()}
    assert (rms["gpr-adaptive"] < rms["zero"]).all()
    assert (rms["gpr-adaptive"] < rms["ridge-30"]).all()
    assert (rms["gpr-adaptive"] > [12.5, 11.1]).all()


@pytest.mark.parametrize("estimate", [-6.0, -1.0, 0.0, 0.4, 5.0])
@pytest.mark.parametrize("scale", [0.3, 2.0, 50.0])
def test_the_expectation_of_what_is_missed(estimate: float, scale: float) -> None:
    """By quadrature of prior times likelihood."""

    def density(x: float) -> float:
        return float(np.exp(-x / scale - 0.5 * (x - estimate) ** 2 + 0.5 * min(estimate, 0.0) ** 2))

    expected = quad(lambda x: x * density(x), 0.0, 20.0)[0] / quad(density, 0.0, 20.0)[0]
    got = expected_above_zero(np.array([estimate]), np.ones(1), scale)[0]
    assert got == pytest.approx(expected, rel=1e-6)


def test_what_is_missed_between_the_lines() -> None:
    """White noise and thirty lines: that of a spectrum without them is their variance; of noise alone it is next to nothing."""
    rng, n = np.random.default_rng(9), 8000
    t, frequencies = DT * np.arange(n), rng.uniform(6.0, 78.0, 30)
    lines = 0.02 * np.cos(2.0 * np.pi * (frequencies * t[:, None] + rng.random(30))).sum(axis=1)
    noise = NOISE * rng.standard_normal(n)
    spectrum = Spectrum(NOISE, DT)
    # the noise in 600 bins is known to 4 %, 1.5 % of the lines; shrinking takes off s^2 / scale, 8 bins of noise in each octave
    assert missed_variance(spectrum, noise + lines) == pytest.approx(30 * 0.02**2 / 2, rel=0.05)
    assert missed_variance(spectrum, noise) < 0.05 * 30 * 0.02**2 / 2
    assert missed_variance(spectrum, noise, 90.0) == 0.0  # no whole octave below 100 Hz


@pytest.mark.slow
def test_it_is_about_as_sure_as_it_may_be() -> None:
    """Vibration hidden in turbulence: 68 and 95 % within the bands, tip and tilt of four seeds, whose scatter is 3 and 2 %."""
    shares = []
    for seed in range(11, 15):
        scenario = PRESETS["strong-turbulence"]().replace({"run.seed": seed})
        record = simulate(scenario)
        estimate = run_observer("gpr-adaptive", record, scenario)
        for mode in range(2):
            error = np.asarray(estimate["vibration"])[4100:, mode] - np.asarray(record.vibration)[4100:, mode]
            found = calibration(error, estimate.sd["vibration"][4100:, mode])
            assert found is not None
            shares.append((found.within_68, found.within_95))
    low, high = np.mean(shares, axis=0)
    assert 0.62 < low < 0.80 and 0.91 < high < 0.99


def test_between_two_times_of_learning_it_is_a_fixed_filter_of_whitened_measurements() -> None:
    """Oracle: the windows of the record by themselves, learnt, whitened and convolved with the weights."""
    scenario = PRESETS["paper"]().replace({"run.duration": 2.5, "adaptive.window": 1.0})
    record, a = simulate(scenario), scenario.adaptive
    got = run_observer("gpr-adaptive", record, scenario)["vibration"][:, 0]
    s, delay, z = schedule_of(a, record.dt), record.delay, record.z[:, 0]
    want, last = np.full(record.n_steps, np.nan), nothing_learnt(s.depth)
    z = z[delay:]
    for now in range(s.first, len(z), s.interval):
        start, stop = max(now - s.longest, 0), min(now + s.interval, len(z))
        last = learn(z[start:now], record.dt, s.depth, a.peak_count, a.lowest, last)
        x = PeriodicFilter([last.whitener]).run((z[start:stop] - last.mean)[:, None], since=now - start - s.depth + 1)
        want[delay + now : delay + stop] = np.convolve(x[:, 0], last.weights, "valid")
    assert np.nanstd(want) > 1e-3, "the vibration of the paper has 10 nm"
    # sums in another order, and the condition of the kernel
    np.testing.assert_allclose(got, want, rtol=0.0, atol=1e-9 * np.nanstd(want))
