"""The offline GPR against a plain solve, and which target belongs to which window."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.signal import butter, lfilter, sosfilt

from wfsobs.evaluation.scores import lag
from wfsobs.execution import run_observer
from wfsobs.observers.gpr.offline import train, training_targets
from wfsobs.observers.gpr.windows import ConditionError, SquaredExponential
from wfsobs.priors_from.scenario import bands_of
from wfsobs.record import RecordError, Training
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate

EPS = np.finfo(float).eps


def record_like(n: int, channels: int, amplitude: float, seed: int) -> np.ndarray:
    """A slow process of some `amplitude` and white noise of 0.02, (n, channels)."""
    rng = np.random.default_rng(seed)
    slow = lfilter([0.2], [1.0, -0.98], rng.standard_normal((n, channels)), axis=0)
    return amplitude * slow + 0.02 * rng.standard_normal((n, channels))


def windows(x: np.ndarray, ends: np.ndarray, d: int) -> np.ndarray:
    """The windows ending at `ends`, one row each."""
    return np.array([x[j - d + 1 : j + 1].ravel() for j in ends])


def split_solve(X: np.ndarray, f: np.ndarray, tests: np.ndarray, kernel: SquaredExponential) -> tuple[np.ndarray, float]:
    """Textbook regression with K = M + s2 delta delta' kept apart; (mean, condition number of M + sigma_n^2 I)."""
    l2, s2 = kernel.length_scale**2, kernel.signal_std**2

    def split(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        g = p @ q.T / l2
        norms = np.add.outer(np.sum(p**2, axis=1), np.sum(q**2, axis=1)) / l2
        distance = norms - 2.0 * g
        if norms.max() > 1.0:  # differences of large numbers
            distance = np.array([np.sum((q - row) ** 2, axis=1) for row in p]) / l2
        return s2 * np.where(
            g > 0, -np.exp(-0.5 * distance) * np.expm1(-np.abs(g)), np.exp(-0.5 * norms) * np.expm1(np.minimum(g, 0.0))
        )

    T = split(X, X) + kernel.noise_std**2 * np.eye(len(X))
    delta, delta_t = (np.exp(-0.5 * np.sum(p**2, axis=1) / l2) for p in (X, tests))
    a, b = np.linalg.solve(T, f), np.linalg.solve(T, delta)
    kappa = split(tests, X)
    return kappa @ a + (delta_t - kappa @ b) * (delta @ a) / (1.0 / s2 + delta @ b), float(np.linalg.cond(T))


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    st.floats(-1.0, 2.5),
    st.floats(-1.0, 5.0),
    st.floats(-3.0, 0.5),
    st.integers(2, 150),
    st.sampled_from([1, 2]) | st.integers(1, 60),
    st.integers(1, 2),
    st.floats(-1.5, 0.5),
    st.integers(0, 600),
    st.integers(0, 2**31),
)
@example(1.0, 2.477, -0.886, 150, 60, 2, -0.5, 600, 0)
@example(1.0, 5.0, -0.886, 150, 60, 2, 0.5, 300, 1)
@example(1.0, -1.0, -0.886, 40, 30, 2, 0.5, 100, 2)
def test_training_and_prediction_are_those_of_a_plain_solve(
    log_s: float, log_l: float, log_noise: float, m: int, d: int, channels: int, log_amplitude: float, more: int, seed: int
) -> None:
    kernel = SquaredExponential(10**log_s, 10**log_l, 10**log_noise)
    known = record_like(d + m + 5, channels, 10**log_amplitude, seed)
    new = record_like(d + more, channels, 10**log_amplitude, seed + 1)
    f = 0.015 * np.sin(0.3 * np.arange(len(known)))
    f[: d - 1] = f[d + m - 1 :] = np.nan  # not a target of any of the m windows
    got = train(known, f, d, m, kernel).predict(new)
    assert got.shape == (len(new),) and np.isnan(got[: d - 1]).all()
    ends = np.arange(d - 1, len(new))
    first = np.arange(d - 1, d + m - 1)
    wanted, condition = split_solve(windows(known, first, d), f[first], windows(new, ends, d), kernel)
    bound = max(1e-10, 100 * EPS * condition)
    scale = wanted.std() if len(wanted) > 3 else np.abs(wanted).max()
    # and the rounding of an estimate that hardly varies, or is next to nothing beside its targets
    assert np.abs(got[ends] - wanted).max() <= bound * scale + 10 * EPS * (np.nanstd(f) + np.abs(wanted).max())


@pytest.mark.slow
def test_the_papers_size() -> None:
    kernel = SquaredExponential(10.0, 300.0, 0.13)
    known, new = record_like(1500, 2, 0.3, 0), record_like(2000, 2, 0.3, 1)
    f = 0.015 * np.sin(0.3 * np.arange(1500))
    got = train(known, f, 407, 1000, kernel).predict(new)
    first = np.arange(406, 1406)
    ends = np.array([406, 407, 661, 662, 663, 1000, 1999])
    wanted, condition = split_solve(windows(known, first, 407), f[first], windows(new, ends, 407), kernel)
    assert condition < 1e6
    assert np.abs(got[ends] - wanted).max() < 1e-10 * np.nanstd(got)


def test_long_records_lose_no_digits() -> None:
    """The last estimates of 30,000 steps are those of their own windows alone."""
    kernel = SquaredExponential(10.0, 300.0, 0.13)
    known, new = record_like(200, 2, 0.3, 0), record_like(30_000, 2, 3.0, 1)
    model = train(known, np.sin(np.arange(200.0)), 40, 100, kernel)
    tail = model.predict(new[-300:])[39:]
    assert np.abs(model.predict(new)[-len(tail) :] - tail).max() < 1e-10 * tail.std()


def test_errors_in_one_line() -> None:
    x = record_like(60, 1, 3.0, 0)
    with pytest.raises(RecordError, match=r"60 steps.*61"):
        train(x, x[:, 0], 30, 31, SquaredExponential(1.0, 1.0, 1.0))
    with pytest.raises(ConditionError, match="noise_std"):
        train(x, x[:, 0], 3, 50, SquaredExponential(1e4, 100.0, 1e-4))


# ---------------------------------------------------------------------- on a record


def scenario(changes: dict[str, Any] | None = None) -> Scenario:
    base = PRESETS["paper"]()
    base.update({"run": {"duration": 1.0, "warm_up": 0.4}, "gpr_offline": {"training_size": 80, "depth": 30}})
    return base.replace(changes or {})


def zero_phase(s: Scenario, x: np.ndarray) -> np.ndarray:
    """Each band forward and backward over x, summed."""
    b, out = s.butterworth, np.zeros_like(x)
    for f in b.frequencies:
        sos = butter(b.order, [f - b.bandwidth_offline / 2, f + b.bandwidth_offline / 2], "bandpass", fs=1000, output="sos")
        out += sosfilt(sos, sosfilt(sos, x)[::-1])[::-1]
    return out


@pytest.mark.parametrize("twin", [True, False])
@pytest.mark.parametrize("inputs", ["u-y", "z"])
def test_pairs_of_window_and_target_on_a_record(inputs: str, twin: bool) -> None:
    """The window of training step j holds u and y_lgs (or z) up to j, its target is the zero-phase filtered open-loop
    twin (or z) of step j + 1, which sees phi_dist[j]. Judged on the record's own windows."""
    s = scenario({"gpr_offline.inputs": inputs})
    record = simulate(s)
    t = record.training
    assert t is not None and t.open_loop_y is not None
    if not twin:
        record = replace(record, training=Training(t.y_lgs, t.u))
    got = run_observer("gpr-offline", record, s)["vibration"]
    g = s.gpr_offline
    m, d = g.training_size, g.depth
    kernel = SquaredExponential(g.signal_std, g.length_scale, g.noise_std)
    assert np.isnan(got[: d - 1]).all() and np.isfinite(got[d - 1 :]).all()
    for mode in range(2):

        def z_of(y: np.ndarray, u: np.ndarray, mode: int = mode) -> np.ndarray:
            return y[:, mode] - np.concatenate([[0.0, 0.0], u[:-2, mode]])

        def signals(y: np.ndarray, u: np.ndarray, mode: int = mode) -> np.ndarray:
            return z_of(y, u)[:, None] if inputs == "z" else np.column_stack([u[:, mode], y[:, mode]])

        filtered = zero_phase(s, t.open_loop_y[:, mode] if twin else z_of(t.y_lgs, t.u))
        first = np.arange(d - 1, d + m - 1)
        X = windows(signals(t.y_lgs, t.u), first, d)
        ends = np.array([d - 1, d, 300, 999])
        tests = windows(signals(record.y_lgs, record.u), ends, d)
        wanted, condition = split_solve(X, filtered[first + 1], tests, kernel)
        assert condition < 1e6
        assert np.abs(got[ends, mode] - wanted).max() < 1e-9 * np.nanstd(got[:, mode])


def test_targets_are_the_vibration_of_the_same_step() -> None:
    """One tone in the middle of the one band and nothing else: after the zero-phase filter has settled the target of
    step j is what the twin sees at j + 1, without lag."""
    s = scenario(
        {
            "turbulence.source": "none",
            "vibration.peaks": [{"frequency": 47.7, "damping": 0.0, "rms": [0.02, 0.02]}],
            "sensors.lgs_noise": 0.0,
            "sensors.lgs_low_frequency_rms": 0.0,
            "butterworth.frequencies": [47.7],
            "gpr_offline.training_size": 2000,
        }
    )
    t = simulate(s).training
    assert t is not None and t.open_loop_y is not None
    targets = training_targets(t, bands_of(s), 1e-3)
    assert np.isnan(targets[-1]).all() and np.isfinite(targets[:-1]).all()
    inside = slice(600, 1900)  # the band of 3 Hz has settled to exp(-5.6), its gain at 47.7 Hz is 1
    seen = t.open_loop_y[601:1901]
    assert np.abs(targets[inside] - seen).max() < 0.01 * seen.std() * np.sqrt(2)


def test_the_estimate_of_step_k_is_the_vibration_of_step_k() -> None:
    """The same tone in a closed loop with a little noise: no lag, small error, for u-y windows and z windows."""
    for inputs in ("u-y", "z"):
        s = scenario(
            {
                "turbulence.source": "none",
                "vibration.peaks": [{"frequency": 47.7, "damping": 0.0, "rms": [0.02, 0.02]}],
                "sensors.lgs_noise": 0.001,
                "sensors.lgs_low_frequency_rms": 0.0,
                "butterworth.frequencies": [47.7],
                "gpr_offline.training_size": 800,
                "gpr_offline.depth": 60,
                "gpr_offline.noise_std": 0.01,
                "gpr_offline.inputs": inputs,
                "run.warm_up": 0.9,
            }
        )
        record = simulate(s)
        values = run_observer("gpr-offline", record, s)["vibration"][200:]
        assert record.vibration is not None
        truth = record.vibration[200:]
        for mode in range(2):
            assert np.std(values[:, mode] - truth[:, mode]) < 0.1 * truth[:, mode].std()
            found = lag(truth[:, mode], values[:, mode], record.dt)
            assert found is not None and abs(found) < 2e-4


def test_training_must_be_long_enough() -> None:
    s = scenario()
    record = simulate(s)
    assert record.training is not None
    short = Training(*(x[:109] for x in (record.training.y_lgs, record.training.u, record.training.open_loop_y)))  # type: ignore[index]
    with pytest.raises(RecordError, match="110"):
        run_observer("gpr-offline", replace(record, training=short), s)
