"""What goes out when something is wrong."""

import numpy as np
import pytest

from wfsobs.streams.watchdog import BEYOND, SIGMAS, Safety, Watchdog

NONE = np.full(2, np.nan)
ESTIMATE = np.array([0.3, -0.2])


def watchdog(said: list[str], warm_up: int = 0, **limits) -> Watchdog:
    return Watchdog(2, Safety(**{"largest": 1.0, "missing": 3, "calm": 5, **limits}), said.append, warm_up)


def good(dog: Watchdog, missing: int = 0) -> np.ndarray:
    return dog.output(ESTIMATE, np.array([0.1, 0.1]), np.array([0.1, 0.1]), missing).copy()


@pytest.mark.parametrize(
    ("estimate", "missing", "reason"),
    [
        (np.array([np.nan, 0.0]), 0, "the estimate is not finite"),
        (np.array([np.inf, 0.0]), 0, "the estimate is not finite"),
        (np.array([0.0, -1.01]), 0, "the estimate exceeds 1 um"),
        (ESTIMATE, 4, "4 frames in a row are missing"),
    ],
)
@pytest.mark.parametrize("fallback", ["zero", "hold"])
def test_a_fault_is_told_once_and_the_output_is_safe_until_all_is_calm(estimate, missing, reason, fallback) -> None:
    said: list[str] = []
    dog = watchdog(said, fallback=fallback)
    np.testing.assert_array_equal(good(dog), ESTIMATE)
    safe = ESTIMATE if fallback == "hold" else np.zeros(2)
    for _ in range(3):
        np.testing.assert_array_equal(dog.output(estimate, NONE, NONE, missing), safe)
    assert said == [f"{reason}: output falls back to {fallback}"] and dog.trips == 1
    other = -ESTIMATE
    for _ in range(4):
        np.testing.assert_array_equal(dog.output(other, NONE, NONE, 0), safe)
    np.testing.assert_array_equal(dog.output(other, NONE, NONE, 0), other)
    assert said[1:] == ["output on again after 5 good frames"] and not dog.reason


def test_as_much_as_is_allowed_is_no_fault() -> None:
    said: list[str] = []
    dog = watchdog(said)
    good(dog, missing=3)
    dog.output(np.array([1.0, -1.0]), NONE, NONE, 0)
    assert not said


def test_an_estimate_out_of_its_band_falls_back_and_single_errors_do_not() -> None:
    said: list[str] = []
    dog, band = watchdog(said), np.array([0.1, 0.2])
    for size in (0.99, 1.01):
        for k in range(4 * BEYOND):
            outside = np.array([0.0, SIGMAS * 0.2 * 1.01]) if k % BEYOND else np.zeros(2)
            dog.output(ESTIMATE, outside if size > 1 else band * SIGMAS * size, band, 0)
    assert not said
    good(dog)
    for _ in range(BEYOND):
        assert not said
        dog.output(ESTIMATE, np.array([0.0, SIGMAS * 0.2 * 1.01]), band, 0)
    assert said[0].startswith("the estimate left its band")


def test_nothing_is_sent_before_the_observer_has_seen_enough() -> None:
    said: list[str] = []
    dog = watchdog(said, warm_up=3)
    for _ in range(2):
        assert not good(dog).any()
    np.testing.assert_array_equal(good(dog), ESTIMATE)
    assert said == ["output on"] and dog.trips == 0
