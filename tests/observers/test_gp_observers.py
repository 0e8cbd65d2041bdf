"""The Gaussian processes in time as observers: the dense regression, and the filters that they are where told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import wfsobs
from wfsobs.observers.gp.lgs import GaussianProcess, kernels_of
from wfsobs.prior import Lines
from wfsobs.priors_from.scenario import prior_of

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
