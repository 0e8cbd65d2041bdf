"""Alarms of a live loop: told once when something changes, once when it is over."""

import numpy as np
import pytest

from wfsobs.live.alarms import FEWEST, Alarms, distinct_peaks, drift, noise_of
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
    alarms = Alarms(said.append)
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
        "ALARM 10.0% of LGS frames missing",
        "over: error of kf-multi",
        "over: LGS frames missing",
    ]


def test_ngs_frames_that_were_due_are_missing():
    said = []
    alarms = Alarms(said.append)
    ngs = np.full((1000, 2), np.nan)
    ngs[3::10] = 0.1  # the first frame has the number 7
    for lost in (0, 2, 0):
        frames = LiveFrame(np.zeros(1000), np.zeros((1000, 2)), ngs.copy(), *[np.zeros((1000, 2))] * 3)
        frames.ngs[3 : 3 + 10 * lost : 10] = np.nan
        alarms.look_at(frames, 7, 10)
        alarms.look_at(frames, 7, None)  # no NGS: none is due
    assert said == ["ALARM 2.0% of NGS frames missing", "over: NGS frames missing"]
    first = LiveFrame(np.zeros(10), np.zeros((10, 2)), np.full((10, 2), np.nan), *[np.zeros((10, 2))] * 3)
    alarms.look_at(first, 0, 10)  # none is due with the first frame of all
    assert len(said) == 2


def test_what_varies_from_second_to_second_may_vary():
    """After errors of 1, 2 and 3 in turn one of 4 is usual; after 2 alone it is an alarm."""
    for errors, is_alarm in (([0.01, 0.02, 0.03] * 7, False), ([0.02] * 21, True)):
        said = []
        alarms = Alarms(said.append)
        for k, error in enumerate([*errors, 0.04]):
            alarms.judge(second(1e-6, error=error, seed=k), ["kf-multi"])
        assert bool(said) == is_alarm


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


def minutes(*peaks_of_each):
    """Return the alarms of minutes, each of (frequency [Hz], rms [um])."""
    said, out = [], []
    alarms = Alarms(said.append)
    for peaks in peaks_of_each:
        alarms.compare(Finding(tuple(PeakFinding(f, 0.01, 0.0, rms) for f, rms in peaks), (0.02,), {}))
        out.append([line.removeprefix("ALARM ") for line in said])
        said.clear()
    return out


@pytest.mark.parametrize("share", [0.03, 0.5, 0.97])
def test_a_line_that_moves_in_the_midst_of_a_minute_has_moved(share):
    """That minute has a part of it at either frequency, the power in the ratio of the times."""
    before, after, others = (47.5, 0.03), (50.5, 0.03), [(10.0, 0.01), (60.0, 0.01)]
    between = [(47.5, 0.03 * share**0.5), (50.5, 0.03 * (1 - share) ** 0.5)]
    assert minutes([*others, before], [*others, *between], [*others, after], [*others, after]) == [
        [],
        [f"new peak at 50.50 Hz, {30 * (1 - share) ** 0.5:.1f} nm"],
        ["peak moved from 47.50 to 50.50 Hz"],
        [],
    ]


def test_what_a_jump_leaves_between_is_not_where_it_has_gone():
    """A broad peak of a few nm between the two places, in the minute of the jump, is nearer and of another size."""
    before, between, after = (47.5, 0.03), (49.0, 0.0045), (50.5, 0.03)
    assert minutes([before], [between, after], [after]) == [
        [],
        ["new peak at 49.00 Hz, 4.5 nm", "peak moved from 47.50 to 50.50 Hz"],
        ["peak at 49.00 Hz is gone"],
    ]
    assert minutes([before], [before, between], [after])[2] == [
        "peak moved from 47.50 to 50.50 Hz",
        "peak at 49.00 Hz is gone",
    ]


def test_a_peak_that_goes_beside_another_has_not_moved_to_it():
    pair, new, gone = [(47.5, 0.03), (50.5, 0.03)], "new peak at 50.50 Hz, 30.0 nm", "peak at 47.50 Hz is gone"
    # both were there before; the other came long ago; it is of another size; it is too far
    assert minutes(pair, pair, pair[1:]) == [[], [], [gone]]
    assert minutes(pair[:1], pair, pair, pair[1:]) == [[], [new], [], [gone]]
    assert minutes([(47.5, 0.01)], [(47.5, 0.01), pair[1]], pair[1:]) == [[], [new], [gone]]
    assert minutes(pair[:1], [pair[0], (60.0, 0.03)], [(60.0, 0.03)])[2] == [gone]
    # nothing is known of the minute before
    assert minutes(pair, pair[1:]) == [[], [gone]]


def test_a_line_in_pieces_is_one_peak_and_a_faint_one_is_none():
    pieces = (PeakFinding(50.43, 0.006, 0.0, 3e-3), PeakFinding(50.51, 0.001, 0.0, 3e-2), PeakFinding(50.49, 0.01, 1e-4, 1e-2))
    others = (PeakFinding(17.2, 0.06, 0.01, 3e-3), PeakFinding(15.7, 0.01, 0.0, 2e-4))
    found = distinct_peaks(Finding((*pieces, *others), (0.02, 0.01), {}))
    power = np.array([9.0, 900.0, 100.0])
    middle = float(power @ [50.43, 50.51, 50.49]) / power.sum()
    assert [peak.rms for peak in found] == [3e-3, 3e-2]  # a tenth of the noise of 20 nm is 2 nm
    assert found[1].frequency == pytest.approx(middle, rel=1e-12)
    own = np.array([0.006, 0.001, 0.01]) ** 2 + (np.array([50.43, 50.51, 50.49]) - middle) ** 2
    assert found[1].frequency_std == pytest.approx(np.sqrt(power @ own / power.sum()), rel=1e-12)
    assert drift([PeakFinding(50.5, 1e-4, 0.0, 3e-2)], found[1:]) == []  # a minute does not resolve the difference
    assert drift([PeakFinding(47.5, 1e-4, 0.0, 3e-2)], found[1:]) == ["peak moved from 47.50 to 50.51 Hz"]
