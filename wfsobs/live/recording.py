"""Frames of a live loop as a record."""

from __future__ import annotations

import numpy as np

from wfsobs.live.ring import CAPACITY, LiveFrame, Ring
from wfsobs.record import Record, Sampling
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.simulation.loop import measure_closed_loop
from wfsobs.simulation.sensing import OpenLoop

LONGEST = 1_200_000
"""Frames of a recording: 20 minutes at 1 kHz."""


class Recording:
    """Frames that are kept as they come.

    Parameters
    ----------
    ring : Ring
        Where they come.
    sampling : Sampling
        NGS ratio, and time step.
    look_back : float
        Time before now that is kept, too [s].
    """

    def __init__(self, ring: Ring, sampling: Sampling, look_back: float = 0.0):
        self._ring, self._sampling = ring, sampling
        self._next = self._first = first_frame(ring, sampling, look_back)
        self._parts: list[LiveFrame] = []

    def collect(self) -> bool:
        """Keep what has come; return whether there is room for more."""
        stop = min(self._ring.count, self._first + LONGEST)
        if stop > self._next:
            self._parts.append(self._ring.read_frames(self._next, stop))
            self._next = stop
        return stop < self._first + LONGEST

    def record(self, scenario: Scenario) -> Record | None:
        """Return the record so far, None where there is no frame."""
        self.collect()
        if not self._parts:
            return None
        return record_of(LiveFrame(*(np.concatenate(parts) for parts in zip(*self._parts, strict=True))), scenario)


def first_frame(ring: Ring, sampling: Sampling, seconds: float) -> int:
    """Return the first frame of the last so many seconds that is there still, and has an NGS measurement."""
    ratio = sampling.ratio or 1
    there = min(round(seconds / sampling.dt), CAPACITY - ratio - 2)
    return -(-max(0, ring.count - there) // ratio) * ratio


def loop_record(ring: Ring, scenario: Scenario, sampling: Sampling, seconds: float) -> Record:
    """Return the last so many seconds as a record. Raises SettingError where there is no frame."""
    recording = Recording(ring, sampling, seconds)
    record = recording.record(scenario)
    if record is None:
        raise SettingError("no frame has come yet")
    return record


def record_of(frames: LiveFrame, scenario: Scenario) -> Record:
    """Return frames as a record of the scenario's loop; without truth where they have none."""
    ngs = frames.ngs.copy()
    ngs[0] = np.nan  # a record begins before its first NGS frame
    measured = measure_closed_loop(scenario, OpenLoop(frames.z, ngs))
    has_truth = not np.isnan(frames.turbulence).all()
    return Record(
        **vars(measured),
        turbulence=frames.turbulence if has_truth else None,
        vibration=frames.vibration if has_truth else None,
    )
