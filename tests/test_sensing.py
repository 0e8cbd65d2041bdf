"""What the sensors see: delays, frames, averages, independence."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from wfsobs.scenario import Scenario
from wfsobs.simulation.disturbance import Disturbance
from wfsobs.simulation.sensing import measure_open_loop

N = 4000


def sensors(**values: Any) -> Scenario:
    s = Scenario()
    s.update({"sensors": {"lgs_noise": 0.0, "ngs_noise": 0.0, "lgs_low_frequency_rms": 0.0} | values})
    return s


def disturbance(n: int = N) -> Disturbance:
    rng = np.random.default_rng(8)
    return Disturbance(rng.standard_normal((n, 2)), rng.standard_normal((n, 2)))


QUIET = Disturbance(np.zeros((N, 2)), np.zeros((N, 2)))


def test_lgs_sees_the_step_before() -> None:
    """Paper, eq. 3: y[k] = phi_dist[k-1], to the last bit; nothing is there before the start."""
    d = disturbance()
    lgs = measure_open_loop(sensors(), d, np.random.default_rng(0)).lgs
    assert np.array_equal(lgs[1:], (d.turbulence + d.vibration)[:-1])
    assert not lgs[0].any()


@pytest.mark.parametrize("n", [1, 2, 5, 7, 100])
@pytest.mark.parametrize("steps", [3, 99, 100, 101, 1003])
def test_ngs_frames_average_exactly_their_exposure(n: int, steps: int) -> None:
    d = disturbance(steps)
    ngs = measure_open_loop(sensors(exposure_ratio=n), d, np.random.default_rng(0)).ngs
    total = d.turbulence + d.vibration
    for k in range(steps):
        if k >= n and k % n == 0:
            # a sum of n numbers in another order: n eps of their sizes (below 6 each)
            assert np.abs(ngs[k] - total[k - n : k].mean(axis=0)).max() < 1e-14
        else:
            assert np.isnan(ngs[k]).all()


@pytest.mark.parametrize("count", [1, 2, 5, 16])
def test_noise_of_the_mean_over_the_lgs(count: int) -> None:
    s = sensors(lgs_noise=0.02, ngs_noise=0.03, lgs_count=count, exposure_ratio=2)
    seen = measure_open_loop(s, QUIET, np.random.default_rng(count))
    # a variance from M Gaussians is known to sqrt(2 / M); 4.5 of that, two-sided
    for x, wanted in ((seen.lgs, 0.02**2 / count), (seen.ngs[2::2], 0.03**2)):
        assert abs(np.mean(x**2) / wanted - 1) < 4.5 * np.sqrt(2 / x.size)
        assert abs(np.mean(x[:, 0] * x[:, 1])) < 4.5 * wanted / np.sqrt(len(x))
        assert abs(np.mean(x[1:] * x[:-1])) < 4.5 * wanted / np.sqrt(x.size)
    assert abs(np.mean(seen.lgs[2::2] * seen.ngs[2::2])) < 4.5 * 0.02 * 0.03 / np.sqrt(count * N)


def test_guide_stars_are_independent_and_stay_when_one_is_added() -> None:
    """The second star alone is 2 mean(1, 2) - (1): as large as the first, and not correlated with it."""
    for slow, noise in ((0.0, 0.02), (0.05, 0.0)):
        scenarios = [sensors(lgs_noise=noise, lgs_low_frequency_rms=slow, lgs_count=c) for c in (1, 2, 3)]
        means = [measure_open_loop(s, QUIET, np.random.default_rng(2)).lgs for s in scenarios]
        stars = [means[0], 2 * means[1] - means[0], 3 * means[2] - 2 * means[1]]
        if noise:
            for i, x in enumerate(stars):
                assert abs(np.mean(x**2) / noise**2 - 1) < 4.5 * np.sqrt(2 / x.size)
                for y in stars[:i]:
                    assert abs(np.mean(x * y)) < 4.5 * noise**2 / np.sqrt(x.size)
        else:  # slow errors are few independent numbers: no two stars the same, none a multiple of another
            correlations = np.corrcoef([x.ravel() for x in stars])[np.triu_indices(3, 1)]
            assert (np.abs(correlations) < 0.8).all()


@pytest.mark.slow
def test_low_frequency_error_has_its_rms_and_falls_with_the_number_of_stars() -> None:
    for count in (1, 4):
        # One number per seed, mode and end of the record, 4 s apart: exp(-0.9 * 7.07 * 4) = 1e-11, independent.
        s = sensors(lgs_low_frequency_rms=0.05, lgs_count=count)
        ends = np.array([measure_open_loop(s, QUIET, np.random.default_rng(seed)).lgs[[1, -1]] for seed in range(120)])
        wanted = 0.05**2 / count
        assert abs(np.mean(ends**2) / wanted - 1) < 4.5 * np.sqrt(2 / ends.size)
        assert abs(np.mean(ends[..., 0] * ends[..., 1])) < 4.5 * wanted / np.sqrt(ends[..., 0].size)


def test_ngs_has_no_low_frequency_error() -> None:
    d = disturbance()
    with_error = measure_open_loop(sensors(lgs_low_frequency_rms=1.0), d, np.random.default_rng(0))
    without = measure_open_loop(sensors(), d, np.random.default_rng(0))
    assert np.array_equal(with_error.ngs, without.ngs, equal_nan=True)
    assert not np.allclose(with_error.lgs, without.lgs)


def test_indetermination_takes_turbulence_from_the_lgs_alone() -> None:
    d = disturbance()
    blind = measure_open_loop(sensors(tip_tilt_indetermination=True), d, np.random.default_rng(0))
    assert np.array_equal(blind.lgs[1:], d.vibration[:-1])
    assert np.array_equal(blind.ngs, measure_open_loop(sensors(), d, np.random.default_rng(0)).ngs, equal_nan=True)


@pytest.mark.parametrize(
    ("change", "lgs_same"),
    [
        ({"lgs_noise": 0.5}, False),
        ({"lgs_count": 7}, False),
        ({"lgs_low_frequency_rms": 0.3}, False),
        ({"ngs_noise": 0.5}, True),
        ({"exposure_ratio": 3}, True),
    ],
)
def test_a_change_of_one_sensor_leaves_the_noise_of_the_other(change: dict[str, Any], lgs_same: bool) -> None:
    base = {"lgs_noise": 0.02, "ngs_noise": 0.01, "lgs_low_frequency_rms": 0.05, "lgs_count": 2}
    before = measure_open_loop(sensors(**base), QUIET, np.random.default_rng(4))
    after = measure_open_loop(sensors(**(base | change)), QUIET, np.random.default_rng(4))
    assert np.array_equal(before.lgs, after.lgs) == lgs_same
    if lgs_same and "exposure_ratio" in change:
        both = ~np.isnan(before.ngs) & ~np.isnan(after.ngs)
        assert both.sum() > 100 and np.array_equal(before.ngs[both], after.ngs[both])
    else:
        assert np.array_equal(before.ngs, after.ngs, equal_nan=True) != lgs_same
