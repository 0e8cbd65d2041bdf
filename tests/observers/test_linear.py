"""The linear predictors, the multi-peak filter and its third-order turbulence, against plain versions and theory."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_lyapunov

from wfsobs.evaluation.bound import bound_rms
from wfsobs.execution import run_observer
from wfsobs.observers.gpr.ridge import TAPS, fit, predict
from wfsobs.observers.kalman.filters import steady_filter
from wfsobs.priors_from.scenario import lines_of, measurement_noise, modelled_processes, modelled_turbulence
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.autoregressive import Ar2, Ar3, Ar3Fits
from wfsobs.signal.gains import steady_state
from wfsobs.signal.statespace import disturbance_model, third_order_model
from wfsobs.simulation.disturbance import turbulence_process, vibration_lines
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.sensor_noise import noise_covariance


def small(changes: dict | None = None) -> Scenario:
    return PRESETS["paper"]().replace(
        {"run.duration": 1.5, "run.warm_up": 0.4, "gpr_offline.training_size": 120, "gpr_offline.depth": 30, **(changes or {})}
    )


@settings(max_examples=25)
@given(depth=st.integers(1, 12), channels=st.integers(1, 2), m=st.integers(3, 40), penalty=st.floats(1e-4, 1e3))
def test_ridge_is_the_penalised_least_squares_fit(depth: int, channels: int, m: int, penalty: float) -> None:
    rng = np.random.default_rng(depth + 100 * m)
    signals, targets = rng.standard_normal((depth + m, channels)), rng.standard_normal(depth + m)
    weights, constant = fit(signals, targets, depth, m, penalty)
    # Oracle: one least-squares problem with the penalty as rows of its own and a column of ones that bears none.
    X = np.array([signals[j - depth + 1 : j + 1].ravel() for j in range(depth - 1, depth - 1 + m)])
    A = np.vstack([np.column_stack([X, np.ones(m)]), np.sqrt(penalty) * np.eye(X.shape[1], X.shape[1] + 1)])
    b = np.concatenate([targets[depth - 1 : depth - 1 + m], np.zeros(X.shape[1])])
    expected = np.linalg.lstsq(A, b, rcond=None)[0]
    assert weights[::-1].ravel() == pytest.approx(expected[:-1], abs=1e-9 * max(1.0, 1.0 / penalty))
    assert constant == pytest.approx(expected[-1], abs=1e-9 * max(1.0, 1.0 / penalty))
    windows = np.array([signals[j - depth + 1 : j + 1].ravel() for j in range(depth - 1, depth + m)])
    assert predict(signals, weights, constant)[depth - 1 :] == pytest.approx(windows @ weights[::-1].ravel() + constant)


def test_ridge_is_what_the_gpr_becomes_for_a_long_length_scale() -> None:
    s = small()
    record = simulate(s)
    gpr, ridge = (run_observer(name, record, s)["vibration"] for name in ("gpr-offline", "ridge"))
    far = s.replace({"gpr_offline.length_scale": 30_000.0, "gpr_offline.noise_std": s.gpr_offline.noise_std / 100})
    limit = run_observer("gpr-offline", record, far)["vibration"]
    scale = np.nanstd(ridge)
    # Same penalty, windows of norm |x| < 10: the kernel is linear up to |x|^2 / 2 l^2, 6e-4 at l = 300 and 6e-8 at 30000; the
    # GPR's free constant has the prior sigma_SE^2, 1e6 times the variance of the targets.
    assert np.nanmax(np.abs(limit - ridge)) < 1e-4 * scale
    assert 1e-8 * scale < np.nanmax(np.abs(gpr - ridge)) < 2e-2 * scale


def test_too_short_a_training_record_is_said() -> None:
    with pytest.raises(RecordError, match="depth \\+ training size need 30"):
        fit(np.zeros((20, 1)), np.zeros(20), 10, 20, 1.0)


def test_thirty_taps_are_thirty() -> None:
    record = simulate(small())
    values = run_observer("ridge-30", record, small())["vibration"]
    assert np.isnan(values[: TAPS - 1]).all() and np.isfinite(values[TAPS - 1 :]).all()


def test_persistence_is_the_newest_measurement() -> None:
    record = simulate(small())
    assert np.array_equal(run_observer("persistence", record, small())["turbulence"], record.z)


@settings(max_examples=50)
@given(omega=st.floats(3.0, 60.0), damping=st.floats(0.1, 0.99), corner=st.floats(3.0, 500.0), rms=st.floats(1e-3, 10.0))
def test_the_third_order_model_has_the_process_own_statistics(omega: float, damping: float, corner: float, rms: float) -> None:
    process = Ar3(omega, damping, corner, rms, 1e-3)
    model = third_order_model(process)
    assert model.A @ model.A.T + model.Q == pytest.approx(np.eye(3), abs=1e-12)
    # The autocovariance from the spectrum, over 65 s: poles of 0.05 rad/s are not among those drawn.
    n = 2**16
    spectrum = process.psd(np.fft.rfftfreq(n, 1e-3)) / 2e-3
    covariance = np.fft.irfft(spectrum, n)[:4]
    state, powers = model.now, []
    for _ in range(4):
        powers.append(model.now @ state)  # E phi[k + j] phi[k] = now A^j now'
        state = model.A @ state
    # What is older than 65 s comes again: exp(-0.3 * 65) at most, of the decay of 0.3 per second.
    assert powers == pytest.approx(covariance, rel=1e-8, abs=1e-8 * rms**2)
    assert model.before @ model.now == pytest.approx(powers[1], rel=1e-9)


@settings(max_examples=100)
@given(
    omega=st.floats(-7.0, 0.4).map(lambda x: 10.0**x),
    damping=st.floats(1e-4, 0.9999),
    corner=st.floats(-7.0, 0.7).map(lambda x: 10.0**x),
)
def test_a_slow_third_order_process_keeps_its_digits(omega: float, damping: float, corner: float) -> None:
    """Against the step-down recursion of its polynomial with 60 digits; 0.1 m/s on 39 m at 100 kHz has 1e-7 rad per step."""
    with mp.workdps(60):
        pair = mp.mpf(omega) * mp.mpc(damping, mp.sqrt(1 - mp.mpf(damping) ** 2))
        p, q, r = mp.exp(-pair), mp.exp(-mp.conj(pair)), mp.exp(-mp.mpf(corner))
        a = [mp.re(p + q + r), -mp.re(p * q + r * (p + q)), mp.re(p * q * r)]
        reflections: list[mp.mpf] = []
        while a:
            *rest, k = a
            reflections.insert(0, k)
            a = [(one + k * other) / (1 - k**2) for one, other in zip(rest, reversed(rest), strict=True)]
        spreads = [mp.sqrt(1 - k**2) for k in reflections]
        exact = [float(x) for x in (*reflections, *spreads, mp.fprod(spreads) ** 2)]
    process = Ar3(omega, damping, corner, 1.0, 1.0)
    k, s = process.lattice
    assert k == pytest.approx(exact[:3], abs=2e-15)
    assert [*s, process.unit_drive_variance] == pytest.approx(exact[3:], rel=1e-14)


@pytest.mark.parametrize("changes", [{"turbulence.wind_speed": 1.0}, {"telescope.diameter": 39.0, "turbulence.wind_speed": 8.0}])
def test_an_ar2_that_is_slow_is_told_in_third_order_too(changes: dict) -> None:
    third = {"multipeak.turbulence_order": 3, "kalman.process_noise": "matched", "sensors.lgs_low_frequency_rms": 0.0}
    s = small(third | changes)
    true, told = turbulence_process(s, 0, s.dt), modelled_turbulence(s, 0, s.dt)
    assert [told.omega, told.damping, told.rms] == pytest.approx([true.omega, true.damping, true.rms], rel=2e-3)


def test_a_model_may_mix_orders() -> None:
    model = disturbance_model([Ar3(7.0, 0.9, 40.0, 0.5, 1e-3)], [Ar2(300.0, 0.01, 0.02, 1e-3)])
    X = solve_discrete_lyapunov(model.A, model.Q)
    for target, rms in (("turbulence", 0.5), ("vibration", 0.02)):
        row = model.outputs[target]
        assert np.sqrt(row @ X @ row) == pytest.approx(rms, rel=1e-6)
    assert model.pairs.shape == (4, 5)


@pytest.mark.parametrize("truth", [Ar3(7.0, 0.9, 40.0, 0.5, 1e-3), Ar3(15.0, 0.7, 90.0, 0.2, 1e-3)])
def test_the_fit_finds_a_process_as_good_as_the_truth(truth: Ar3) -> None:
    frequency = np.fft.rfftfreq(2**16, 1e-3)
    S = truth.psd(frequency) / 2e-3
    found = Ar3Fits().fit("", S, 4e-4, Ar3(10.0, 0.8, 60.0, 0.3, 1e-3))
    # What the innovations of a filter on the fitted model have more than white ones, after Whittle; zero is the truth's own.
    ratio = (S + 4e-4) / (found.psd(frequency) / 2e-3 + 4e-4)
    excess = ratio - np.log(ratio) - 1.0
    assert 0.0 <= np.mean(excess) < 1e-4  # of the variance of the innovations


def lines(scenario: Scenario, count: int) -> Scenario:
    peaks = [{"frequency": 17.0 + 11.0 * i, "damping": 0.02, "rms": [0.02, 0.01]} for i in range(count)]
    return scenario.replace(
        {
            "vibration.source": "ar2",
            "vibration.peaks": peaks,
            "sensors.lgs_low_frequency_rms": 0.0,
            "kalman.process_noise": "matched",
        }
    )


def test_where_the_truth_is_its_model_the_filter_reaches_the_bound() -> None:
    s = lines(small({"run.duration": 4.0}), 4)
    model = lines_of(s, 0).disturbance(s.multipeak.line_width)
    assert model.A.shape == (10, 10)
    row = np.sum(list(model.outputs.values()), axis=0)
    predicted = np.sqrt(row @ steady_filter(model, measurement_noise(s, 0)[0])[1].P @ row)
    assert predicted == pytest.approx(bound_rms(s, 0, ahead=1)["total"], rel=1e-4)
    errors = []
    for seed in range(12):
        record = simulate(s.replace({"run.seed": seed}))
        values = run_observer("kf-multi", record, s)["vibration"]
        errors.append(np.mean((values - record.vibration)[500:, 0] ** 2))
    # 12 records of 3.5 s: some 700 independent samples of an error with a correlation time of 30 ms, 3 % of the rms at one sigma.
    assert np.sqrt(np.mean(errors)) == pytest.approx(bound_rms(s, 0)["vibration"], rel=0.08)


def test_more_peaks_in_the_model_than_the_papers_one_help() -> None:
    s = lines(small(), 4)
    record = simulate(s)
    errors = [np.std((run_observer(name, record, s)["vibration"] - record.vibration)[400:, 0]) for name in ("kf-multi", "kf-lgs")]
    assert errors[0] < 0.8 * errors[1]


@pytest.mark.slow
def test_every_mode_is_filtered_for_its_own_noise() -> None:
    """Oracle: the textbook filter of each mode, noise from the sensor's own covariance."""
    s = lines(
        small(
            {
                "turbulence.source": "frozen-flow",
                "telescope.radial_order": 2,
                "sensors.kind": "shack-hartmann",
                "sensors.noise_from": "photons",
                "multipeak.turbulence_order": 2,
            }
        ),
        3,
    )
    noise = np.sqrt(np.diagonal(noise_covariance(s, "lgs")) / s.sensors.lgs_count)
    assert noise.max() > 1.2 * noise.min()  # else the test would say nothing
    record = simulate(s)
    values = run_observer("kf-multi", record, s)["vibration"]
    for mode in range(5):
        turbulence, _ = modelled_processes(s, mode, s.dt)
        peaks = [Ar2(2.0 * np.pi * f, damping, rms, s.dt) for f, damping, rms in vibration_lines(s, mode)]
        model = disturbance_model([turbulence], peaks)
        L = steady_state(model.A, model.C, model.Q, np.array(noise[mode] ** 2)).L[:, 0]
        x, wanted = np.zeros(len(model.A)), []
        for z in record.z[:, mode]:
            x = x + L * (z - model.C @ x)
            wanted.append(model.outputs["vibration"] @ x)
            x = model.A @ x
        # The gains are equal to the Riccati solver's 1e-10; ten times that for 1500 steps of a recursion
        np.testing.assert_allclose(values[:, mode], wanted, atol=1e-9 * np.std(wanted))


def test_the_third_order_is_an_option() -> None:
    s = small({"turbulence.source": "ar2"})
    assert isinstance(modelled_turbulence(s, 0, s.dt), Ar2)
    third = modelled_turbulence(s.replace({"multipeak.turbulence_order": 3}), 0, s.dt)
    # The LGS see the turbulence and a tenth of its variance more, of the same shape.
    assert isinstance(third, Ar3) and third.rms == pytest.approx(0.5, rel=0.05)


def test_a_table_of_a_spectrum_is_a_continuum() -> None:
    """Told 1e-6 um^2/Hz from 1 to 50 Hz: no lines, and processes of that variance, to a tenth."""
    s = small(
        {
            "vibration.source": "psd",
            "vibration.psd.frequency": [1.0, 50.0],
            "vibration.psd.tip": [1e-6, 1e-6],
            "vibration.psd.tilt": [1e-6, 1e-6],
        }
    )
    told = lines_of(s, 0)
    assert told.lines == () and sum(p.rms**2 for p in told.continuum) == pytest.approx(49e-6, rel=0.1)
    assert len(told.disturbance(s.multipeak.line_width).A) == 2 * (len(told.turbulence) + len(told.continuum))
