"""The Butterworth references: bands, delays, alignment; and the answer zero."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, freqz_sos, lfilter

from wfsobs.evaluation.scores import lag
from wfsobs.execution import run_observer
from wfsobs.observers.baselines import open_loop_reference
from wfsobs.priors_from.scenario import bands_of
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.spectrum import bandpass_bank, filter_causal, filter_zero_phase
from wfsobs.simulation.loop import simulate


def scenario(changes: dict[str, Any] | None = None) -> Scenario:
    base = PRESETS["paper"]()
    base.update({"run": {"duration": 2.0, "warm_up": 0.5}, "gpr_offline": {"training_size": 2, "depth": 1}})
    return base.replace(changes or {})


def one_band(f: float, bandwidth: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """First-order band-pass from its textbook form: bilinear transform of s B / (s^2 + s B + w0^2), edges pre-warped."""
    low, high = (np.tan(np.pi * edge * dt) for edge in (f - bandwidth / 2, f + bandwidth / 2))
    width, centre2 = high - low, high * low
    b = np.array([width, 0.0, -width])
    a = np.array([1 + width + centre2, 2 * centre2 - 2, 1 - width + centre2])
    return b / a[0], a / a[0]


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.lists(st.floats(5.0, 200.0), min_size=1, max_size=6), st.floats(0.1, 8.0), st.integers(0, 2**31))
def test_the_bank_is_the_sum_of_first_order_bands(centres: list[float], bandwidth: float, seed: int) -> None:
    x = np.random.default_rng(seed).standard_normal((400, 2))
    wanted = sum(lfilter(*one_band(f, bandwidth, 1e-3), x, axis=0) for f in centres)
    got = filter_causal(bandpass_bank(centres, bandwidth, 1, 1e-3), x)
    # coefficients of a band 0.1 Hz wide at 5 Hz: poles within 3e-4 of the circle, eps / 3e-4 / 0.03 of the output
    assert np.abs(got - wanted).max() < 1e-9 * np.abs(wanted).max()


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_edges_are_at_half_power_and_the_centre_passes(order: int) -> None:
    for f, bandwidth in ((17.1, 3.0), (61.5, 2.0)):
        (sos,) = bandpass_bank([f], bandwidth, order, 1e-3)
        _, response = freqz_sos(sos, [f - bandwidth / 2, f + bandwidth / 2], fs=1000)
        assert np.abs(response) ** 2 == pytest.approx([0.5, 0.5], rel=1e-9)
        # the middle of the pass-band is the geometric mean of the (warped) edges
        edges = np.tan(np.pi * np.array([f - bandwidth / 2, f + bandwidth / 2]) * 1e-3)
        middle = np.arctan(np.sqrt(edges.prod())) / np.pi / 1e-3
        _, at = freqz_sos(sos, [middle], fs=1000)
        assert abs(at[0] - 1.0) < 1e-9


def test_the_causal_bank_starts_from_rest_and_looks_back_only() -> None:
    bank = bandpass_bank([30.0, 60.0], 3.0, 1, 1e-3)
    x = np.zeros((200, 1))
    x[100] = 1.0
    out = filter_causal(bank, x)
    assert not out[:100].any() and out[100:].all()


def test_zero_phase_delays_nothing_and_is_symmetric() -> None:
    """Its impulse response is even in time; a tone in the pass-band comes out in place."""
    bank = bandpass_bank([30.0, 60.0], 3.0, 1, 1e-3)
    x = np.zeros((8001, 1))
    x[4000] = 1.0
    out = filter_zero_phase(bank, x)[:, 0]
    # what has not died away within 4 s, exp(-pi 3 4) of it
    assert np.abs(out - out[::-1]).max() < 1e-13
    # Even and odd parts alone would not see a sum of bands taken before the second pass: both passes per band.
    bands = [one_band(f, 3.0, 1e-3) for f in (30.0, 60.0)]
    wanted = sum(lfilter(*band, lfilter(*band, x[:, 0])[::-1])[::-1] for band in bands)
    assert np.abs(out - wanted).max() < 1e-12


def test_open_loop_reference_is_moved_by_the_step_of_the_sensor() -> None:
    """y_OL[k + 1] sees phi[k]: of a tone in the band the reference of step k is the vibration of step k."""
    s = scenario({"butterworth.frequencies": [47.7]})
    t = np.arange(4000) * 1e-3
    phi = 0.02 * np.cos(2 * np.pi * 47.7 * t)[:, None]
    y_open = np.vstack([[[0.0]], phi[:-1]])
    got = open_loop_reference(bands_of(s), y_open, 1e-3)
    assert got.shape == phi.shape and np.isnan(got[-1]).all()
    # The top of the band is at the geometric mean of its edges, 47.676 Hz, so that 47.7 Hz is off by x = 0.0158 of the
    # half width and passes with 1 / (1 + x^2) = 1 - 2.5e-4; the filter has settled to exp(-pi 3 1.5).
    assert np.abs(got - phi)[1500:2500].max() < 4e-4 * 0.02
    # one step off would be 30 %
    assert np.abs(got[1501:2501] - phi[1500:2500]).max() > 0.2 * 0.02


def test_both_references_on_a_record() -> None:
    """The non-causal one on the twin with 3 Hz bands, the causal one on z with 2 Hz bands, one step late by itself."""
    s = scenario()
    r = simulate(s)
    assert r.open_loop_y is not None
    b = s.butterworth
    ol = run_observer("butterworth-ol", r, s)["vibration"]
    assert np.array_equal(ol[:-1], filter_zero_phase(bandpass_bank(b.frequencies, 3.0, 1, 1e-3), r.open_loop_y)[1:])
    z = r.y_lgs - np.vstack([np.zeros((2, 2)), r.u[:-2]])
    cl = run_observer("butterworth-cl", r, s)["vibration"]
    wanted = sum(lfilter(*one_band(f, 2.0, 1e-3), z, axis=0) for f in b.frequencies)
    assert np.abs(cl - wanted).max() < 1e-11


@pytest.mark.parametrize("f", [17.1, 34.1, 61.5])
def test_the_causal_reference_is_one_step_late_on_a_settled_tone(f: float) -> None:
    s = scenario(
        {
            "butterworth.frequencies": [f],
            "turbulence.source": "none",
            "sensors.lgs_noise": 0.0,
            "run.duration": 4.0,
            "sensors.lgs_low_frequency_rms": 0.0,
            "vibration.peaks": [{"frequency": f, "damping": 0.0, "rms": [0.02, 0.02]}],
        }
    )
    r = simulate(s)
    assert r.vibration is not None
    found = lag(r.vibration[3000:, 0], run_observer("butterworth-cl", r, s)["vibration"][3000:, 0], r.dt)
    # the band's phase at its arithmetic centre (the geometric one has none) is below 2 (bandwidth / 8 f) rad
    assert found is not None and abs(found - 1e-3) < 2.0 / 8 / f / (np.pi * f) + 2e-5


def test_order_reaches_the_filter() -> None:
    """Fourth order falls off faster: outside a band of 3 Hz, at twice its width, 24 dB per octave and more."""
    x = np.sin(2 * np.pi * 53.0 * np.arange(4000) * 1e-3)[:, None]
    first, fourth = (np.abs(filter_causal(bandpass_bank([47.0], 3.0, order, 1e-3), x)[3000:]).max() for order in (1, 4))
    analog = [1 / np.sqrt(1 + ((53**2 - 47**2) / (53 * 3.0)) ** (2 * order)) for order in (1, 4)]
    # warping and the two centres count for some percent of the attenuation, to the fourth power
    assert first == pytest.approx(analog[0], rel=0.1) and fourth == pytest.approx(analog[1], rel=0.4)
    sos = butter(4, [45.5, 48.5], "bandpass", fs=1000, output="sos")
    assert np.array_equal(bandpass_bank([47.0], 3.0, 4, 1e-3)[0], sos)


def test_zero_is_zero_for_both_targets() -> None:
    r = simulate(scenario())
    found = run_observer("zero", r, scenario())
    assert sorted(found) == ["turbulence", "vibration"]
    assert all(v.shape == r.y_lgs.shape and not v.any() for v in found.values())
