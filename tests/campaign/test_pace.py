"""The pace of batches, by times that are easy to count."""

import numpy as np
import pytest

from wfsobs.campaign.follow import LEAST, UNKNOWN, WrittenBatch, measure_pace

DAY = 86400.0
UNSTARTED = 9 * DAY
"""A start by another clock, later than any time here."""


def batches(*times, process=1, n_runs=2):
    return [WrittenBatch(t, ("here", process), n_runs) for t in times]


def test_the_time_left_goes_by_the_rate_until_nothing_comes():
    pace = measure_pace(batches(1000.0, 1005.0, 1012.0), UNSTARTED, 1012.0)
    assert pace.seconds_left(10, 1012.0 + 20.9) == pytest.approx(10 * 12.0 / 4), "the first two runs took an unknown time"
    assert pace.silence(1012.0 + 20.9) == 0.0, "three times 7 s"
    assert pace.silence(1012.0 + 21.1) == pytest.approx(21.1) and np.isnan(pace.seconds_left(10, 1012.0 + 21.1))
    again = measure_pace(batches(1000.0, 1005.0, 1012.0, 1035.0, 1040.0), UNSTARTED, 1040.0)
    assert again.seconds_left(10, 1041.0) == pytest.approx(10 * 5.0 / 2), "without the silence before"


def test_a_silence_is_at_least_some_seconds():
    pace = measure_pace(batches(*np.arange(1000.0, 1010.0)), UNSTARTED, 1009.0)
    assert pace.patience == LEAST and pace.silence(1009.0 + 0.9 * LEAST) == 0.0 and pace.silence(1009.0 + 1.1 * LEAST) > LEAST


def test_a_batch_takes_what_its_process_took():
    """Four processes write within a second, every minute: 59 s without a batch are usual."""
    every = [one for process in range(4) for one in batches(60.0 + 0.3 * process, 120.0 + 0.3 * process, process=process)]
    pace = measure_pace(every, UNSTARTED, 121.0)
    assert pace.silence(181.0) == 0.0 and pace.silence(121.0 + 3 * 60.0) > 0.0
    first = measure_pace([one for one in every if one.time < 61.0], 0.0, 61.0)
    assert first.patience == 180.0, "the first one took the time since the start"
    assert measure_pace(batches(60.0), UNSTARTED, 61.0).patience == UNKNOWN


def test_a_campaign_that_is_started_again_has_a_moment():
    stopped = batches(1003.0, 1006.0, 1009.0)
    assert measure_pace(stopped, 1000.0, DAY).silence(DAY) == pytest.approx(DAY - 1009.0)
    resumed = measure_pace(stopped, DAY, DAY + 1.0)
    assert resumed.silence(DAY + 9.0) == 0.0 and resumed.silence(DAY + 11.0) == pytest.approx(11.0)
    going = measure_pace([*stopped, *batches(DAY + 5.0, DAY + 9.0, process=2)], DAY, DAY + 9.0)
    assert going.patience == 15.0, "not three days"
    assert going.seconds_left(10, DAY + 9.0) == pytest.approx(10 * 4.0 / 2)
    asleep = measure_pace([*stopped, *batches(DAY, DAY + 4.0)], 1000.0, DAY + 4.0)
    assert asleep.patience == 12.0, "the process is the same, its day of sleep is no batch"


def test_without_a_batch_nothing_is_known():
    pace = measure_pace([], 1000.0, 5000.0)
    assert pace.silence(5000.0) == 0.0 and np.isnan(pace.seconds_left(10, 5000.0))
