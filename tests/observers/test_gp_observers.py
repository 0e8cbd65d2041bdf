"""The Gaussian processes in time as observers: the dense regression, and the filters that they are where told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import wfsobs
from wfsobs.observers import OBSERVERS
from wfsobs.observers.gp import GaussianProcess, kernels_of
from wfsobs.prior import Lines
from wfsobs.priors_from.scenario import prior_of
from wfsobs.signal.statespace import disturbance_model

SHORT = {"run.duration": 3.0, "run.warm_up": 1.0}
ONE_PEAK = {"vibration.source": "ar2", "vibration.peaks": [{"frequency": 47.5, "damping": 0.03, "rms": [0.015, 0.015]}]}


def scenario(changes: dict[str, object]) -> wfsobs.Scenario:
    return wfsobs.PRESETS["paper"]().replace({**SHORT, **changes})


@pytest.mark.parametrize(("name", "filter_"), [("gp-lgs", "kf-multi"), ("gp-both", "multirate-multi")])
def test_as_told_they_are_the_filters_of_sampled_processes(name: str, filter_: str) -> None:
    """An AR(2) is not an oscillator that is sampled: it has no zero. At a thousandth of the corner that is 1 % of the error."""
    s = scenario({})
    record = wfsobs.simulate(s)
    found = wfsobs.observe(record, s, observers=[name, filter_])
    for target in ("turbulence", "vibration"):
        ours, other = (found.estimate(one, target) for one in (name, filter_))
        error = (other.values - record.truth(target))[1000:]
        assert (ours.values - other.values)[1000:].std() < 0.05 * error.std()
        np.testing.assert_allclose(ours.sd[1000:], other.sd[1000:], rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["as told", "matern-1/2", "matern-3/2", "matern-5/2", "squared-exponential"])
@pytest.mark.parametrize("background", [0.0, 0.01])
def test_the_estimate_is_that_of_the_dense_regression(kernel: str, background: float) -> None:
    """Of turbulence and vibration now, from all measurements, by the kernels themselves; a filter at rest forgets its start."""
    s = scenario({"gp.turbulence": kernel, "gp.background_rms": background, **ONE_PEAK})
    record = wfsobs.simulate(s)
    found = wfsobs.observe(record, s, observers=["gp-lgs"])
    lines = prior_of(s, record, (Lines,)).lines[0]
    n, k = 1500, 1499
    lags = s.dt * np.arange(n + 1)
    settings = GaussianProcess(turbulence=kernel, background_rms=background)
    turbulence, vibration, colour = (one.state_space().covariance(lags) for one in kernels_of(lines, settings))
    K = (turbulence + vibration + colour)[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))] + lines.noise**2 * np.eye(n)
    weights = np.linalg.solve(K, np.array([turbulence[1:], vibration[1:]]).T)
    want = record.z[k::-1, 0][:n] @ weights
    for target, value, own, covariance in zip(("turbulence", "vibration"), want, weights.T, (turbulence, vibration), strict=True):
        estimate = found.estimate("gp-lgs", target)
        # the filter's start, at rest with the steady gain, has faded to 1e-4 of an error after 1.5 s
        assert abs(estimate.values[k, 0] - value) < 1e-3 * estimate.sd[k, 0]
        assert estimate.sd[k, 0] == pytest.approx(np.sqrt(covariance[0] - own @ covariance[1:]), rel=1e-3)


FAST = {"turbulence.wind_speed": 100.0, "turbulence.rms": 0.05, "vibration.peaks.0.damping": 0.2, "sensors.lgs_noise": 0.005}
"""Processes and noises with which a filter at rest has forgotten its start to 1e-11 after a second."""


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["as told", "matern-1/2", "matern-3/2", "matern-5/2"])
def test_of_both_sensors_it_is_the_dense_regression_with_frames_as_means(kernel: str) -> None:
    """On 1000 measurements of the LGS and the 200 NGS frames among them, in three phases: the estimates to 1e-10 of the rms of
    what is estimated, the variances to 1e-10 of its variance. Slow error of the LGS and background are in z alone."""
    s = scenario({"gp.turbulence": kernel, "gp.background_rms": 0.01, **ONE_PEAK}).replace(FAST)
    record = wfsobs.simulate(s)
    found = wfsobs.observe(record, s, observers=["gp-both"])
    prior, n, ratio = prior_of(s, record, OBSERVERS["gp-both"].prior), 1000, s.sensors.exposure_ratio
    lines = prior.lines[0]
    kernels = kernels_of(lines, GaussianProcess(turbulence=kernel, background_rms=0.01))
    lags = np.abs(np.subtract.outer(np.arange(-1, n), np.arange(-1, n)))  # of the disturbance now, and as z has it
    turbulence, vibration, colour = (one.state_space().covariance(s.dt * np.arange(n + 1))[lags] for one in kernels)
    error = disturbance_model([prior.lgs_error[0].process], ())
    slow = [np.ravel(error.C) @ np.linalg.matrix_power(error.A, i) @ np.ravel(error.C) for i in range(n + 1)]
    for k in (990, 992, 994):
        ages = np.arange(k + 1)  # of z[k], z[k-1], ..., the place behind that of the disturbance now
        ends = np.arange(k % ratio, k - ratio + 1, ratio)
        exposure = np.zeros((len(ends), n + 1))
        for row, end in zip(exposure, ends, strict=True):
            row[end + 1 : end + 1 + ratio] = 1.0 / ratio
        seen = np.vstack([np.eye(n + 1)[ages + 1], exposure])
        K = seen @ (turbulence + vibration) @ seen.T + np.diag(
            [lines.noise**2] * (k + 1) + [prior.noise_of(0).ngs_noise ** 2] * len(ends)
        )
        K[: k + 1, : k + 1] += colour[: k + 1, : k + 1] + np.array(slow)[lags[: k + 1, : k + 1]]
        measured = np.concatenate([record.z[k::-1, 0], record.z_ngs[k - ends, 0]])
        cross = seen @ np.array([turbulence[0], vibration[0]]).T
        weights = np.linalg.solve(K, cross)
        for i, target in enumerate(("turbulence", "vibration")):
            estimate, variance = found.estimate("gp-both", target), (turbulence, vibration)[i][0, 0]
            assert abs(estimate.values[k, 0] - weights[:, i] @ measured) < 1e-10 * np.sqrt(variance)
            assert abs(estimate.sd[k, 0] ** 2 - (variance - weights[:, i] @ cross[:, i])) < 1e-10 * variance


def test_a_background_is_of_neither_target() -> None:
    """Told of a coloured background that is there, the filter is better than one that takes it for white noise or turbulence."""
    s = scenario(ONE_PEAK)
    record = wfsobs.simulate(s)
    rng = np.random.default_rng(1)
    colour, decay = np.zeros(record.y_lgs.shape), np.exp(-1.0 / 3.0)
    for k in range(1, len(colour)):
        colour[k] = decay * colour[k - 1] + 0.03 * np.sqrt(1 - decay**2) * rng.standard_normal(2)
    noisy = replace(record, y_lgs=record.y_lgs + colour)
    errors = {}
    for rms in (0.0, 0.03):
        found = wfsobs.observe(noisy, s.replace({"gp.background_rms": rms, "gp.background_scale": 3.0}), observers=["gp-lgs"])
        e = found.estimate("gp-lgs", "vibration")
        errors[rms] = (e.values - record.vibration)[1000:].std()
    assert errors[0.03] < 0.95 * errors[0.0]
