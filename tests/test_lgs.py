"""Several LGS as one: the mean, and the combination of minimum variance."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from wfsobs.pipeline import observe
from wfsobs.priors_from.scenario import measurement_noise
from wfsobs.record import delay_signal
from wfsobs.scenario import Scenario
from wfsobs.simulation.disturbance import make_disturbance, vibration_variance
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.sensing import (
    lgs_error_process,
    lgs_error_variance,
    lgs_noise_rms,
    lgs_turbulence_covariance,
    lgs_weights,
    measure_open_loop,
)

BEST: dict[str, Any] = {"sensors.lgs_combination": "minimum-variance"}
FLOW: dict[str, Any] = {"turbulence.source": "frozen-flow", "sensors.kind": "zernike"}
BESIDE: dict[str, Any] = {"sensors.lgs_count": 4, "sensors.lgs_radius": 30.0, "telescope.radial_order": 3}


def scenario(*changes: dict[str, Any]) -> Scenario:
    return Scenario().replace({key: value for one in (FLOW, *changes) for key, value in one.items()})


def error_of_samples(s: Scenario, seeds: int = 20, n: int = 200) -> np.ndarray:
    """Rms of LGS less disturbance in each mode, of `seeds` short records every 20 ms."""
    slow = s.replace({"sensors.lgs_rate": 50.0, "sensors.exposure_ratio": 1})
    errors = []
    for seed in range(seeds):
        d = make_disturbance(slow, n, np.random.default_rng(seed))
        errors.append((measure_open_loop(slow, d, np.random.default_rng(1000 + seed)).lgs - delay_signal(d.total, 1))[1:])
    return np.sqrt(np.mean(np.square(errors), axis=(0, 1)))


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, BESIDE, {"sensors.lgs_count": 3, "turbulence.source": "ar2"}])
def test_error_and_noise_are_those_of_samples(changes: dict[str, Any]) -> None:
    """Both combinations: the variance of the model against 20 records, to 15 %: each holds some twenty independent numbers."""
    for combination in ({}, BEST):
        s = scenario({"vibration.source": "none"}, changes, combination)
        wanted = [np.sqrt(lgs_error_variance(s, i) + lgs_noise_rms(s, i) ** 2) for i in range(len(s.modes))]
        assert error_of_samples(s) == pytest.approx(wanted, rel=0.15)


@pytest.mark.parametrize("combination", [{}, BEST])
def test_the_error_process_has_the_variance_of_the_error(combination: dict[str, Any]) -> None:
    """Four stars whose errors of 30 nm are independent leave half of that in their mean; the rest by the covariances."""
    several = {"sensors.lgs_count": 4, "turbulence.source": "ar2", "sensors.lgs_low_frequency_rms": 0.03}
    for changes in (several, BESIDE):
        s = scenario(changes, combination)
        for mode in range(len(s.modes)):
            wanted = np.sqrt(lgs_error_variance(s, mode))
            assert lgs_error_process(s, mode, 1e-3).rms == pytest.approx(wanted, rel=1e-9)
    if not combination:
        assert lgs_error_process(scenario(several), 0, 1e-3).rms == pytest.approx(0.015, rel=1e-12)


def test_no_weights_do_better() -> None:
    """What the combination gets wrong has nothing in common with what any star measures in any mode: there is nothing left
    to gain (the principle of orthogonality), to rounding."""
    s = scenario(BESIDE, BEST, {"vibration.source": "none"})
    seen, w = lgs_turbulence_covariance(s), lgs_weights(s)
    for star in range(1, 5):
        measured = seen[star, :, 1:].copy()
        measured[:, star - 1] += np.diag(np.full(9, s.sensors.lgs_noise**2))
        left = seen[star, :, 0] - np.einsum("jik,mik->jm", measured, w)
        assert np.abs(left).max() < 1e-10


def test_the_mean_is_the_plain_mean() -> None:
    s = scenario(BESIDE)
    assert np.array_equal(lgs_weights(s), np.tile(np.eye(9)[:, None] / 4, (1, 4, 1)))
    assert lgs_noise_rms(s, 3) == pytest.approx(0.01) and measurement_noise(s, 3)[0] == lgs_noise_rms(s, 3)


def test_weights_follow_the_settings() -> None:
    s = scenario(BEST)
    before = lgs_weights(s).copy()
    s.sensors.lgs_noise = 0.5
    assert not np.allclose(lgs_weights(s), before)
    s.sensors.lgs_noise = 0.02
    assert np.array_equal(lgs_weights(s), before)


def test_it_is_never_worse_than_the_mean() -> None:
    """Error, noise and what of the vibration is lost, together."""
    blind, single = {"sensors.tip_tilt_indetermination": True}, {"turbulence.source": "ar2"}
    for changes in ({}, BESIDE, {"sensors.lgs_radius": 60.0}, single, blind):
        s = scenario(changes)
        for i in range(len(s.modes)):
            both = []
            for one in (s, s.replace(BEST)):
                kept = lgs_weights(one)[i].sum(axis=0)[i]
                left = (1 - kept) ** 2 * vibration_variance(one, i)
                both.append(lgs_error_variance(one, i) + lgs_noise_rms(one, i) ** 2 + left)
            assert both[1] <= both[0] * (1 + 1e-9)


def test_stars_that_are_alike_weigh_alike() -> None:
    found = lgs_weights(scenario(BEST))  # two on the axis
    assert np.allclose(found[:, 0], found[:, 1]) and found[0, 0, 0] == pytest.approx(0.51, abs=0.005)
    noiseless = lgs_weights(scenario(BEST, {"sensors.lgs_noise": 0.0}))
    assert np.allclose(noiseless[:, 0], noiseless[:, 1]) and np.abs(noiseless).max() < 1.0


def test_the_loop_sees_its_own_commands_in_full() -> None:
    """z is the open-loop measurement whatever the weights, and the record goes through every filter."""
    short = {"run.duration": 0.3, "run.warm_up": 0.1, "gpr_offline.training_size": 20, "gpr_offline.depth": 10}
    s = scenario(BESIDE, BEST, short)
    record = simulate(s)
    assert record.open_loop_y is not None and np.allclose(record.z, record.open_loop_y, atol=1e-12)
    result = observe(record, s, observers=["kf-lgs", "multirate", "multirate-optimal"])
    assert not result.failures and len(result.estimates) == 5


def test_blind_stars_tell_tip_from_higher_modes() -> None:
    """Without tip and tilt from the LGS, their coma and astigmatism beside the axis still say something of it."""
    s = scenario(BESIDE, {"sensors.tip_tilt_indetermination": True})
    mean, best = lgs_error_variance(s, 0), lgs_error_variance(s.replace(BEST), 0)
    assert mean == pytest.approx(0.5293**2, rel=1e-3) and best < 0.9 * mean
    assert lgs_error_process(s, 0, 1e-3).rms == pytest.approx(0.5293, rel=1e-3)
