"""Errors of fixed observers under the true spectra: Riccati covariances, closed forms, and twenty records."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest

from tests.records import MATCHED
from wfsobs.evaluation.bound import bound_rms
from wfsobs.evaluation.exact_errors import exact_errors
from wfsobs.execution import run_observer
from wfsobs.observers import OBSERVERS
from wfsobs.observers.kalman.filters import optimal_model
from wfsobs.prior import LgsError, Model
from wfsobs.priors_from.scenario import lgs_error_of, model_of, prior_of
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.gains import periodic_steady_state
from wfsobs.simulation.loop import simulate


@pytest.mark.parametrize("name", ["multirate-optimal", "multirate-multi"])
def test_where_the_truth_is_the_model_it_is_the_covariance_and_the_bound(name: str) -> None:
    ratio = MATCHED.sensors.exposure_ratio
    found = exact_errors(OBSERVERS[name], MATCHED)
    for mode, errors in enumerate(found):
        model = optimal_model(MATCHED.multirate, prior_of(MATCHED, None, (Model, LgsError)), mode, ratio)
        steps, rows = model.steps, model.filter().rows(("turbulence", "vibration"))
        states = periodic_steady_state(steps)
        for target, row in (("turbulence", rows[0]), ("vibration", rows[1]), ("total", rows.sum(axis=0))):
            # The frame is at the last step of the cycle, so that step j is j steps after one.
            expected = [sqrt(row @ states[(p - 1) % ratio].posterior @ row) for p in range(ratio)]
            # what the slowest correlations have left after half the DFT, exp(-10)
            assert errors[target].phases == pytest.approx(expected, rel=1e-5), (mode, target)
        for target, least in bound_rms(MATCHED, mode, information="both").items():
            assert 1.0 - 1e-5 < errors[target].rms / least < 1.0001, "the bound is met to what its search leaves"


def test_persistence_leaves_one_step_of_turbulence_and_all_that_is_not_turbulence() -> None:
    turbulence, vibration = model_of(MATCHED, 0).turbulence, model_of(MATCHED, 0).vibration
    noise, slow = model_of(MATCHED, 0).lgs_noise, lgs_error_of(MATCHED, 0).process
    r = turbulence.autocovariance(2)
    expected = 2.0 * (r[0] - r[1]) + vibration.rms**2 + slow.rms**2 + noise**2
    (found, _) = exact_errors(OBSERVERS["persistence"], MATCHED)
    # r[0] - r[1] is a small difference of two sums over the DFT
    assert found["turbulence"].variance == pytest.approx(np.full(5, expected), rel=1e-6)


def test_of_no_estimate_all_is_left_lines_included() -> None:
    lines = [{"frequency": 31.234, "damping": 0.0, "rms": [0.04, 0.0]}, {"frequency": 17.0, "damping": 0.02, "rms": [0.03, 0.02]}]
    scenario = MATCHED.replace({"vibration.source": "peaks", "vibration.cutoff": 100.0, "vibration.peaks": lines})
    (tip, tilt) = exact_errors(OBSERVERS["zero"], scenario)
    # of a resonance up to 100 Hz; above it has 1e-5 of its power
    assert tip["vibration"].rms == pytest.approx(0.05, rel=1e-3) and tilt["vibration"].rms == pytest.approx(0.02, rel=1e-3)


def test_a_line_is_left_as_the_filter_passes_it() -> None:
    """A pure line far from what the filter follows stays in the estimate of the turbulence as its gain there."""
    lines = [{"frequency": 100.0, "damping": 0.0, "rms": [0.04]}]
    with_line = MATCHED.replace({"vibration.source": "peaks", "vibration.cutoff": 120.0, "vibration.peaks": lines})
    without = with_line.replace({"vibration.source": "none"})
    (one, *_), (other, *_) = (exact_errors(OBSERVERS["persistence"], s) for s in (with_line, without))
    added = one["turbulence"].variance - other["turbulence"].variance
    # persistence takes the whole line for turbulence; the rest is the same: rounding
    assert added == pytest.approx(np.full(5, 0.04**2), rel=1e-9)


@pytest.mark.slow
def test_records_confirm_it() -> None:
    """Twenty records of 10 s, most models wrong: mean square errors within three of their standard errors."""
    scenario = PRESETS["paper"]().replace({"vibration.synthesis": "gaussian", "loop.closed": False})
    names = ("multirate-multi", "multirate-optimal", "kf-lgs", "kf-ngs")
    expected = {name: exact_errors(OBSERVERS[name], scenario) for name in names}
    squares: dict[tuple[str, int, str], list[float]] = {}
    for seed in range(1, 21):
        record = simulate(scenario.replace({"run.seed": seed}))
        for name in names:
            for target, values in run_observer(name, record, scenario).items():
                truth = record.truth(target)
                assert truth is not None
                for mode in range(2):
                    error = (values - truth)[4000:, mode]
                    squares.setdefault((name, mode, target), []).append(float(np.mean(error**2)))
    for (name, mode, target), found in squares.items():
        standard_error = np.std(found, ddof=1) / sqrt(len(found))
        assert abs(np.mean(found) - expected[name][mode][target].rms ** 2) < 3.0 * standard_error, (name, mode, target)


@pytest.mark.parametrize("name", ["gpr-online", "butterworth-ol", "ridge", "kf-coupled"])
def test_no_other_observer_has_one(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}: the exact error is that of"):
        exact_errors(OBSERVERS[name], MATCHED)
