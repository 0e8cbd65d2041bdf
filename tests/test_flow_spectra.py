"""Spectra of frozen flow: against variances by another integral, against simulated records, and the bound that stands on them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import csd, welch

from wfsobs.evaluation.bound import bound_rms, record_bounds
from wfsobs.execution import run_observer
from wfsobs.scenario import Scenario
from wfsobs.signal.wiener import circle_mean
from wfsobs.simulation.disturbance import turbulence_rms
from wfsobs.simulation.flow_spectra import flow_spectra
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.sensing import lgs_error_variance
from wfsobs.simulation.true_spectra import has_known_spectra, n_frequencies, true_spectra

FLOW = Scenario().replace(
    {
        "turbulence.source": "frozen-flow",
        "vibration.source": "none",
        "sensors.kind": "zernike",
        "sensors.lgs_noise": 0.02,
        "run.duration": 4.0,
        "run.warm_up": 0.5,
        "multipeak.turbulence_order": 3,
    }
)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"turbulence.wind_speed": 3.0},
        {"turbulence.wind_speed": 60.0},
        {"turbulence.outer_scale": 5.0},
        {"turbulence.outer_scale": 100.0},
        {"telescope.diameter": 39.0},
        {"sensors.lgs_radius": 64.0, "sensors.lgs_count": 4},
        {"telescope.zenith_angle": 45.0},
        {"turbulence.layers.0.wind_direction": 30.0},
        {"telescope.radial_order": 3},
    ],
    ids=str,
)
def test_the_integral_over_frequency_is_the_variance(changes: dict) -> None:
    s = FLOW.replace(changes)
    f = np.fft.rfftfreq(2**19, 1e-3)
    for mode in {0, 1, len(s.modes) - 1}:
        own, seen, shared, *_ = flow_spectra(s, mode, f)
        assert np.sqrt(own.sum() * f[1]) == pytest.approx(turbulence_rms(s, mode), rel=5e-3)  # interpolation
        error = (own + seen - 2.0 * shared.real).sum() * f[1]
        assert np.sqrt(error) == pytest.approx(np.sqrt(lgs_error_variance(s, mode)), rel=0.02)


@pytest.mark.slow
def test_simulated_records_have_these_spectra() -> None:
    """Above the resolution of the estimate and below the noise's floor; a lone guide star off the axis sees the layer later."""
    s = FLOW.replace(
        {"sensors.lgs_count": 1, "sensors.lgs_radius": 40.0, "sensors.lgs_noise": 0.0, "loop.closed": False, "run.duration": 20.0}
    )
    names, total = ("own", "measurement", "cross"), np.zeros((3, 4097), complex)
    for seed in range(8):
        record = simulate(s.replace({"run.seed": seed}))
        assert record.turbulence is not None
        truth, z = record.turbulence[:-1, 0], record.z[1:, 0]  # z[k + 1] is of step k
        for i, (a, b) in enumerate(((truth, truth), (z, z), (truth, z))):
            f, density = welch(a, 1e3, nperseg=8192) if a is b else csd(b, a, 1e3, nperseg=8192)
            total[i] += density / 8
    band = (f >= 1.5) & (f <= 8.0)
    expected = flow_spectra(s, 0, f)
    for i, name in enumerate(names):
        # 8 records of 4 segments, 53 frequencies: 3 % at one sigma for the mean of the ratios; leakage fills ripples a little.
        ratio = (total[i, band] / getattr(expected, name)[band]).mean()
        assert ratio == pytest.approx(1.0, abs=0.15), name


def test_a_step_is_the_mean_of_the_steps_of_a_faster_sensor() -> None:
    """The mean of four steps of a quarter of the length has the transfer function of four phasors."""
    f = np.linspace(1.0, 500.0, 200)
    slow, fast = (flow_spectra(FLOW.replace({"sensors.lgs_rate": rate}), 0, f) for rate in (1000.0, 4000.0))
    mean = np.abs(np.exp(-2j * np.pi * np.multiply.outer(f, np.arange(4)) / 4000.0).mean(axis=1)) ** 2
    for name in ("own", "measurement", "cross"):
        # both are interpolated between frequencies 5 % apart, which cuts (0.05 x 2 pi / 2)^2 / 8 = 0.003 off their bend at most
        assert np.abs(getattr(slow, name)) == pytest.approx(mean * np.abs(getattr(fast, name)), rel=3e-3, abs=0)


def test_true_spectra_carry_them() -> None:
    spectra = true_spectra(FLOW, 0)
    assert np.sqrt(circle_mean(spectra.signal["turbulence"])) == pytest.approx(turbulence_rms(FLOW, 0), rel=5e-3)
    noise = circle_mean(spectra.measurement[:] * 0 + 0.02**2 / FLOW.sensors.lgs_count)
    assert spectra.measurement.min() == pytest.approx(noise, rel=0.01), "beyond the knee there is nothing but noise"


@pytest.mark.slow
def test_on_frozen_flow_a_third_order_model_is_within_a_tenth_of_the_bound() -> None:
    """Second order is not: its filter takes too much of the noise for turbulence."""
    s = FLOW.replace({"sensors.lgs_altitude": 1e6, "sensors.lgs_noise": 0.05})  # no cone: the error of the filter alone
    errors = {2: [], 3: []}
    for seed in range(6):
        record = simulate(s.replace({"run.seed": seed}))
        assert record.turbulence is not None
        for order, found in errors.items():
            values = run_observer("kf-multi", record, s.replace({"multipeak.turbulence_order": order}))
            found.append(np.mean((values["turbulence"] - record.turbulence)[500:] ** 2))
    least = np.sqrt(np.mean([bound_rms(s, mode)["turbulence"] ** 2 for mode in (0, 1)]))
    # 12 signals of 3.5 s, errors with a correlation time of about 50 ms: 4 % at one sigma.
    assert 0.92 * least < np.sqrt(np.mean(errors[3])) < 1.1 * least
    assert np.mean(errors[2]) > np.mean(errors[3])


@pytest.mark.slow
def test_too_slow_a_flow_has_no_bound_rather_than_a_wrong_one() -> None:
    slow = FLOW.replace({"turbulence.wind_speed": 0.2})
    assert not has_known_spectra(slow) and record_bounds(slow, simulate(slow)) == []
    assert has_known_spectra(FLOW) and n_frequencies(FLOW.replace({"turbulence.wind_speed": 1.0})) == 2**20
    # In slower air all is easier: at 2 m/s as little of the cone effect is left as at 1.
    assert bound_rms(FLOW.replace({"turbulence.wind_speed": 1.0}), 0)["total"] == pytest.approx(
        bound_rms(FLOW.replace({"turbulence.wind_speed": 2.0}), 0)["total"], rel=0.05
    )
