"""Predicted spectra and errors against closed forms and against a long simulation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import get_window

import wfsobs
from wfsobs.evaluation.bound import bound_rms
from wfsobs.evaluation.exact_errors import TRUTH, Prediction, Theory, band_rms, exact_errors, spectra
from wfsobs.evaluation.scores import BOUND
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.filters import steady_filter
from wfsobs.priors_from.scenario import lines_of
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.spectrum import expected_psd

RIGHT = Scenario().replace(
    {
        "vibration.source": "ar2",
        "vibration.peaks": [
            {"frequency": 17.0, "damping": 0.02, "rms": [0.05]},
            {"frequency": 31.0, "damping": 0.01, "rms": [0.02]},
        ],
        "sensors.lgs_low_frequency_rms": 0.0,
        "kalman.frequency": 20.0,
    }
)
"""The multi-peak filter has the right model here, the filter of one peak has not."""


def predictions(scenario: Scenario, target: str, theory: Theory | None = None, **options: Any) -> dict[str, Prediction]:
    return {p.observer: p for p in (theory or Theory()).predict(scenario, 0, target, **options)}


def test_a_response_follows_the_time_step() -> None:
    """A band filter has the same prior, settings and number of frequencies at another rate."""
    theory, of = Theory(most=2**14), {"observers": ["butterworth-cl"]}
    predictions(RIGHT, "vibration", theory, **of)
    slower = RIGHT.replace({"sensors.lgs_rate": 0.8 * RIGHT.sensors.lgs_rate})
    kept, fresh = (predictions(slower, "vibration", it, **of) for it in (theory, Theory(most=2**14)))
    # a response is cut off where a millionth of it is left
    assert kept["butterworth-cl"].rms == pytest.approx(fresh["butterworth-cl"].rms, rel=1e-6)


def test_observers_of_the_lgs_need_no_spectra_of_the_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wfsobs.evaluation.exact_errors.ngs_frames", None)
    found = predictions(RIGHT, "vibration", observers=["kf-lgs", BOUND])
    assert found.keys() == {TRUTH, "kf-lgs", BOUND} and found["kf-lgs"].rms > found[BOUND].rms > 0.0


class TestRms:
    @pytest.mark.parametrize("target", TARGETS)
    def test_of_the_right_model_is_that_of_the_riccati_equation(self, target: str) -> None:
        lines = lines_of(RIGHT, 0)
        model = lines.disturbance(RIGHT.multipeak.line_width)
        row = model.outputs[target]
        expected = np.sqrt(row @ steady_filter(model, lines.noise)[1].posterior @ row)
        found = predictions(RIGHT, target)
        # a response is cut off where a millionth of it is left, and correlations after half the DFT, exp(-10) of them
        assert found["kf-multi"].rms == pytest.approx(expected, rel=1e-4)
        assert found[BOUND].rms == pytest.approx(expected, rel=1e-4)
        assert found["kf-lgs"].rms > 1.02 * expected, "a wrong model costs something"

    @pytest.mark.parametrize("target", TARGETS)
    def test_with_fewer_frequencies_it_is_nearly_the_same(self, target: str) -> None:
        scenario, shown = PRESETS["ut4"](), ("kf-lgs", "kf-multi", BOUND)
        coarse = Theory(most=65_536)
        found, whole = (predictions(scenario, target, theory, observers=shown) for theory in (coarse, Theory()))
        assert coarse.spectra(scenario, 0).n == 65_536
        # three digits are shown; what is left of narrow lines, the bound, moves most
        assert {n: p.rms for n, p in found.items()} == pytest.approx({n: p.rms for n, p in whole.items()}, rel=0.01)
        assert found["kf-multi"].rms != whole["kf-multi"].rms

    def test_of_the_target_and_of_the_bound(self) -> None:
        found = predictions(RIGHT, "vibration")
        assert found[TRUTH].rms == pytest.approx(np.hypot(0.05, 0.02), rel=1e-6)
        assert found["zero"].rms == pytest.approx(found[TRUTH].rms, rel=1e-12)
        assert found[BOUND].rms == pytest.approx(bound_rms(RIGHT, 0)["vibration"], rel=1e-9)

    def test_of_the_last_measurement_is_the_variogram_and_the_noise(self) -> None:
        quiet = RIGHT.replace({"vibration.source": "none"})
        omega = lines_of(quiet, 0).turbulence[0]
        assert isinstance(omega, Ar2)
        r = omega.autocovariance(2)
        noise = lines_of(quiet, 0).noise
        # z[k] = phi[k - 1] + w: the error is a step of the turbulence, and the noise
        expected = np.sqrt(2.0 * (r[0] - r[1]) + noise**2)
        assert predictions(quiet, "turbulence")["persistence"].rms == pytest.approx(expected, rel=1e-6)

    def test_only_of_linear_observers(self) -> None:
        names = set(predictions(RIGHT, "vibration"))
        of_both = {"multirate-optimal", "multirate-multi", "gp-both"}
        assert names == {TRUTH, BOUND, "kf-lgs", "kf-multi", "gp-lgs", "butterworth-cl", "zero", *of_both}
        assert all(OBSERVERS[name].linear for name in names - {TRUTH, BOUND})

    @pytest.mark.parametrize("ratio", [1, 3, 5])
    @pytest.mark.parametrize("name", ["kf-ngs", "multirate", "multirate-multi"])
    def test_of_both_sensors_is_the_mean_of_the_exact_error_over_the_cycle(self, name: str, ratio: int) -> None:
        scenario = RIGHT.replace({"sensors.exposure_ratio": ratio})
        exact = exact_errors(OBSERVERS[name], scenario)[0]
        for target in OBSERVERS[name].targets:
            # responses of one record of impulses, what is left of each in the next
            assert predictions(scenario, target, observers=[name])[name].rms == pytest.approx(exact[target].rms, rel=1e-8)

    @pytest.mark.parametrize("name", ["kf-multi", "multirate-multi", "gp-both"])
    def test_with_responses_cut_off_as_in_a_drag_it_is_nearly_the_same(self, name: str) -> None:
        scenario, of = PRESETS["paper"](), {"observers": [name]}
        rough, whole = (predictions(scenario, "vibration", theory, **of)[name].rms for theory in (Theory(left=0.001), Theory()))
        assert rough == pytest.approx(whole, rel=3e-4) and rough != whole  # three digits are shown

    def test_none_where_events_change_the_spectra(self) -> None:
        with pytest.raises(ValueError, match="events"):
            Theory().predict(PRESETS["peak-jump"](), 0, "vibration")


@pytest.mark.slow
def test_what_is_kept_from_the_last_frame_changes_nothing() -> None:
    theory, base = Theory(), RIGHT.replace({"multipeak.turbulence_order": 3})
    changes = [
        {"kalman.frequency": 25.0},
        {"vibration.peaks.0.frequency": 19.0},
        {"turbulence.wind_speed": 20.0},
        {"sensors.lgs_noise": 0.05},
        {"kalman.measurement_noise": "manual", "kalman.lgs_noise": 0.1},
        {"multipeak.line_width": 1.0},
        {"butterworth.bandwidth_online": 4.0},
    ]
    theory.predict(base, 0, "vibration")
    for change in changes:
        base = base.replace(change)
        for target in TARGETS:
            kept, fresh = predictions(base, target, theory), predictions(base, target)
            assert kept.keys() == fresh.keys()
            for name, it in fresh.items():
                # only where a response is cut off differs, a millionth of it
                assert kept[name].rms == pytest.approx(it.rms, rel=1e-6), (change, name)
                np.testing.assert_allclose(kept[name].density, it.density, rtol=1e-3, atol=1e-9 * it.density.max())


@pytest.mark.slow
def test_a_drag_of_the_corner_ends_where_a_jump_does() -> None:
    """The fits of the turbulence start from the last frame's; in each frame a theory without one starts from afar."""
    theory, base, of = Theory(most=2**14, left=0.001), PRESETS["ut4"](), {"observers": ["kf-multi", "multirate-multi"]}
    for factor in (1.0, 1.02, 1.05, 1.1, 0.9):
        moved = base.replace({"turbulence.wind_speed": factor * base.turbulence.wind_speed})
        kept, fresh = (predictions(moved, "turbulence", it, **of) for it in (theory, Theory(most=2**14, left=0.001)))
        for name, it in fresh.items():
            # fits end within a thousandth of a standard deviation; three digits are shown, and lines a hundredth apart
            assert kept[name].rms == pytest.approx(it.rms, rel=1e-4), (factor, name)
            np.testing.assert_allclose(kept[name].density, it.density, rtol=3e-3, atol=1e-6 * it.density.max())


class TestSpectrum:
    def test_of_welch_is_the_mean_of_its_windows(self) -> None:
        n, dt = 64, 0.01
        spectrum = Ar2(2.0 * np.pi * 20.0, 0.1, 1.0, dt).psd(np.fft.rfftfreq(2048, dt)) / (2.0 * dt)
        covariance = toeplitz(np.fft.irfft(spectrum)[:n])
        frequency, density = expected_psd(spectrum, dt, 1000, resolution=1.0 / (n * dt))
        waves = get_window("hann", n) * np.exp(-2j * np.pi * np.outer(np.arange(n // 2 + 1), np.arange(n)) / n)
        expected = 2.0 * dt * np.einsum("ki,ij,kj->k", waves, covariance, waves.conj()).real / np.sum(get_window("hann", n) ** 2)
        expected[[0, -1]] *= 0.5  # one-sided
        np.testing.assert_allclose(frequency, np.fft.rfftfreq(n, dt))
        np.testing.assert_allclose(density, expected, rtol=1e-9, atol=1e-12 * expected.max())

    @pytest.mark.slow
    def test_is_that_of_a_long_simulation(self) -> None:
        changes = {"vibration.synthesis": "gaussian", "run.duration": 200.0, "loop.closed": False}
        scenario = PRESETS["paper"]().replace(changes)
        names = ["kf-lgs", "kf-multi", "butterworth-cl", "multirate-multi"]
        of_signal, of_error = (predictions(scenario, "vibration", of_error=of) for of in (False, True))
        result = wfsobs.run(scenario, observers=names)
        for name in names:
            estimate = result.estimate(name, "vibration")
            assert estimate is not None
            measured = spectra(result.record, "vibration", estimate.values, scenario.run.warm_up)
            assert measured is not None
            frequency, *densities = measured
            for found, density in zip((of_signal, of_error), densities, strict=True):
                np.testing.assert_allclose(found[name].frequency, frequency)
                for low, high in ((2.0, 9.0), (9.0, 13.0), (13.0, 22.0), (22.0, 28.0), (40.0, 50.0), (50.0, 400.0)):
                    # 200 s of a line half a hertz wide are a hundred independent values: 3.5 % of the rms, thrice
                    expected = band_rms(frequency, found[name].density, low, high)
                    assert band_rms(frequency, density[:, 0], low, high) == pytest.approx(expected, rel=0.11), (name, low)
            total = next(s.rms for s in result.scores if (s.observer, s.target, s.mode) == (name, "vibration", "tip"))
            assert total == pytest.approx(predictions(scenario, "vibration")[name].rms, rel=0.05)


def test_observers_for_which_there_is_no_time_are_left_out_the_first_alone_never():
    theory, names = Theory(), ["kf-multi", "kf-lgs", "bound"]
    whole = {p.observer: p for p in theory.predict(RIGHT, 0, "vibration", names)}
    out_of_time = Theory().predict(RIGHT, 0, "vibration", names, until=0.0)
    assert [p.observer for p in out_of_time] == ["truth", "kf-multi"]
    assert out_of_time[1].rms == whole["kf-multi"].rms
