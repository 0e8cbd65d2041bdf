"""The Wiener bound against closed forms, Riccati covariances and long FIR filters."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_toeplitz

from tests.records import kalman_model
from wfsobs.evaluation.bound import bound_rms, least_errors
from wfsobs.observers.base import TARGETS
from wfsobs.priors_from.scenario import measurement_noise
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.autoregressive import Ar2, turbulence_corner
from wfsobs.signal.gains import steady_state
from wfsobs.signal.wiener import advance_spectrum, circle_mean, error_spectrum, explained_variance, factorise
from wfsobs.simulation.disturbance import vibration_variance
from wfsobs.simulation.true_spectra import TrueSpectra, line_width, n_frequencies, true_spectra, turbulence_spectra
from wfsobs.typing import Array

# The loop of one 530 nm turbulence, one 50 nm line at 47.5 Hz, 20 nm of noise.
MATCHED = Scenario().replace(
    {
        "turbulence.rms": 0.53,
        "vibration.source": "ar2",
        "kalman.frequency": 47.5,
        "vibration.peaks": [{"frequency": 47.5, "damping": 0.03, "rms": [0.05, 0.05]}],
        "sensors.lgs_count": 1,
        "sensors.lgs_noise": 0.02,
        "sensors.lgs_low_frequency_rms": 0.0,
    }
)


def riccati_errors(scenario: Scenario) -> tuple[dict[str, float], dict[str, float]]:
    """Target -> rms error of phi[k] and of phi[k + 1] given z[k], from the Riccati covariance of the true model."""
    model = kalman_model(scenario, 0, scenario.dt)
    steady = steady_state(model.A, model.C, model.Q, np.array(measurement_noise(scenario, 0)[0] ** 2))
    rows = model.outputs | {"total": sum(model.outputs.values())}
    filtered = {name: float(np.sqrt(row @ steady.posterior @ row)) for name, row in rows.items()}
    return filtered, {name: float(np.sqrt(row @ steady.P @ row)) for name, row in rows.items()}


def test_an_ar1_signal_in_white_noise_has_the_textbook_error() -> None:
    # s[k] = a s[k-1] + v: predicted variance P solves P = a^2 P R / (P + R) + q.
    a, q, R, n = 0.9, 0.5, 2.0, 4096
    w = 2 * np.pi * np.arange(n // 2 + 1) / n
    spectrum = q / np.abs(1 - a * np.exp(-1j * w)) ** 2
    b = q + (a**2 - 1) * R
    P = 0.5 * (b + np.sqrt(b**2 + 4 * q * R))
    whitener = factorise(spectrum + R)
    assert whitener.innovation_variance == pytest.approx(P + R, rel=1e-12)  # 0.9^4096 is nothing: rounding alone
    for steps, expected in ((1, P), (0, P * R / (P + R))):
        error = error_spectrum(spectrum, advance_spectrum(spectrum, steps), whitener)
        assert circle_mean(error) == pytest.approx(expected, rel=1e-12)


@given(seed=st.integers(0, 2**32 - 1))
def test_the_factor_is_causal_and_gives_the_spectrum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 512
    zeros = 0.8 * rng.random(3) * np.exp(2j * np.pi * rng.random(3))
    taps = np.real(np.poly(np.concatenate([zeros, zeros.conj()])))
    spectrum = np.abs(np.fft.rfft(taps, n)) ** 2 * (1.0 + rng.random())
    whitener = factorise(spectrum)
    assert np.abs(whitener.factor) ** 2 * whitener.innovation_variance == pytest.approx(spectrum, rel=1e-10)
    # Zeros within 0.8 of the circle's radius: the minimum-phase factor is the polynomial itself, 0.8^(n/2) off by wrapping.
    assert np.fft.irfft(whitener.factor, n)[: taps.size] == pytest.approx(taps, abs=1e-10)


def test_a_spectrum_without_noise_is_refused() -> None:
    with pytest.raises(ValueError, match="above 0"):
        factorise(np.array([1.0, 0.0, 1.0]))


def test_the_bound_of_the_two_frame_loop() -> None:
    # 21.63 nm by theory for the residual, phi[k + 1] given z[k]; two decimals are given.
    assert bound_rms(MATCHED, 0, ahead=1)["total"] == pytest.approx(21.63e-3, abs=0.005e-3)
    assert bound_rms(MATCHED, 0, ahead=1) == pytest.approx(riccati_errors(MATCHED)[1], rel=1e-7)


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@example(wind=11.75, rms=2.0, frequency=5.0, damping=0.5, vibration=0.125, noise=0.0023, duration=1.0)
@given(
    wind=st.floats(2.0, 60.0),
    rms=st.floats(0.05, 2.0),
    frequency=st.floats(5.0, 80.0),
    damping=st.floats(0.005, 0.5),
    vibration=st.floats(0.002, 0.2),
    noise=st.floats(0.002, 0.2),
    duration=st.floats(1.0, 3.0),
)
def test_where_the_truth_is_ar2_it_is_the_riccati_covariance(
    wind: float, rms: float, frequency: float, damping: float, vibration: float, noise: float, duration: float
) -> None:
    scenario = MATCHED.replace(
        {
            "turbulence.wind_speed": wind,
            "turbulence.rms": rms,
            "vibration.peaks.0.frequency": frequency,
            "kalman.frequency": frequency,
            "vibration.peaks.0.rms": [vibration],
            "sensors.lgs_noise": noise,
            "run.duration": duration,
        }
    )
    floor = 4 * line_width(scenario) / (2 * frequency)  # a bound takes no line for narrower than a quarter of this
    scenario = scenario.replace({"vibration.peaks.0.damping": max(damping, floor), "kalman.damping": max(damping, floor)})
    filtered, predicted = riccati_errors(scenario)
    # At half the DFT the narrowest line has exp(-12.5) of its correlation, which comes round.
    assert bound_rms(scenario, 0) == pytest.approx(filtered, rel=1e-3)
    assert bound_rms(scenario, 0, ahead=1) == pytest.approx(predicted, rel=1e-3)


def autocovariance(spectrum: Array) -> Array:
    return np.fft.irfft(spectrum, 2 * (spectrum.size - 1))


def fir_error(spectra: TrueSpectra, taps: int, ahead: int) -> float:
    """rms error of the best FIR filter of z[k] ... z[k - taps + 1] for phi[k + ahead], from the normal equations."""
    signal, shared = spectra.total
    r, c, s = autocovariance(spectra.measurement), autocovariance(shared), autocovariance(signal)
    wanted = c[1 + ahead : 1 + ahead + taps]
    return float(np.sqrt(s[0] - wanted @ solve_toeplitz(r[:taps], wanted)))


def test_measurements_are_counted_until_they_are_enough() -> None:
    spectra = true_spectra(MATCHED, 0)
    r, c = autocovariance(spectra.measurement)[:1000], autocovariance(spectra.total[1])[None, 1:1001]
    every = explained_variance(r, c)
    few = explained_variance(r, c, enough=0.999 * every[:, -1])
    assert few.shape[1] < 500 and (few == every[:, : few.shape[1]]).all()
    assert 0.999 < few[0, -1] / every[0, -1] < 1.0


def test_modes_that_forget_soon_have_a_short_dft_and_the_same_bound() -> None:
    scenario = PRESETS["higher-orders"]()
    lengths = [n_frequencies(scenario, mode) for mode in range(len(scenario.modes))]
    # Lines of tip and tilt are narrow; these others are zero along y, across the wind, and their spectrum is so at 0 Hz.
    slow = [mode.radial_order == 1 or mode.noll in (5, 8, 10, 13, 15) for mode in scenario.modes]
    assert [n == max(lengths) for n in lengths] == slow
    for mode in (2, 4):
        long = true_spectra(scenario, mode, turbulence_spectra(scenario, mode, max(lengths)))
        assert bound_rms(scenario, mode)["total"] == pytest.approx(least_errors(long)["total"].rms, rel=1e-4)


def test_thirty_taps_of_the_two_frame_loop() -> None:
    assert fir_error(true_spectra(MATCHED, 0), 30, 1) == pytest.approx(21.92e-3, abs=0.005e-3)


@pytest.mark.parametrize(("name", "mode"), [("paper", 0), ("paper", 1), ("ut4", 0)])
def test_where_it_is_not_ar2_long_fir_filters_come_near_from_above(name: str, mode: int) -> None:
    scenario = PRESETS[name]().replace({"turbulence.source": "ar2", "run.duration": 2.0})
    spectra, least = true_spectra(scenario, mode), bound_rms(scenario, mode, ahead=1)["total"]
    errors = [fir_error(spectra, taps, 1) for taps in (30, 300, 3000)]
    assert errors[0] > errors[1] > errors[2] > least * (1 - 1e-6)
    assert errors[2] == pytest.approx(least, rel=0.02)  # 3 s of taps, lines 1/32 Hz wide: their memory is 10 s


@pytest.mark.parametrize("name", ["paper", "ut4"])
def test_the_spectra_have_the_variances_of_the_scenario(name: str) -> None:
    scenario = PRESETS[name]().replace({"turbulence.source": "ar2"})
    for mode in range(2):
        spectra = true_spectra(scenario, mode)
        assert spectra.measurement.size == n_frequencies(scenario) // 2 + 1
        # The record's own bins and the finer ones here cut a spectrum at the cut-off a little differently.
        assert circle_mean(spectra.signal["vibration"]) == pytest.approx(vibration_variance(scenario, mode), rel=1e-3)
        assert circle_mean(spectra.signal["turbulence"]) == pytest.approx(scenario.turbulence.rms**2, rel=1e-6)
    assert line_width(scenario) == pytest.approx(1 / 160)


def test_what_the_lgs_cannot_see_cannot_be_estimated() -> None:
    blind = PRESETS["paper"]().replace({"turbulence.source": "ar2", "sensors.tip_tilt_indetermination": True})
    assert bound_rms(blind, 0)["turbulence"] == pytest.approx(blind.turbulence.rms, rel=1e-6)
    assert set(bound_rms(blind, 0)) == {*TARGETS, "total"}


def test_slow_turbulence_is_resolved_at_any_wind() -> None:
    process = Ar2(turbulence_corner(0.5, 8.0, 1), 0.9, 0.5, 1e-3)
    spectrum = process.psd(np.fft.rfftfreq(2**17, 1e-3)) / 2e-3
    assert circle_mean(spectrum) == pytest.approx(0.25, rel=1e-6)


def test_no_vibration_has_no_spectrum() -> None:
    s = MATCHED.replace({"vibration.source": "none"})
    assert bound_rms(s, 0)["vibration"] == 0.0 and vibration_variance(s, 0) == 0.0
