"""The regression with late targets, and the prediction built on it, against a Gaussian process solved anew at every step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.control.controllers import gpr_online_ahead, of_z
from wfsobs.control.mirror import Mirror, Plant
from wfsobs.observers.baselines import online_reference
from wfsobs.observers.gpr.sliding_regression import LateRegression
from wfsobs.observers.gpr.windows import SquaredExponential, scale_of, window_signals
from wfsobs.prior import Prior
from wfsobs.priors_from.scenario import bands_of
from wfsobs.progress import QUIET
from wfsobs.record import Record, Training
from wfsobs.scenario import Scenario
from wfsobs.typing import Array


def plain_prediction(z: Array, targets: Array, k: int, depth: int, m: int, late: int, kernel: SquaredExponential) -> float:
    """Textbook mean at step k from those of the windows k - m ... k - 1 whose targets are known, up to k - 1 - late."""
    windows = np.array([z[j - depth + 1 : j + 1] for j in (*range(k - m, k - late), k)])
    distance2 = ((windows[:, None] - windows[None]) ** 2).sum(axis=2)
    K = kernel.variance * np.exp(-0.5 * distance2 / kernel.length_scale**2)
    train = K[:-1, :-1] + kernel.noise_std**2 * np.eye(m - late)
    return float(K[-1, :-1] @ np.linalg.solve(train, targets[k - m : k - late]))


@settings(max_examples=15, deadline=None, derandomize=True)
@given(depth=st.integers(1, 6), m=st.integers(2, 12), late=st.integers(0, 4), seed=st.integers(0, 2**31))
def test_it_is_the_process_without_the_points_that_have_no_target_yet(depth: int, m: int, late: int, seed: int) -> None:
    late = min(late, m - 1)
    rng = np.random.default_rng(seed)
    z, targets = rng.standard_normal((2, 60))
    kernel = SquaredExponential(1.5, 3.0, 0.3)
    regression = LateRegression(depth, m, 1, kernel, late)
    for k in range(60):
        (value,) = regression.predict(z[k : k + 1, None], targets[[max(k - 1 - late, 0)]])
        regression.update()
        if k < depth + m - 1:
            assert np.isnan(value)
        else:
            # condition number up to 2.25 m / 0.09 = 300: nine digits are left with room
            assert value == pytest.approx(plain_prediction(z, targets, k, depth, m, late, kernel), rel=1e-9, abs=1e-9)


def test_one_without_a_known_target_is_refused() -> None:
    with pytest.raises(ValueError, match="training size 3"):
        LateRegression(2, 3, 1, SquaredExponential(1.0, 1.0, 0.1), 3)


@pytest.mark.parametrize(
    ("delay", "inputs"), [(1.0, "raw"), (2.0, "raw"), (2.5, "raw"), (3.0, "raw"), (2.0, "high-pass"), (2.0, "standardised")]
)
def test_the_vibration_is_predicted_for_the_time_that_the_command_acts(delay: float, inputs: str) -> None:
    """Window j learns sum_i taps[i] f[j + i], f the causal bank on z, once that is known."""
    depth, m, n = 4, 9, 80
    scenario = Scenario().replace(
        {
            "gpr_online.depth": depth,
            "gpr_online.training_size": m,
            "gpr_online.length_scale": 3.0,
            "gpr_online.signal_std": 1.0,
            "gpr_online.inputs_filter": inputs,
        }
    )
    rng = np.random.default_rng(5)
    z, nothing = rng.standard_normal((n, 2)), np.zeros((n, 2))
    f = online_reference(bands_of(scenario), z, scenario.dt)
    taps = Mirror(delay).taps
    late = taps.size - 2
    targets = np.array([taps[1:] @ f[j + 1 : j + taps.size] for j in range(n - taps.size)])
    training = Training(0.1 + 0.7 * rng.standard_normal((n, 2)), nothing)
    prior = Prior(bands=bands_of(scenario), training=training)
    plant = Plant(Mirror(delay), scenario.dt, 5)
    values = gpr_online_ahead(Record(z, nothing, scenario.dt).measurements(), prior, plant, scenario, QUIET)
    kernel = SquaredExponential(1.0, 3.0, scenario.gpr_online.noise_std)
    for mode in range(2):
        scale = scale_of(of_z(scenario.gpr_online), training, 2, mode)
        seen = window_signals(of_z(scenario.gpr_online), nothing, nothing, z, mode, scenario.dt, scale)[:, 0]
        assert np.isnan(values[: depth + m - 1, mode]).all()
        for k in range(depth + m - 1, n - taps.size):
            expected = plain_prediction(seen, targets[:, mode], k, depth, m, late, kernel)
            assert values[k, mode] == pytest.approx(expected, rel=1e-8, abs=1e-9 * np.abs(targets).max())
