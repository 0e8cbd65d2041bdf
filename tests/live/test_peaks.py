"""Peaks from one minute to the next: new, moved, gone, or only not found."""

from itertools import pairwise

import numpy as np
import pytest

from tests.live.in_process import keep_lines
from wfsobs.live.finding import Change, Finding, MinuteSpectrum, PeakFinding, distinct_peaks, has_risen, peak_changes, spectrum_of
from wfsobs.live.loop import Alarms

STEP, NOISE, DT = 1.0 / 60.0, 0.02, 1e-3
FREQUENCY = STEP * np.arange(1, 30_000)


def density_of(peaks, level=1.0):
    """Return the density of noise and peaks of (frequency [Hz], rms [um], damping), (n_bins,) [um^2/Hz]."""
    density = np.full(len(FREQUENCY), 2.0 * DT * NOISE**2 * level)
    for f, rms, damping in peaks:
        shape = 1.0 / (1.0 + ((FREQUENCY - f) / max(damping * f, STEP)) ** 2)
        density += rms**2 * shape / (STEP * shape.sum())
    return density


def minute(*there, found=None, level=1.0):
    """Return a minute: peaks that are `there`, each (frequency [Hz], rms [um]) or with a damping; those that are `found`."""
    there = [(*peak, 0.0)[:3] for peak in there]
    found = there if found is None else [(*peak, 0.0)[:3] for peak in found]
    peaks = tuple(PeakFinding(f, 0.01, damping, rms) for f, rms, damping in found)
    density = np.stack([density_of(there, level), density_of([], level)], axis=1)
    return Finding(peaks, (NOISE, NOISE), {}, MinuteSpectrum(STEP, density))


def told(*minutes):
    """Return the alarms of each minute."""
    said, out = [], []
    alarms = Alarms(keep_lines(said))
    for one in minutes:
        alarms.compare(one)
        out.append([line.removeprefix("ALARM ") for line in said])
        said.clear()
    return out


def test_peaks_that_are_new_have_moved_or_are_gone():
    before, quiet = minute((10, 0.02), (47, 0.02)), minute((10.02, 0.02), (47.05, 0.02))
    assert told(before, quiet) == [[], []]
    assert told(before, minute((10.5, 0.02), (30, 0.02)))[1] == [
        "peak moved from 10.00 to 10.50 Hz",
        "new peak at 30.00 Hz, 20.0 nm",
        "peak at 47.00 Hz is gone",
    ]
    assert told(minute((10, 0.02)), minute((10, 0.02), (20, 0.02))) == [[], ["new peak at 20.00 Hz, 20.0 nm"]]


def test_what_is_found_in_one_minute_and_not_in_the_next_is_neither_new_nor_gone():
    line, other = (19.0, 0.003), (47.0, 0.02)
    with_it, without = minute(line, other), minute(line, other, found=[other])
    assert told(with_it, without, with_it, without, without, without, with_it) == [[]] * 7
    # a minute that has not found it is no excuse for the next, in which it has gone
    assert told(with_it, without, minute(other)) == [[], [], ["peak at 19.00 Hz is gone"]]
    # what is found above the same floor is none that is new
    assert told(minute(other), minute(other, found=[other, (80.0, 0.003)])) == [[], []]


def test_a_rise_of_all_around_is_no_peak():
    """More wind, say: a peak that is found in it then has risen with it, and is not gone when it is over."""
    quiet, loud = minute((47.0, 0.02)), minute((47.0, 0.02), (30.0, 0.005), level=40.0)
    assert told(quiet, loud, quiet) == [[], [], []]
    assert told(quiet, minute((47.0, 0.02), (30.0, 0.1), level=40.0))[1] == ["new peak at 30.00 Hz, 100.0 nm"]


def test_nothing_is_told_where_too_much_is_missing():
    unknown = Finding((PeakFinding(20.0, 0.01, 0.0, 0.02),), (NOISE,), {})
    assert told(minute((10, 0.02)), unknown, minute((10, 0.02))) == [[], [], []]


@pytest.mark.slow
def test_chance_makes_no_peaks():
    """Densities of minutes are exponential about one spectrum. Nothing rises in 400 pairs, 3 peaks and 2 modes, at 1e-5 each."""
    rng = np.random.default_rng(1)
    peaks = [(17.2, 0.007, 0.013), (47.5, 0.005, 0.004), (90.0, 0.005, 0.02)]
    truth = density_of(peaks)[:, None] * np.ones(2)
    findings = tuple(PeakFinding(f, 0.03, damping, rms) for f, rms, damping in peaks)
    minutes = [
        Finding(findings, (NOISE,), {}, MinuteSpectrum(STEP, truth * rng.exponential(size=truth.shape))) for _ in range(401)
    ]
    pairs = [(peak, one, other) for one, other in pairwise(minutes) for peak in findings]
    assert not any(has_risen(*pair) for pair in pairs)
    # and the same minutes with ten times the power in the peaks have risen
    more = density_of([(f, 10**0.5 * rms, damping) for f, rms, damping in peaks])[:, None] * np.ones(2)
    risen = Finding(findings, (NOISE,), {}, MinuteSpectrum(STEP, more * rng.exponential(size=truth.shape)))
    assert [has_risen(peak, minutes[0], risen) for peak in findings] == [True] * 3


@pytest.mark.parametrize("share", [0.03, 0.5, 0.97])
def test_a_line_that_moves_in_the_midst_of_a_minute_has_moved(share):
    """That minute has a part of it at either frequency, the power in the ratio of the times."""
    before, after, others = (47.5, 0.03), (50.5, 0.03), [(10.0, 0.01), (60.0, 0.01)]
    between = [(47.5, 0.03 * share**0.5), (50.5, 0.03 * (1 - share) ** 0.5)]
    quiet = minute(*others, after)
    assert told(minute(*others, before), minute(*others, *between), quiet, quiet) == [
        [],
        [f"new peak at 50.50 Hz, {30 * (1 - share) ** 0.5:.1f} nm"],
        ["peak moved from 47.50 to 50.50 Hz"],
        [],
    ]


def test_what_a_jump_leaves_between_is_not_where_it_has_gone():
    """A broad peak of a few nm between the two places, in the minute of the jump, is nearer and of another size."""
    before, between, after = (47.5, 0.03), (49.0, 0.0045), (50.5, 0.03)
    assert told(minute(before), minute(between, after), minute(after)) == [
        [],
        ["new peak at 49.00 Hz, 4.5 nm", "peak moved from 47.50 to 50.50 Hz"],
        ["peak at 49.00 Hz is gone"],
    ]
    assert told(minute(before), minute(before, between), minute(after))[2] == [
        "peak moved from 47.50 to 50.50 Hz",
        "peak at 49.00 Hz is gone",
    ]


def test_a_peak_that_goes_beside_another_has_not_moved_to_it():
    pair, new, gone = [(47.5, 0.03), (50.5, 0.03)], "new peak at 50.50 Hz, 30.0 nm", "peak at 47.50 Hz is gone"
    # both were there before; the other came long ago; it is of another size; it is too far
    assert told(minute(*pair), minute(*pair), minute(pair[1])) == [[], [], [gone]]
    assert told(minute(pair[0]), minute(*pair), minute(*pair), minute(pair[1])) == [[], [new], [], [gone]]
    assert told(minute((47.5, 0.01)), minute((47.5, 0.01), pair[1]), minute(pair[1])) == [[], [new], [gone]]
    assert told(minute(pair[0]), minute(pair[0], (60.0, 0.03)), minute((60.0, 0.03)))[2] == [gone]
    # nothing is known of the minute before
    assert told(minute(*pair), minute(pair[1])) == [[], [gone]]


def test_a_line_in_pieces_is_one_peak_and_a_faint_one_is_none():
    pieces = (PeakFinding(50.43, 0.006, 0.0, 3e-3), PeakFinding(50.51, 0.001, 0.0, 3e-2), PeakFinding(50.49, 0.01, 1e-4, 1e-2))
    others = (PeakFinding(17.2, 0.06, 0.01, 3e-3), PeakFinding(15.7, 0.01, 0.0, 2e-4))
    whole = Finding((*pieces, *others), (0.02, 0.01), {}, minute((50.51, 3e-2), (17.2, 3e-3)).spectrum)
    found = distinct_peaks(whole)
    power = np.array([9.0, 900.0, 100.0])
    middle = float(power @ [50.43, 50.51, 50.49]) / power.sum()
    assert [peak.rms for peak in found] == [3e-3, 3e-2]  # a tenth of the noise of 20 nm is 2 nm
    assert found[1].frequency == pytest.approx(middle, rel=1e-12)
    own = np.array([0.006, 0.001, 0.01]) ** 2 + (np.array([50.43, 50.51, 50.49]) - middle) ** 2
    assert found[1].frequency_std == pytest.approx(np.sqrt(power @ own / power.sum()), rel=1e-12)
    other = (17.2, 3e-3)
    assert peak_changes([minute(other, (50.5, 3e-2)), whole]) == []  # a minute does not resolve the difference
    assert peak_changes([minute(other, (47.5, 3e-2)), whole]) == [("peak moved from 47.50 to 50.51 Hz", "")]


def test_what_is_known_of_the_first_minute():
    change = Change([minute((10, 0.02))])
    assert [peak.frequency for peak in change.peaks] == [10] and not change.same and not change.new and not change.losses


def test_the_power_of_a_line_and_the_level_around_it():
    n, rng = 60_000, np.random.default_rng(2)
    t = DT * np.arange(n)
    z = np.stack([0.03 * np.sqrt(2.0) * np.sin(2 * np.pi * 47.5 * t), np.zeros(n)], axis=1) + rng.normal(scale=NOISE, size=(n, 2))
    spectrum = spectrum_of(z, DT)
    assert spectrum.step == pytest.approx(STEP, rel=1e-12)
    power, level, _ = spectrum.band(47.5, 0.0)
    density = 2.0 * DT * NOISE**2
    # the line and the noise of 5 bins; six standard deviations of twice their product
    noise = 5.0 * STEP * density
    assert power[0] == pytest.approx(0.03**2 + noise, abs=6 * 0.03 * np.sqrt(noise))
    # the median of exponential numbers is log 2 of their mean; of n it is known to 1 / (log 2 sqrt n): 0.7 x 47.5 Hz of bins
    assert level == pytest.approx(np.log(2.0) * noise * np.ones(2), rel=6 / (np.log(2.0) * np.sqrt(1995)))
    # and with a tenth of the frames lost, one by one: straight lines leave half of the noise of a lost frame
    z[rng.random(n) < 0.1] = np.nan
    bridged, *_ = spectrum_of(z, DT).band(47.5, 0.0)
    assert bridged[0] == pytest.approx(power[0], rel=0.01)
    z[: n // 4] = np.nan
    assert spectrum_of(z, DT) is None
