"""Alarms of a live loop: told once when something changes, once when it is over."""

import numpy as np
import pytest

from tests.live.in_process import keep_lines
from wfsobs.live.board import SLOTS, LiveView, slot_width, trace_width
from wfsobs.live.loop import FEWEST, Alarms, noise_of
from wfsobs.live.ring import LiveFrame


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


def look(alarms, one, first=0, ratio=None):
    """Have a second judged, its frames and its observer."""
    alarms.look_at(one.frames, first, ratio)
    alarms.judge(one, ["kf-multi"])


def test_noise_is_that_of_third_differences():
    rng, t = np.random.default_rng(2), np.arange(20_000) * 1e-3
    z = 0.3 * np.sin(2 * np.pi * 2.0 * t)[:, None] + 0.02 * rng.normal(size=(20_000, 2))
    # third differences of 40 000 samples: relative standard deviation of the rms below 1 %, 5 of them
    assert noise_of(z) == pytest.approx(0.02, rel=0.05)


def test_an_alarm_is_told_once_and_when_it_is_over():
    said = []
    alarms = Alarms(keep_lines(said))
    for k in range(FEWEST + 2):
        look(alarms, second(0.02, seed=k))
    assert said == []
    for k in range(3):
        look(alarms, second(0.05, seed=k))
    assert len(said) == 1 and said[0].startswith("ALARM noise up: ")
    look(alarms, second(0.02, error=0.05))
    look(alarms, second(0.02, missing=100))
    look(alarms, second(0.02))
    kinds = [line.split(":")[0] if line.startswith(("ALARM e", "ALARM n")) else line for line in said]
    assert kinds == [
        "ALARM noise up",
        "over: noise",
        "ALARM error of kf-multi up",
        "ALARM 10.0 % of LGS frames missing",
        "over: error of kf-multi",
        "over: LGS frames missing",
    ]


def test_ngs_frames_that_were_due_are_missing():
    said = []
    alarms = Alarms(keep_lines(said))
    ngs = np.full((1000, 2), np.nan)
    ngs[3::10] = 0.1  # the first frame has the number 7
    for lost in (0, 2, 0):
        frames = LiveFrame(np.zeros(1000), np.zeros((1000, 2)), ngs.copy(), *[np.zeros((1000, 2))] * 3)
        frames.ngs[3 : 3 + 10 * lost : 10] = np.nan
        alarms.look_at(frames, 7, 10)
        alarms.look_at(frames, 7, None)  # no NGS: none is due
    assert said == ["ALARM 2.0 % of NGS frames missing", "over: NGS frames missing"]
    first = LiveFrame(np.zeros(10), np.zeros((10, 2)), np.full((10, 2), np.nan), *[np.zeros((10, 2))] * 3)
    alarms.look_at(first, 0, 10)  # none is due with the first frame of all
    assert len(said) == 2


def test_what_varies_from_second_to_second_may_vary():
    """After errors of 1, 2 and 3 in turn one of 4 is usual; after 2 alone it is an alarm."""
    for errors, is_alarm in (([0.01, 0.02, 0.03] * 7, False), ([0.02] * 21, True)):
        said = []
        alarms = Alarms(keep_lines(said))
        for k, error in enumerate([*errors, 0.04]):
            alarms.judge(second(1e-6, error=error, seed=k), ["kf-multi"])
        assert bool(said) == is_alarm
