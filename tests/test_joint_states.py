"""States of linear filters together, against sums over their past."""

from __future__ import annotations

import numpy as np

from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.joint_states import LeastVariance, StateFilter, frame_shares, shared_covariance
from wfsobs.signal.statespace import disturbance_model

RNG = np.random.default_rng(3)


def some_filter(n: int) -> StateFilter:
    F = RNG.standard_normal((n, n))
    return StateFilter(0.7 * F / np.abs(np.linalg.eigvals(F)).max(), RNG.standard_normal(n))


def pulse_response(one: StateFilter, length: int) -> np.ndarray:
    out = [one.G]
    for _ in range(length - 1):
        out.append(one.F @ out[-1])
    return np.array(out).T


def test_responses_are_the_transforms_of_pulses() -> None:
    one, omega = some_filter(5), np.array([0.0, 0.3, 2.0, np.pi])
    taps = pulse_response(one, 200)
    expected = taps @ np.exp(-1j * np.outer(np.arange(200), omega))
    np.testing.assert_allclose(one.response(omega), expected, rtol=1e-10, atol=1e-12)


def test_the_share_of_a_mode_is_the_sum_over_its_past() -> None:
    one, line, gain, noise, n = some_filter(4), Ar2(2 * np.pi * 40.0, 0.05, 0.02, 1e-3), 0.8, 0.01, 400
    model, taps = disturbance_model((), [line]), pulse_response(one, n)
    r = line.autocovariance(2 * n)
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    (found,) = frame_shares(one, StateFilter(np.zeros((0, 0)), np.zeros(0)), 1, model, noise, 0.0, gain)
    np.testing.assert_allclose(found.states, taps @ (gain**2 * r[lag] + noise**2 * np.eye(n)) @ taps.T, rtol=1e-9, atol=1e-15)
    now = model.outputs["vibration"] @ found.disturbance  # z[k] is of step k - 1
    np.testing.assert_allclose(now, gain * taps @ r[1 : n + 1], rtol=1e-9, atol=1e-15)


def test_inputs_that_are_waves_have_the_covariance_of_waves() -> None:
    """Two inputs at one frequency, the second a quarter of a period late, of the powers of sqrt(2) cos."""
    filters, omega = [some_filter(3), some_filter(2)], np.array([0.4])
    powers = np.array([[1.0, 1j], [-1j, 1.0]])[:, :, None]
    found = shared_covariance(powers, [one.response(omega) for one in filters])
    taps, k = [pulse_response(one, 300) for one in filters], np.arange(300)
    expected = np.zeros((5, 5))
    for phase in 2 * np.pi * np.arange(8) / 8:
        waves = np.cos(phase - 0.4 * k), np.cos(phase - np.pi / 2 - 0.4 * k)
        x = np.concatenate([one @ wave for one, wave in zip(taps, waves, strict=True)])
        expected += 2.0 * np.outer(x, x) / 8
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max())


def test_weights_are_those_of_the_regression() -> None:
    root = RNG.standard_normal((6, 6)) * 10.0 ** np.arange(-3, 3)[:, None]
    covariance, cross = root @ root.T, RNG.standard_normal((2, 6)) @ root.T
    got = LeastVariance(covariance).weights(cross) @ covariance
    np.testing.assert_allclose(got, cross, rtol=0, atol=1e-6 * np.sqrt(np.diag(covariance)).max())
