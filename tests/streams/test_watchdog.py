"""What goes out when something is wrong."""

import numpy as np
import pytest

from wfsobs.signal.gate import RUN, GateSettings
from wfsobs.streams.follower import SafeGate
from wfsobs.streams.wiring import Safety, Watchdog, Wiring

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
    for beyond in range(RUN):
        np.testing.assert_array_equal(dog.output(ESTIMATE, Z, beyond, 0), ESTIMATE)
    assert not said and not dog.output(ESTIMATE, Z, RUN, 0).any()
    assert said[0].startswith("5 measurements in a row are outliers")


def test_what_is_held_is_of_a_frame_in_its_band() -> None:
    dog = watchdog([], fallback="hold")
    good(dog)
    for beyond in range(1, RUN):
        np.testing.assert_array_equal(dog.output(2.0 * ESTIMATE, Z, beyond, 0), 2.0 * ESTIMATE)
    np.testing.assert_array_equal(dog.output(2.0 * ESTIMATE, Z, RUN, 0), ESTIMATE)


def test_numbers_that_no_estimate_may_have_are_never_taken() -> None:
    """Largest estimate 10, rms 1: beyond 16, with a gate of outliers or without, also when it is open."""
    rng = np.random.default_rng(1)
    for settings in (None, GateSettings(), GateSettings(action="clip")):
        gate = SafeGate(Wiring((0, 1), 1.0, 1.0, np.ones(2), Safety(), gate=settings))
        for z in rng.standard_normal((300, 2)):
            gate.accept(z)
            gate.settle()
        for level, is_possible in ((15.9, True), (16.1, False), (1e300, False), (-np.inf, False)):
            before = gate.outliers.copy()
            taken = []
            for _ in range(2 * RUN):
                taken.append(gate.accept(np.full(2, level)))
                gate.settle()
            assert (np.array(taken[RUN:]) == level).all() == is_possible
            assert np.isnan(taken).all() != is_possible
            assert (gate.outliers - before >= (0 if is_possible else 2 * RUN)).all()
            gate.accept(np.full(2, np.nan))
            assert (gate.beyond == 0) == is_possible, "what is missing says nothing"


def test_nothing_is_sent_before_the_observer_has_seen_enough() -> None:
    said: list[str] = []
    dog = watchdog(said, warm_up=3)
    for _ in range(2):
        assert not good(dog).any()
    np.testing.assert_array_equal(good(dog), ESTIMATE)
    assert said == ["output on, of estimates up to 1, 1 um"] and dog.trips == 0
