"""The streaming online GPR gives the numbers of the record version, for any length of stream."""

import numpy as np
import pytest
from scipy.signal import lfilter

from wfsobs.execution import run_observer
from wfsobs.observers.base import VIBRATION
from wfsobs.observers.gpr import sliding_regression
from wfsobs.observers.gpr.online import GPR_ONLINE, gpr_online, predict_sliding
from wfsobs.observers.gpr.sliding_regression import ENOUGH, SlidingRegression
from wfsobs.observers.gpr.windows import ConditionError, SquaredExponential
from wfsobs.observers.step import run_frames
from wfsobs.priors_from.scenario import prior_of
from wfsobs.progress import QUIET
from wfsobs.scenario.presets import paper
from wfsobs.simulation.loop import simulate

EPS = np.finfo(float).eps


def slow_and_noisy(n, amplitude, seed=0):
    """Samples like a closed-loop record's: a slow process plus white noise, two channels."""
    rng = np.random.default_rng(seed)
    slow = lfilter([0.02], [1.0, -0.98], rng.standard_normal((n, 2)), axis=0) / 0.1
    return amplitude * slow + 0.02 * rng.standard_normal((n, 2))


def targets_of(n, seed=1):
    return np.sin(0.3 * np.arange(n)) * 0.01 + np.random.default_rng(seed).standard_normal(n) * 1e-3


def stream(regression, signals, targets):
    """Predictions of a SlidingRegression fed sample by sample; the target of window k - 1 comes with sample k."""
    out = np.empty(len(signals))
    for k, sample in enumerate(signals):
        out[k] = regression.predict(sample[None], targets[k - 1 : k] if k else targets[-1:])[0]
        regression.update()
    return out


def split_direct(signals, targets, depth, m, kernel, steps):
    """Textbook: covariance in split form and a direct solve at each step. Returns predictions and condition."""
    out, worst = [], 0.0
    for k in steps:
        X = np.array([signals[j - depth + 1 : j + 1].ravel() for j in range(k - m, k + 1)])
        G = X @ X.T / kernel.length_scale**2
        delta = np.exp(-0.5 * np.diag(G))
        # expm1(g) delta delta' without overflow for windows far longer than the length scale
        exponent = np.maximum(G, 0) - 0.5 * np.add.outer(np.diag(G), np.diag(G))
        M = kernel.variance * np.exp(exponent) * np.sign(G) * -np.expm1(-np.abs(G))
        T = M[:m, :m] + kernel.noise_std**2 * np.eye(m)
        a, b = np.linalg.solve(T, np.column_stack([targets[k - m : k], delta[:m]])).T
        kappa = M[m, :m]
        border = (delta[m] - kappa @ b) / (1 / kernel.variance + delta[:m] @ b)
        out.append(kappa @ a + border * (delta[:m] @ a))
        worst = max(worst, np.linalg.cond(T))
    return np.array(out), worst


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["raw", "high-pass", "standardised"])
@pytest.mark.parametrize("inputs", ["u-y", "z"])
@pytest.mark.parametrize("enough", [0.0, ENOUGH])
def test_the_stream_gives_the_numbers_of_the_record_version(inputs, kind, enough, monkeypatch):
    monkeypatch.setattr(sliding_regression, "ENOUGH", enough)  # 0: every update is refined
    scenario = paper().replace(
        {
            "run.duration": 0.7,
            "run.warm_up": 0.2,
            "gpr_online.training_size": 100,
            "gpr_online.depth": 40,
            "gpr_online.inputs": inputs,
            "gpr_online.inputs_filter": kind,
        }
    )
    record = simulate(scenario)
    expected = run_observer("gpr-online", record, scenario)["vibration"][:, 1]
    estimator = gpr_online(
        prior_of(scenario, record, GPR_ONLINE.parts(scenario.gpr_online)), scenario.gpr_online, record.sampling, 0.0
    )
    got = run_frames(estimator, (VIBRATION,), record.measurements(), QUIET)[VIBRATION][:, 1]
    assert np.array_equal(np.isnan(got), np.isnan(expected))
    # Both round; cond is about 1e4 here, so 100 eps cond is 2e-10 of the spread. Rows of M N - I that are wrong by ENOUGH
    # count with the square root of the 100 windows each, some of them with the same sign.
    assert np.nanmax(np.abs(got - expected)) < (1e-9 + 50 * enough) * np.nanstd(expected)


def test_learning_waits_for_the_next_frame_and_z_windows_need_no_command():
    settings = {"gpr_online.training_size": 20, "gpr_online.depth": 5, "gpr_online.inputs": "z"}
    scenario = paper().replace(settings)
    record = simulate(scenario.replace({"run.duration": 1.2}))
    prior = prior_of(scenario, record, GPR_ONLINE.parts(scenario.gpr_online))
    settled, left = (gpr_online(prior, scenario.gpr_online, record.sampling, 0.0) for _ in range(2))
    record_version = run_observer("gpr-online", record, scenario)[VIBRATION]
    for z, expected in zip(record.z[:200], record_version[:200], strict=True):
        for estimator in (settled, left):
            estimator.advance(z, None, None)
        settled.settle()
        np.testing.assert_equal(left.predict(0.0, VIBRATION), settled.predict(0.0, VIBRATION))
        # Both round: as above.
        np.testing.assert_allclose(left.predict(0.0, VIBRATION)[0], expected, rtol=0, atol=1e-9 * np.nanstd(record_version))
    assert np.isfinite(expected).all()


@pytest.mark.slow
@pytest.mark.parametrize(("amplitude", "n"), [(0.03, 20_000), (0.3, 12_000), (3.0, 12_000)])
def test_no_drift_over_many_steps(amplitude, n):
    """Error over the estimates' std at the end, within ten times that of one direct solve."""
    kernel, depth, m = SquaredExponential(30.0, 300.0, 0.1), 20, 24
    signals, targets = slow_and_noisy(n, amplitude), targets_of(n)
    got = stream(SlidingRegression(depth, m, 2, kernel), signals, targets)
    steps = [depth + m - 1, n // 2, *range(n - 40, n)]
    expected, condition = split_direct(signals, targets, depth, m, kernel, steps)
    assert np.abs(got[steps] - expected).max() < 10 * max(1e-10, 100 * EPS * condition) * np.nanstd(got)


def test_modes_side_by_side_are_those_alone_and_a_saved_state_goes_on_in_the_midst_of_waiting_columns():
    kernel, depth, m, n = SquaredExponential(30.0, 300.0, 0.1), 6, 21, 200
    signals = np.stack([slow_and_noisy(n, amplitude, seed) for seed, amplitude in enumerate((0.03, 3.0))], axis=1)
    targets = np.stack([targets_of(n, seed) for seed in (1, 2)], axis=1)
    both, later = (SlidingRegression(depth, m, 2, kernel, n_modes=2) for _ in range(2))
    got = np.full((n, 2), np.nan)
    for k, samples in enumerate(signals):
        if k == 123:
            later.load(both.save())
            both = later
        got[k] = both.predict(samples, targets[k - 1])
        both.update()
    for mode in range(2):
        alone = stream(SlidingRegression(depth, m, 2, kernel), signals[:, mode], targets[:, mode])
        # the same operations on each, but for the form of the covariance, which goes by the larger of the windows
        np.testing.assert_allclose(got[:, mode], alone, rtol=0, atol=1e-9 * np.nanstd(alone))


@pytest.mark.parametrize("length_scale", [0.1, 300.0, 1e5])
@pytest.mark.parametrize(("signal_std", "noise_std"), [(1e-3, 1e-4), (1e-3, 10.0), (1e4, 1e-4), (1e4, 10.0)])
@pytest.mark.parametrize(("m", "depth"), [(2, 1), (30, 17)])
def test_extremes_of_the_settings(length_scale, signal_std, noise_std, m, depth):
    """Record and stream: correct within 100 eps cond (the stream ten times that), or a clear error above 1e13."""
    kernel, n = SquaredExponential(signal_std, length_scale, noise_std), m + depth + 60
    signals, targets = slow_and_noisy(n, 0.5), targets_of(n)
    steps = list(range(depth + m - 1, n, 7))
    expected, condition = split_direct(signals, targets, depth, m, kernel, steps)
    bound = max(1e-10, 100 * EPS * condition) * max(expected.std(), 1e-290)
    for factor, run in (
        (1, lambda: predict_sliding(signals, targets, depth, m, kernel)[0]),
        (10, lambda: stream(SlidingRegression(depth, m, 2, kernel), signals, targets)),
    ):
        try:
            got = run()[steps]
        except ConditionError:
            got = None
        if got is None:
            assert condition > 1e12  # the limit is 1e13; a decade for the accuracy of estimating it
        else:
            assert np.abs(got - expected).max() <= factor * bound


def test_too_ill_conditioned_is_one_clear_error():
    kernel = SquaredExponential(1e4, 300.0, 1e-4)
    signals = np.ones((400, 2)) * 3.0  # equal windows: M has rank one
    with pytest.raises(ConditionError, match=r"condition .* above 1e\+13: raise noise_std"):
        predict_sliding(signals, targets_of(400), 50, 200, kernel)
