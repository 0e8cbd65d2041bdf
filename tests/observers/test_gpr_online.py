"""The online GPR against a plain solve at every step, itself against the naive kernel and long arithmetic."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.signal import butter, lfilter, sosfilt

from wfsobs.evaluation.scores import lag
from wfsobs.execution import run_observer
from wfsobs.observers.gpr.online import predict_sliding
from wfsobs.observers.gpr.windows import ConditionError, SquaredExponential
from wfsobs.progress import Cancelled, Watch
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate

EPS = np.finfo(float).eps


def record_like(n: int, channels: int, amplitude: float, seed: int) -> np.ndarray:
    """A slow process of some `amplitude` and white noise of 0.02, (n, channels)."""
    rng = np.random.default_rng(seed)
    slow = lfilter([0.2], [1.0, -0.98], rng.standard_normal((n, channels)), axis=0)
    return amplitude * slow + 0.02 * rng.standard_normal((n, channels))


def targets_like(n: int, seed: int) -> np.ndarray:
    """A vibration of 15 nm and a little noise, (n,)."""
    return 0.015 * np.sin(0.3 * np.arange(n)) + 1e-3 * np.random.default_rng(seed).standard_normal(n)


def windows(x: np.ndarray, first: int, last: int, d: int) -> np.ndarray:
    """The windows ending at first ... last, one row each."""
    return np.array([x[j - d + 1 : j + 1].ravel() for j in range(first, last + 1)])


def split_solve(
    X: np.ndarray, f: np.ndarray, tests: np.ndarray, kernel: SquaredExponential
) -> tuple[np.ndarray, np.ndarray, float]:
    """Textbook regression with K = M + s2 delta delta' kept apart and one plain solve. Returns (mean, variance of a noisy
    target, condition number of M + sigma_n^2 I)."""
    l2, s2, m = kernel.length_scale**2, kernel.signal_std**2, len(X)
    Z = np.vstack([X, tests])
    g = Z @ Z.T / l2
    norm = np.diag(g)
    distance = np.add.outer(norm, norm) - 2.0 * g
    if norm.max() > 1.0:  # differences of large numbers
        distance = np.array([np.sum((Z - z) ** 2, axis=1) for z in Z]) / l2
    delta = np.exp(-0.5 * norm)
    # s2 (exp(-distance / 2) - delta delta'), the second taken out of the first where the exponent allows
    M = s2 * np.where(
        g > 0, -np.exp(-0.5 * distance) * np.expm1(-np.abs(g)), np.outer(delta, delta) * np.expm1(np.minimum(g, 0.0))
    )
    T = M[:m, :m] + kernel.noise_std**2 * np.eye(m)
    kappa, d_m, d_t = M[m:, :m], delta[:m], delta[m:]
    a, b, c = np.linalg.solve(T, f), np.linalg.solve(T, d_m), np.linalg.solve(T, kappa.T)
    border, scale = d_t - kappa @ b, 1.0 / s2 + d_m @ b
    mean = kappa @ a + border * (d_m @ a) / scale
    variance = np.diag(M)[m:] + kernel.noise_std**2 - np.sum(kappa * c.T, axis=1) + border**2 / scale
    return mean, variance, float(np.linalg.cond(T))


def split_sliding(
    x: np.ndarray, f: np.ndarray, d: int, m: int, kernel: SquaredExponential, steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """The same at some steps of a record: step k learns from the windows k - m ... k - 1 and their targets."""
    found = [split_solve(windows(x, k - m, k - 1, d), f[k - m : k], windows(x, k, k, d), kernel) for k in steps]
    return np.concatenate([v[0] for v in found]), np.concatenate([v[1] for v in found]), max(v[2] for v in found)


def naive_solve(X: np.ndarray, f: np.ndarray, tests: np.ndarray, kernel: SquaredExponential) -> tuple[np.ndarray, float]:
    """The formula as printed: k' (K + sigma_n^2 I)^-1 f, and the condition number."""

    def k(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        distance = np.sum((p[:, None] - q[None]) ** 2, axis=2)
        return kernel.signal_std**2 * np.exp(-0.5 * distance / kernel.length_scale**2)

    K = k(X, X) + kernel.noise_std**2 * np.eye(len(X))
    return k(tests, X) @ np.linalg.solve(K, f), float(np.linalg.cond(K))


def long_solve(X: np.ndarray, f: np.ndarray, tests: np.ndarray, kernel: SquaredExponential) -> tuple[list[Any], list[Any]]:
    """The formula as printed, in 60 digits (200 bits): mean and variance of a noisy target."""
    with mp.workdps(60):
        s2, l2, n2 = (mp.mpf(v) ** 2 for v in (kernel.signal_std, kernel.length_scale, kernel.noise_std))
        P, T = ([[mp.mpf(float(v)) for v in row] for row in rows] for rows in (X, tests))

        def k(p: list[Any], q: list[Any]) -> mp.mpf:
            return s2 * mp.exp(-sum((v - w) ** 2 for v, w in zip(p, q, strict=True)) / (2 * l2))

        K = mp.matrix([[k(p, q) + (n2 if i == j else 0) for j, q in enumerate(P)] for i, p in enumerate(P)])
        inverse = K**-1
        F = mp.matrix([mp.mpf(float(v)) for v in f])
        rows = [mp.matrix([[k(t, p) for p in P]]) for t in T]
        mean = [(row * inverse * F)[0] for row in rows]
        return mean, [s2 + n2 - (row * inverse * row.T)[0] for row in rows]


kernels = st.builds(
    lambda s, length, noise: SquaredExponential(10**s, 10**length, 10**noise),
    st.floats(-1.0, 2.5),
    st.floats(-1.0, 5.0),
    st.floats(-3.0, 0.5),
)
PAPER = SquaredExponential(30.0, 300.0, 0.1)


# ---------------------------------------------------------------------- the oracle itself


@settings(max_examples=12, deadline=None, derandomize=True)
@given(kernels, st.integers(2, 9), st.integers(1, 6), st.floats(-1.5, 0.5), st.integers(0, 2**31))
@example(PAPER, 9, 6, -0.5, 0)
@example(SquaredExponential(10.0, 1e5, 0.13), 8, 4, 0.4, 1)
def test_the_plain_split_solve_in_sixty_digits(
    kernel: SquaredExponential, m: int, d: int, log_amplitude: float, seed: int
) -> None:
    x, f = record_like(d + m + 6, 2, 10**log_amplitude, seed), targets_like(d + m + 6, seed)
    X, tests = windows(x, d - 1, d + m - 2, d), windows(x, d + m - 1, d + m + 5, d)
    mean, variance, condition = split_solve(X, f[d - 1 : d + m - 1], tests, kernel)
    exact_mean, exact_variance = long_solve(X, f[d - 1 : d + m - 1], tests, kernel)
    scale = max(float(mp.norm(mp.matrix(exact_mean), mp.inf)), 1e-30)
    # 1e-12, or where M itself is ill conditioned what any solve loses
    bound = max(1e-12, 20 * EPS * condition)
    assert max(abs(mp.mpf(float(v)) - w) for v, w in zip(mean, exact_mean, strict=True)) <= bound * scale
    assert max(abs(mp.mpf(float(v)) / w - 1) for v, w in zip(variance, exact_variance, strict=True)) <= bound


@pytest.mark.parametrize(("length_scale", "signal_std", "noise_std"), [(2.0, 1.0, 0.3), (0.5, 0.1, 0.05), (10.0, 0.3, 1.0)])
def test_where_the_printed_formula_is_well_conditioned_all_three_agree(
    length_scale: float, signal_std: float, noise_std: float
) -> None:
    kernel = SquaredExponential(signal_std, length_scale, noise_std)
    d, m = 12, 60
    x, f = record_like(300, 2, 0.3, 4), targets_like(300, 5)
    steps = np.array([d + m - 1, 100, 222, 299])
    got, _ = predict_sliding(x, f, d, m, kernel)
    split, _, _ = split_sliding(x, f, d, m, kernel, steps)
    for i, k in enumerate(steps):
        naive, condition = naive_solve(windows(x, k - m, k - 1, d), f[k - m : k], windows(x, k, k, d), kernel)
        assert condition < 1e5
        # eps times the condition, 2e-11, of the largest estimate
        assert abs(naive[0] - split[i]) < 1e-10 * np.abs(split).max()
        assert abs(naive[0] - got[k]) < 1e-10 * np.abs(split).max()


# ---------------------------------------------------------------------- the recursion against the plain solve


@pytest.mark.slow
@settings(max_examples=45, deadline=None, derandomize=True)
@given(
    kernels | st.just(PAPER),
    st.sampled_from([2, 3, 4, 7, 8, 9, 15, 16, 17, 31, 32, 33, 63, 64, 65, 127, 128, 129]) | st.integers(2, 140),
    st.sampled_from([1, 2, 3]) | st.integers(1, 60),
    st.integers(1, 2),
    st.floats(-1.5, 0.5),
    st.integers(1, 300),
    st.integers(0, 2**31),
)
@example(SquaredExponential(30.0, 0.1, 0.1), 40, 30, 2, 0.5, 100, 0)
@example(SquaredExponential(30.0, 1e5, 0.1), 129, 60, 2, 0.5, 300, 1)
@example(SquaredExponential(10.0, 1.0, 0.13), 64, 1, 1, -0.5, 200, 2)
def test_sliding_predictions_are_those_of_a_plain_solve(
    kernel: SquaredExponential, m: int, d: int, channels: int, log_amplitude: float, more: int, seed: int
) -> None:
    n = d + m - 1 + more
    x, f = record_like(n, channels, 10**log_amplitude, seed), targets_like(n, seed)
    first = d + m - 1
    steps = np.unique(np.linspace(first, n - 1, 9).astype(int))
    mean, variance, condition = split_sliding(x, f, d, m, kernel, steps)
    got, spread = predict_sliding(x, f, d, m, kernel)
    assert got.shape == spread.shape == (n,)
    assert np.isnan(got[:first]).all() and np.isnan(spread[:first]).all()
    assert np.isfinite(got[first:]).all() and (spread[first:] > 0).all()
    bound = max(1e-10, 100 * EPS * condition)
    # Estimates that hardly vary (l huge: their mean; windows far longer than l: none, they underflow) are still numbers
    # rounded to eps of themselves and of the targets.
    scale = mean.std() if len(mean) > 3 else np.abs(mean).max()
    assert np.abs(got[steps] - mean).max() <= bound * scale + 10 * EPS * (f.std() + np.abs(mean).max())
    assert np.abs(spread[steps] / variance - 1).max() <= bound


def test_the_papers_size() -> None:
    """m = 511, d = 170, u and y: across a border between runs (256 steps), amplitudes of the preset."""
    x, f = record_like(1100, 2, 0.3, 7), targets_like(1100, 8)
    steps = np.array([680, 681, 700, 935, 936, 937, 1099])
    mean, variance, condition = split_sliding(x, f, 170, 511, PAPER, steps)
    got, spread = predict_sliding(x, f, 170, 511, PAPER)
    assert condition < 1e6
    assert np.abs(got[steps] - mean).max() < 1e-10 * mean.std()
    assert np.abs(spread[steps] / variance - 1).max() < 1e-10


@pytest.mark.parametrize("m", [2, 7, 8, 40])
def test_a_record_that_is_just_long_enough_or_not(m: int) -> None:
    d = 5
    x, f = record_like(d + m, 1, 0.3, 0), targets_like(d + m, 0)
    got, _ = predict_sliding(x, f, d, m, PAPER)
    assert np.isnan(got[:-1]).all() and np.isfinite(got[-1])
    shorter, _ = predict_sliding(x[:-1], f[:-1], d, m, PAPER)
    assert np.isnan(shorter).all() and shorter.shape == (d + m - 1,)


def test_blocks_are_delivered_once_each_and_in_order() -> None:
    x, f = record_like(700, 1, 0.3, 0), targets_like(700, 0)
    seen: list[tuple[int, int]] = []
    parts: list[np.ndarray] = []

    def deliver(start: int, stop: int, mean: np.ndarray) -> None:
        seen.append((start, stop))
        parts.append(mean.copy())

    got, _ = predict_sliding(x, f, 10, 50, PAPER, deliver)
    assert seen[0][0] == 59 and seen[-1][1] == 700
    assert all(a[1] == b[0] for a, b in pairwise(seen))
    assert np.array_equal(np.concatenate(parts), got[59:])


def test_scaling_targets_scales_estimates() -> None:
    x, f = record_like(300, 2, 0.3, 0), targets_like(300, 0)
    one, spread = predict_sliding(x, f, 10, 50, PAPER)
    other, same = predict_sliding(x, -1000.0 * f, 10, 50, PAPER)
    assert np.allclose(other, -1000.0 * one, rtol=0, atol=1e-9 * np.nanmax(np.abs(other)), equal_nan=True)
    assert np.array_equal(spread, same, equal_nan=True)


def test_targets_of_the_test_window_and_later_are_not_used() -> None:
    """Step k learns from targets up to k - 1: changing f[k] changes estimates from k + 1 on alone."""
    x, f = record_like(400, 2, 0.3, 0), targets_like(400, 0)
    base, _ = predict_sliding(x, f, 10, 50, PAPER)
    for k in (100, 187, 188, 399):
        changed = f.copy()
        changed[k] += 0.1
        got, _ = predict_sliding(x, changed, 10, 50, PAPER)
        # a later target enters the same factorisations: rounding, 1e-12 of the estimates, may differ
        assert np.nanmax(np.abs(got - base)[: k + 1]) < 1e-10 * np.nanstd(base)
        if k + 1 < 400:
            assert abs(got[k + 1] - base[k + 1]) > 1e-6 * np.nanstd(base)


def test_what_double_precision_cannot_serve_is_refused() -> None:
    """Windows of 3 samples span 3 dimensions, so that 100 of them make M singular but for the noise."""
    x, f = record_like(400, 1, 3.0, 0), targets_like(400, 0)
    kernel = SquaredExponential(1e4, 100.0, 1e-4)
    assert split_solve(windows(x, 10, 109, 3), f[10:110], windows(x, 110, 110, 3), kernel)[2] > 1e14
    with pytest.raises(ConditionError, match="noise_std"):
        predict_sliding(x, f, 3, 100, kernel)


# ---------------------------------------------------------------------- on a record


def scenario(changes: dict[str, Any] | None = None) -> Scenario:
    base = PRESETS["paper"]()
    base.update(
        {
            "run": {"duration": 1.0, "warm_up": 0.2},
            "gpr_offline": {"training_size": 50, "depth": 20},
            "gpr_online": {"training_size": 60, "depth": 25},
        }
    )
    return base.replace(changes or {})


@pytest.mark.parametrize("inputs", ["u-y", "z"])
def test_pairs_of_window_and_target_on_a_record(inputs: str) -> None:
    """The window of step j holds u and y_lgs (or z) up to j; its target is the filtered z of step j + 1, since z[j+1] =
    phi_dist[j] + noise; step k learns from the pairs k - m ... k - 1. All of it written out here."""
    s = scenario({"gpr_online.inputs": inputs})
    record = simulate(s)
    got = run_observer("gpr-online", record, s)["vibration"]
    g, b = s.gpr_online, s.butterworth
    m, d = g.training_size, g.depth
    kernel = SquaredExponential(g.signal_std, g.length_scale, g.noise_std)
    assert np.isnan(got[: d + m - 1]).all() and np.isfinite(got[d + m - 1 :]).all()
    for mode in range(2):
        z = np.array([record.y_lgs[k, mode] - (record.u[k - 2, mode] if k > 1 else 0.0) for k in range(record.n_steps)])
        filtered = sum(
            sosfilt(
                butter(b.order, [f - b.bandwidth_online / 2, f + b.bandwidth_online / 2], "bandpass", fs=1000, output="sos"), z
            )
            for f in b.frequencies
        )
        x = z[:, None] if inputs == "z" else np.column_stack([record.u[:, mode], record.y_lgs[:, mode]])
        for k in (d + m - 1, d + m, 300, 999):
            X = windows(x, k - m, k - 1, d)
            target = np.array([filtered[j + 1] for j in range(k - m, k)])
            mean, _, condition = split_solve(X, target, windows(x, k, k, d), kernel)
            assert condition < 1e6
            assert abs(got[k, mode] - mean[0]) < 1e-9 * np.nanstd(got[:, mode])


def test_the_estimate_of_step_k_is_the_vibration_of_step_k() -> None:
    """A vibration that is known, one tone in the middle of the one band, nothing else: the filtered z of step j + 1 is
    the vibration of step j, and the estimate comes without lag. Off by one step it would lag by 1 ms, 30 % error."""
    s = scenario(
        {
            "turbulence.source": "none",
            "vibration.peaks": [{"frequency": 47.7, "damping": 0.0, "rms": [0.02, 0.02]}],
            "sensors.lgs_noise": 0.001,
            "sensors.lgs_low_frequency_rms": 0.0,
            "butterworth.frequencies": [47.7],
            "run.duration": 3.5,
            "gpr_online.training_size": 200,
            "gpr_online.depth": 60,
            "gpr_online.noise_std": 0.01,
        }
    )
    record = simulate(s)
    values = run_observer("gpr-online", record, s)["vibration"][2500:]  # the band of 2 Hz has settled to exp(-15)
    assert record.vibration is not None
    truth = record.vibration[2500:]
    for mode in range(2):
        assert np.std(values[:, mode] - truth[:, mode]) < 0.1 * truth[:, mode].std()
        found = lag(truth[:, mode], values[:, mode], record.dt)
        assert found is not None and abs(found) < 2e-4


def test_too_short_a_record_says_so() -> None:
    s = scenario({"gpr_online.training_size": 990})
    with pytest.raises(RecordError, match="1015") as caught:
        run_observer("gpr-online", simulate(s), s)
    assert "\n" not in str(caught.value)


def test_cancelling_stops_it_and_partial_results_come_before() -> None:
    s = scenario({"run.duration": 3.0})
    record = simulate(s)
    partial: list[np.ndarray] = []
    run_observer("gpr-online", record, s, Watch(partial=lambda target, values: partial.append(values.copy())))
    counts = [int(np.isfinite(values).sum()) for values in partial]
    # the two modes tell on their own threads, in any order between them
    assert len(counts) > 10 and min(counts) < 500 and max(counts) == 2 * (3000 - 84)
    asked = iter([False] * 5 + [True] * 10_000)
    with pytest.raises(Cancelled):
        run_observer("gpr-online", record, s, Watch(is_cancelled=lambda: next(asked)))
