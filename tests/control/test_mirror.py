"""The mirror: delay as a plain sum, response, limits."""

from __future__ import annotations

from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from wfsobs.control.mirror import Mirror
from wfsobs.priors_from.controllers import plant_of
from wfsobs.record import delay_signal
from wfsobs.scenario import Scenario

delays = st.floats(1.0, 10.0) | st.integers(1, 10).map(float)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(delays, st.integers(0, 2**31))
def test_a_command_acts_for_one_frame_after_its_delay(delay: float, seed: int) -> None:
    u = np.random.default_rng(seed).standard_normal((50, 2))
    n, f = int(delay), delay - int(delay)
    mirror = Mirror(delay)
    assert mirror.taps.sum() == pytest.approx(1.0) and mirror.taps[0] == 0.0
    expected = (1 - f) * delay_signal(u, n - 1) + f * delay_signal(u, n)
    assert np.allclose(mirror.correction(u), expected, rtol=0, atol=1e-14)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(delays, st.floats(0.0, np.pi))
def test_the_response_is_that_of_a_sine(delay: float, omega: float) -> None:
    mirror, k = Mirror(delay), np.arange(200)
    out = lfilter(mirror.taps, [1.0], np.exp(1j * omega * k))
    assert out[50] * np.exp(-50j * omega) == pytest.approx(complex(mirror.response(np.array([omega]))[0]), abs=1e-12)


def test_the_paper_s_mirror_is_one_step_late() -> None:
    u = np.arange(1.0, 6.0)
    assert plant_of(Scenario()).mirror.correction(u).tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert not plant_of(Scenario()).mirror.has_limits


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.floats(0.1, 5.0), st.floats(0.05, 3.0), st.integers(0, 2**31))
def test_commands_keep_the_limits_and_go_as_far_as_they_allow(stroke: float, slew: float, seed: int) -> None:
    wanted = 2.0 * np.random.default_rng(seed).standard_normal(60)
    mirror = Mirror(2.0, stroke, slew)
    u = np.array(list(accumulate(wanted, lambda last, one: mirror.clip_commands(one, last), initial=0.0)))[1:]
    assert mirror.within(u * (1 - 1e-12))
    last = np.concatenate([[0.0], u[:-1]])
    low, high = np.maximum(last - slew, -stroke), np.minimum(last + slew, stroke)
    assert np.allclose(u, np.clip(wanted, low, high), rtol=0, atol=1e-12)
    free = Mirror(2.0, 100.0, 100.0)
    assert free.within(wanted) and free.clip_commands(wanted, np.zeros(60)).tolist() == wanted.tolist()


def test_the_rate_is_given_per_millisecond() -> None:
    scenario = Scenario().replace({"control.rate": 0.2, "control.stroke": 3.0, "sensors.lgs_rate": 500.0})
    assert plant_of(scenario).mirror.slew == pytest.approx(0.4) and plant_of(scenario).mirror.stroke == 3.0
