"""The Kalman filters against the textbook filter of the paper's six states, step by step, and against theory."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.records import kalman_model
from wfsobs.execution import run_observer
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.filters import between_frames, steady_filter
from wfsobs.priors_from.scenario import arguments, measurement_noise, modelled_processes
from wfsobs.record import Estimates, Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.statespace import paper_matrices
from wfsobs.simulation.loop import simulate


def scenario(changes: dict[str, Any] | None = None, preset: str = "paper") -> Scenario:
    base = PRESETS[preset]()
    base.update({"run": {"duration": 1.2, "warm_up": 0.2}, "gpr_offline": {"training_size": 2, "depth": 1}})
    return base.replace(changes or {})


def run_ngs(record: Record, s: Scenario) -> Estimates:
    """Both processes of the filter on NGS frames; the observer states turbulence alone."""
    observer = replace(OBSERVERS["kf-ngs"], targets=TARGETS)
    return observer.estimate(*arguments(observer, record, s))


def textbook_gain(A: np.ndarray, C: np.ndarray, Q: np.ndarray, r: float, steps: int = 12_000) -> np.ndarray:
    """Filter gain L = P C' / (C P C' + r) from the Riccati recursion, iterated until it stands still."""
    P = Q.copy()
    for _ in range(steps):
        L = P @ C / (C @ P @ C + r)
        P = A @ (P - np.outer(L, C @ P)) @ A.T + Q
        P = 0.5 * (P + P.T)
    return P @ C / (C @ P @ C + r)


def textbook_lgs(record: Record, s: Scenario, mode: int, r: float) -> np.ndarray:
    """Paper, eq. 7 to 9 on y_lgs and u, in the form that uses y[k] for the estimate of step k; (n_steps, 2)."""
    turbulence, vibration = modelled_processes(s, mode, record.dt)
    A, B, C = paper_matrices(turbulence, vibration)
    Q = np.diag([turbulence.drive_variance, 0, vibration.drive_variance, 0, 0, 0])
    L = textbook_gain(A, C, Q, r)
    x = np.zeros(6)
    out = np.zeros((record.n_steps, 2))
    for k in range(record.n_steps):
        x = x + L * (record.y_lgs[k, mode] - C @ x)
        out[k] = x[0], x[2]
        x = A @ x + B * record.u[k, mode]
    return out


LGS_VARIANTS: list[dict[str, Any]] = [
    {},
    {"kalman.process_noise": "matched"},
    {"kalman.measurement_noise": "manual", "kalman.lgs_noise": 0.1},
    {"loop.closed": False, "kalman.frequency": 20.0, "kalman.damping": 0.01},
    {"sensors.lgs_count": 5, "sensors.lgs_noise": 0.01, "sensors.lgs_rate": 500.0},
]


@pytest.mark.slow
@pytest.mark.parametrize("changes", LGS_VARIANTS)
def test_lgs_filter_is_the_textbook_filter_of_six_states(changes: dict[str, Any]) -> None:
    s = scenario(changes)
    record = simulate(s)
    got = run_observer("kf-lgs", record, s)
    r = 0.1**2 if "kalman.lgs_noise" in changes else s.sensors.lgs_noise**2 / s.sensors.lgs_count
    for mode in range(2):
        wanted = textbook_lgs(record, s, mode, r)
        for i, target in enumerate(("turbulence", "vibration")):
            # the iterated gain still moves by exp(-2 * 12000 * decay per step) and rounding, 1e-10 of it
            assert np.abs(got[target][:, mode] - wanted[:, i]).max() < 1e-8 * wanted[:, i].std()


def textbook_ngs(record: Record, s: Scenario, mode: int, r: float) -> np.ndarray:
    """The same filter without the mirror's states at T_NGS, on frames with the mirror's mean motion during them, u[k-2]
    ... u[k-n-1], taken off; the four states after each frame, (frames, 4)."""
    n = record.ratio
    assert n is not None and record.y_ngs is not None
    turbulence, vibration = modelled_processes(s, mode, n * record.dt)
    A, _, C = (m[..., :4] for m in paper_matrices(turbulence, vibration))
    A = A[:4]
    L = textbook_gain(A, C, np.diag([turbulence.drive_variance, 0, vibration.drive_variance, 0]), r, 3_000)
    x, out = np.zeros(4), []
    for k in range(n, record.n_steps, n):
        mirror = np.mean([record.u[j, mode] if j >= 0 else 0.0 for j in range(k - n - 1, k - 1)])
        x = x + L * (record.y_ngs[k, mode] - mirror - C @ x)
        out.append(x)
        x = A @ x
    return np.array(out)


NGS_VARIANTS: list[dict[str, Any]] = [
    {"sensors.exposure_ratio": 5},
    {"sensors.exposure_ratio": 1},
    {"sensors.exposure_ratio": 7, "run.duration": 1.203},
    {"kalman.process_noise": "matched", "kalman.measurement_noise": "manual", "kalman.ngs_noise": 0.05},
]


@pytest.mark.parametrize("changes", NGS_VARIANTS)
def test_ngs_filter_is_the_textbook_filter_held_between_frames(changes: dict[str, Any]) -> None:
    s = scenario(changes)
    record = simulate(s)
    n = s.sensors.exposure_ratio
    got = run_ngs(record, s)
    r = (0.05 if "kalman.ngs_noise" in changes else s.sensors.ngs_noise) ** 2
    for mode in range(2):
        states = textbook_ngs(record, s, mode, r)
        for i, target in enumerate(("turbulence", "vibration")):
            value = got[target][:, mode]
            assert np.isnan(value[:n]).all()
            for k in range(n, record.n_steps):
                assert abs(value[k] - states[k // n - 1, 2 * i]) < 1e-8 * states[:, 2 * i].std()


def closed_form_autocovariance(p: Ar2, lags: np.ndarray) -> np.ndarray:
    """rms^2 exp(-d j) (cos(a j) + tanh(d) cot(a) sin(a j)), d = xi w T, a = w sqrt(1 - xi^2) T."""
    d, a = p.damping * p.omega * p.dt, p.omega * np.sqrt(1 - p.damping**2) * p.dt
    return p.rms**2 * np.exp(-d * lags) * (np.cos(a * lags) + np.tanh(d) / np.tan(a) * np.sin(a * lags))


def expected_given_means(p: Ar2, n: int) -> np.ndarray:
    """Weights (n, 2) of the conditional mean of each fast step of a slow step given its mean and the one before."""
    lags = np.abs(np.subtract.outer(np.arange(2 * n), np.arange(2 * n)))
    covariance = closed_form_autocovariance(p, lags)
    now, before = np.repeat([0.0, 1.0], n) / n, np.repeat([1.0, 0.0], n) / n
    means = np.array([now, before])
    return np.linalg.solve(means @ covariance @ means.T, means @ covariance[:, n:]).T


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.floats(0.02, 0.5), st.floats(0.01, 0.99), st.integers(2, 12), st.floats(-3, 2))
def test_weights_between_frames(angle: float, damping: float, n: int, log_rms: float) -> None:
    p = Ar2(angle / 1e-3, damping, 10**log_rms, 1e-3)
    weights = between_frames(p, n, "propagate")
    # two neighbouring means of a slow process are nearly equal: condition number of their covariance times eps
    tolerance = 1e-13 / (n * angle) ** 2 / min(1.0, damping)
    assert np.abs(weights - expected_given_means(p, n)).max() < 1e-10 + tolerance
    # the mean over the slow step is what was given
    assert np.abs(weights.mean(axis=0) - [1.0, 0.0]).max() < 1e-10 + tolerance
    assert np.array_equal(between_frames(p, n, "hold"), np.column_stack([np.ones(n), np.zeros(n)]))


@pytest.mark.parametrize("ratio", [1, 5, 9])
def test_propagated_estimates_use_both_slow_states(ratio: int) -> None:
    """The previous slow mean as the newest frame shows it, not as it was estimated before that frame."""
    s = scenario({"kalman.ngs_between_frames": "propagate", "sensors.exposure_ratio": ratio, "run.duration": 1.003})
    record = simulate(s)
    got = run_ngs(record, s)
    for mode in range(2):
        states = textbook_ngs(record, s, mode, s.sensors.ngs_noise**2)
        for i, (target, process) in enumerate(zip(got, modelled_processes(s, mode, record.dt), strict=True)):
            weights = expected_given_means(process, ratio)
            value = got[target][:, mode]
            assert np.isnan(value[:ratio]).all()
            for k in range(ratio, record.n_steps):
                wanted = weights[k % ratio] @ states[k // ratio - 1, 2 * i : 2 * i + 2]
                assert abs(value[k] - wanted) < 1e-7 * states[:, 2 * i].std()


def test_propagating_beats_holding_where_the_model_is_true() -> None:
    """Fast turbulence, no vibration: averaged over seeds the error falls, in every seed."""
    errors = {"hold": [], "propagate": []}
    for seed in range(4):
        for how, found in errors.items():
            s = scenario(
                {
                    "kalman.ngs_between_frames": how,
                    "vibration.source": "none",
                    "turbulence.wind_speed": 40.0,
                    "kalman.process_noise": "matched",
                    "run.duration": 6.0,
                    "run.seed": seed,
                }
            )
            record = simulate(s)
            assert record.turbulence is not None
            found.append(np.nanstd(run_observer("kf-ngs", record, s)["turbulence"] - record.turbulence))
    assert (np.array(errors["propagate"]) < 0.98 * np.array(errors["hold"])).all()


# ---------------------------------------------------------------------- theory


@pytest.mark.slow
def test_error_of_the_matched_filter_is_what_the_riccati_equation_says() -> None:
    """Where the truth is the model, AR(2) turbulence and one AR(2) peak in white noise, the error is `posterior`."""
    s = Scenario()
    s.update(
        {
            "vibration": {"source": "ar2", "peaks": [{"rms": [0.015, 0.03]}]},
            "sensors": {"lgs_low_frequency_rms": 0.0},
            "run": {"duration": 60.0},
            "gpr_offline": {"training_size": 2, "depth": 1},
        }
    )
    ratios = []
    for seed in range(16):
        record = simulate(s.replace({"run.seed": seed}))
        values = run_observer("kf-lgs", record, s)
        one = []
        for mode in range(2):
            model = kalman_model(s, mode, record.dt)
            _, steady = steady_filter(model, measurement_noise(s, mode)[0])
            for target in ("turbulence", "vibration"):
                truth = record.truth(target)
                assert truth is not None
                error = (values[target] - truth)[1000:, mode]
                one.append(np.mean(error**2) / (model.outputs[target] @ steady.posterior @ model.outputs[target]))
        ratios.append(one)
    mean, standard_error = np.mean(ratios, axis=0), np.std(ratios, axis=0, ddof=1) / np.sqrt(len(ratios))
    assert (standard_error < 0.005).all(), standard_error  # else the next line would say nothing
    assert (np.abs(mean - 1.0) < 0.02).all(), (mean, standard_error)


def test_innovations_of_the_matched_filter_are_white() -> None:
    s = Scenario()
    s.update(
        {
            "vibration": {"source": "ar2", "peaks": [{}]},
            "sensors": {"lgs_low_frequency_rms": 0.0},
            "run": {"duration": 30.0},
            "gpr_offline": {"training_size": 2, "depth": 1},
        }
    )
    record = simulate(s)
    model, noise = kalman_model(s, 0, record.dt), measurement_noise(s, 0)[0]
    kalman, steady = steady_filter(model, noise, np.eye(4))
    filtered = kalman.run(record.z[:, [0]])
    innovation = (record.z[1:, 0] - filtered[:-1] @ model.A.T @ model.C)[1000:]
    n = innovation.size
    expected = model.C @ steady.P @ model.C + noise**2
    # variance known to sqrt(2 / n), each of 30 correlations to 1 / sqrt(n); 4.5 of each
    assert abs(np.mean(innovation**2) / expected - 1) < 4.5 * np.sqrt(2 / n)
    for lag in range(1, 31):
        assert abs(np.mean(innovation[lag:] * innovation[:-lag]) / expected) < 4.5 / np.sqrt(n)


# ---------------------------------------------------------------------- what goes into the model


def test_model_floors() -> None:
    """A line of damping 0 and a sensor without noise still have a filter: 1e-4 and 1e-6 um."""
    s = scenario({"kalman.damping": 0.0, "sensors.lgs_noise": 0.0, "sensors.ngs_noise": 0.0})
    assert modelled_processes(s, 0, 1e-3)[1].damping == 1e-4
    assert measurement_noise(s, 0) == (1e-6, 1e-6)
    record = simulate(s)
    assert all(np.isfinite(v).all() for v in run_observer("kf-lgs", record, s).values())
    assert all(np.isfinite(v[5:]).all() for v in run_observer("kf-ngs", record, s).values())


def test_matched_and_manual() -> None:
    s = scenario({"kalman.process_noise": "matched", "turbulence.rms": 0.3, "vibration.source": "ar2"})
    assert modelled_processes(s, 0, 1e-3)[0].rms == 0.3
    peaks = np.sqrt(sum(p.rms[1] ** 2 for p in s.vibration.peaks))
    assert modelled_processes(s, 1, 1e-3)[1].rms == pytest.approx(peaks, rel=1e-12)
    manual = s.replace({"kalman.process_noise": "manual", "kalman.turbulence_rms": 0.7, "kalman.vibration_rms": 0.2})
    assert [p.rms for p in modelled_processes(manual, 1, 1e-3)] == [0.7, 0.2]
    silent = s.replace({"turbulence.source": "none", "vibration.source": "none"})
    assert [p.rms for p in modelled_processes(silent, 1, 1e-3)] == [0.0, 0.0]
    record = simulate(silent)
    assert not any(v.any() for v in run_observer("kf-lgs", record, silent).values())


@pytest.mark.parametrize("preset", PRESETS)
def test_model_frequency_is_in_hertz(preset: str) -> None:
    """The paper writes 47.4969 Hz into w_f; the filter needs 2 pi times that."""
    s = scenario(preset=preset)
    vibration = modelled_processes(s, 0, 1e-3)[1]
    assert vibration.omega == pytest.approx(2 * np.pi * s.kalman.frequency, rel=1e-12)


@pytest.mark.parametrize("n_steps", [1, 2, 4, 5, 6, 10, 11])
def test_records_shorter_than_a_frame(n_steps: int) -> None:
    s = scenario()
    record = simulate(s)
    assert record.y_ngs is not None
    short = Record(record.y_lgs[:n_steps], record.u[:n_steps], record.dt, record.y_ngs[:n_steps], record.ratio)
    for name, first in (("kf-lgs", 0), ("kf-ngs", 5)):
        whole = run_observer(name, record, s)
        for target, value in run_observer(name, short, s).items():
            assert value.shape == (n_steps, 2)
            assert np.isnan(value[:first]).all() and np.isfinite(value[first:]).all()
            assert np.allclose(value, whole[target][:n_steps], rtol=1e-9, atol=1e-13, equal_nan=True)
