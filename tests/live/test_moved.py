"""A line that jumps in the midst of a minute, as it is identified and told: simulated, a third of a minute each."""

import numpy as np
import pytest

from tests.live.in_process import keep_lines
from wfsobs import PRESETS, simulate
from wfsobs.live.finding import identify_frames
from wfsobs.live.loop import Alarms
from wfsobs.live.ring import LiveFrame, open_loop_record

pytestmark = pytest.mark.slow

PART = 20_000
"""Frames of which peaks are identified."""


@pytest.mark.parametrize(("seed", "at"), [(1, 20.2), (3, 23.0), (4, 30.0), (6, 39.5)])
def test_a_line_that_jumps_in_the_midst_is_told_as_moved(seed, at):
    scenario = PRESETS["peak-jump"]().replace({"run.duration": 60.0, "run.seed": seed, "events.0.start": at})
    record, said = simulate(scenario), []
    alarms = Alarms(keep_lines(said))
    for first in range(0, 60_000, PART):
        part = slice(first, first + PART)
        frames = LiveFrame(0.0, record.z[part], record.z_ngs[part], *[np.full((PART, 2), np.nan)] * 3)
        alarms.compare(identify_frames(open_loop_record(frames, record.sampling), scenario.to_dict()))
    moved = [line for line in said if "moved" in line]
    assert len(moved) == 1, said
    before, now = (float(word) for word in moved[0].split() if word[0].isdigit())
    # 20 s resolve 0.05 Hz
    assert (before, now) == pytest.approx((47.5, 50.5), abs=0.05)
    assert not any("47" in line and "gone" in line for line in said)
