"""Alarms of a live loop: told once when something changes, once when it is over."""

import numpy as np
import pytest

from wfsobs.live.alarms import FEWEST, Alarms, drift, noise_of
from wfsobs.live.board import SLOTS
from wfsobs.live.crew import slot_width, trace_width
from wfsobs.live.finding import Finding, PeakFinding
from wfsobs.live.ring import LiveFrame
from wfsobs.live.view import LiveView


def second(noise, error=0.01, missing=0, seed=1):
    """Make a second of noise, of which an observer is off by another noise."""
    rng = np.random.default_rng(seed)
    z = noise * rng.normal(size=(1000, 2))
    z[:missing] = np.nan
    traces = np.full((1000, trace_width(2)), np.nan)
    traces[:, 0] = np.arange(1000)
    at = 3 + SLOTS.index("kf-multi") * slot_width(2)
    traces[:, at : at + 2], traces[:, at + 2 : at + 4] = np.roll(z, -1, axis=0) + error * rng.normal(size=(1000, 2)), 0.0
    nothing = np.full((1000, 2), np.nan)
    return LiveView(0, 1e-3, LiveFrame(np.zeros(1000), z, nothing, nothing, nothing, nothing), traces)


def test_noise_is_that_of_third_differences():
    rng, t = np.random.default_rng(2), np.arange(20_000) * 1e-3
    z = 0.3 * np.sin(2 * np.pi * 2.0 * t)[:, None] + 0.02 * rng.normal(size=(20_000, 2))
    # third differences of 40 000 samples: relative standard deviation of the rms below 1 %, 5 of them
    assert noise_of(z) == pytest.approx(0.02, rel=0.05)


def test_an_alarm_is_told_once_and_when_it_is_over():
    said = []
    alarms = Alarms(said.append)
    for k in range(FEWEST + 2):
        alarms.look_at(second(0.02, seed=k), ["kf-multi"])
    assert said == []
    for k in range(3):
        alarms.look_at(second(0.05, seed=k), ["kf-multi"])
    assert len(said) == 1 and said[0].startswith("ALARM noise up: ")
    alarms.look_at(second(0.02, error=0.05), ["kf-multi"])
    alarms.look_at(second(0.02, missing=100), ["kf-multi"])
    alarms.look_at(second(0.02), ["kf-multi"])
    kinds = [line.split(":")[0] if line.startswith(("ALARM e", "ALARM n")) else line for line in said]
    assert kinds == [
        "ALARM noise up",
        "over: noise",
        "ALARM error of kf-multi up",
        "ALARM 10.0% of frames missing",
        "over: error of kf-multi",
        "over: frames missing",
    ]


def test_peaks_that_are_new_have_moved_or_are_gone():
    def peak(f, std=0.01):
        return PeakFinding(f, std, 0.01, 0.02)

    assert drift([peak(10), peak(47)], [peak(10.02), peak(47.05)]) == []
    assert drift([peak(10), peak(47)], [peak(10.5), peak(30)]) == [
        "peak moved from 10.00 to 10.50 Hz",
        "new peak at 30.00 Hz, 20.0 nm",
        "peak at 47.00 Hz is gone",
    ]
    said = []
    alarms = Alarms(said.append)
    alarms.compare(Finding((peak(10),), (0.02,), {}))
    alarms.compare(Finding((peak(10), peak(20)), (0.02,), {}))
    assert said == ["ALARM new peak at 20.00 Hz, 20.0 nm"]
