"""What goes out when something is wrong."""

import numpy as np
import pytest

from wfsobs.streams.watchdog import BEYOND, LEAST, PACE, SIGMAS, Gate, Safety, Watchdog

NONE = np.full(2, np.nan)
ESTIMATE, Z = np.array([0.3, -0.2]), np.zeros(2)


def watchdog(said: list[str], warm_up: int = 0, **limits) -> Watchdog:
    return Watchdog(np.ones(2), Safety(**{"missing": 3, "calm": 5, **limits}), said.append, warm_up)


def good(dog: Watchdog, missing: int = 0) -> np.ndarray:
    return dog.output(ESTIMATE, Z, 0, missing).copy()


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
        np.testing.assert_array_equal(dog.output(estimate, Z, 0, missing), safe)
    assert said == [f"{reason}: output falls back to {fallback}"] and dog.trips == 1
    other = -ESTIMATE
    for _ in range(4):
        np.testing.assert_array_equal(dog.output(other, Z, 0, 0), safe)
    np.testing.assert_array_equal(dog.output(other, Z, 0, 0), other)
    assert said[1:] == ["output on again after 5 good frames"] and not dog.reason


def test_as_much_as_is_allowed_is_no_fault() -> None:
    said: list[str] = []
    dog = watchdog(said)
    good(dog, missing=3)
    dog.output(np.array([1.0, -1.0]), Z, 0, 0)
    assert not said


def test_an_estimate_out_of_its_band_falls_back_and_single_errors_do_not() -> None:
    said: list[str] = []
    dog = watchdog(said)
    for beyond in range(BEYOND):
        np.testing.assert_array_equal(dog.output(ESTIMATE, Z, beyond, 0), ESTIMATE)
    assert not said and not dog.output(ESTIMATE, Z, BEYOND, 0).any()
    assert said[0].startswith("the estimate left its band")


def test_what_is_held_is_of_a_frame_in_its_band() -> None:
    dog = watchdog([], fallback="hold")
    good(dog)
    for beyond in range(1, BEYOND):
        np.testing.assert_array_equal(dog.output(2.0 * ESTIMATE, Z, beyond, 0), 2.0 * ESTIMATE)
    np.testing.assert_array_equal(dog.output(2.0 * ESTIMATE, Z, BEYOND, 0), ESTIMATE)


BAND = np.array([0.1, 0.2])
"""Deviations that a filter states of a prediction of 0.3 in both modes."""


def accept(gate: Gate, z: np.ndarray, mean: np.ndarray, sd: np.ndarray) -> np.ndarray:
    gate.mean, gate.sd = mean, sd
    return gate.accept(z)


def gate() -> Gate:
    """A gate that has followed good errors until the deviations that they show are below those that are stated."""
    made = Gate(np.ones(2), np.full(2, 10.0))
    for _ in range(round(np.log(1.0 / 0.05) / PACE)):
        accept(made, np.full(2, 0.3), np.full(2, 0.3), BAND)
    return made


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_six_deviations_are_a_measurement_and_more_is_none(factor: float) -> None:
    """Each mode by itself."""
    z = 0.3 + np.array([factor, 0.0]) * SIGMAS * BAND
    made = gate()
    got = accept(made, z, np.full(2, 0.3), BAND)
    np.testing.assert_array_equal(got, z if factor < 1 else [np.nan, 0.3])
    assert made.beyond.tolist() == [factor > 1, 0]


def test_a_level_that_has_moved_is_taken_after_five_and_numbers_that_no_estimate_may_have_never_are() -> None:
    for level, is_taken in ((8.0, True), (-15.9, True), (16.1, False), (1e300, False), (-np.inf, False)):
        made, mean = gate(), np.full(2, 0.3)
        got = [accept(made, np.full(2, level), mean, BAND) for _ in range(2 * BEYOND)]
        assert np.isnan(got[: BEYOND - 1]).all() and (np.array(got[BEYOND - 1 :]) == level).all() == is_taken
        assert made.beyond.tolist() == [2 * BEYOND] * 2
        np.testing.assert_array_equal(accept(made, mean, mean, BAND), mean)
        assert not made.beyond.any()


def test_what_is_missing_says_nothing() -> None:
    made = gate()
    for z in (np.full(2, 5.0), NONE, NONE, np.full(2, 5.0)):
        assert np.isnan(accept(made, z, np.full(2, 0.3), BAND)).all()
    assert made.beyond.tolist() == [2, 2]


def test_without_a_stated_deviation_that_of_the_errors_stands() -> None:
    """Gaussian errors of 0.07: the running median is that of them to 11 % (its variance is PACE / 1.7 of its square)."""
    errors = 3000
    made, rng = Gate(np.ones(2), np.full(2, 10.0)), np.random.default_rng(1)
    z = rng.normal(0.0, 0.07, (errors, 2))
    taken = np.array([accept(made, row, np.zeros(2), NONE) for row in z])
    np.testing.assert_array_equal(taken, z)
    np.testing.assert_allclose(made._deviation, 0.07, rtol=0.4)  # four of its standard deviations
    assert np.isnan(accept(made, np.full(2, 0.07 * 9), np.zeros(2), NONE)).all()
    for _ in range(errors):
        accept(made, np.zeros(2), np.zeros(2), NONE)
    np.testing.assert_allclose(made._deviation, LEAST)
    made.restart()
    np.testing.assert_array_equal(made._deviation, 1.0)


def test_nothing_is_sent_before_the_observer_has_seen_enough() -> None:
    said: list[str] = []
    dog = watchdog(said, warm_up=3)
    for _ in range(2):
        assert not good(dog).any()
    np.testing.assert_array_equal(good(dog), ESTIMATE)
    assert said == ["output on, of estimates up to 1, 1 um"] and dog.trips == 0
