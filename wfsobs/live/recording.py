"""Frames of a live loop as a record."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock
from typing import Any

import numpy as np

from wfsobs.live.ring import CAPACITY, LiveFrame, Ring
from wfsobs.observers.base import TARGETS
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

    def __init__(self, ring: Ring, sampling: Sampling, look_back: float):
        self._ring, self._sampling = ring, sampling
        self._next = self._first = first_frame(ring, sampling, look_back)
        self._parts: list[LiveFrame] = []

    def collect(self) -> bool:
        """Keep what has come; return whether it has left no room for more."""
        stop = min(self._ring.count, self._first + LONGEST)
        if stop <= self._next:
            return False
        self._parts.append(self._ring.read_frames(self._next, stop))
        self._next = stop
        return stop == self._first + LONGEST

    def frames(self) -> LiveFrame | None:
        """Return the frames so far, None where there is none."""
        self.collect()
        if not self._parts:
            return None
        return LiveFrame(*(np.concatenate(parts) for parts in zip(*self._parts, strict=True)))


class Recorder:
    """Recording on and off, and a look back.

    Parameters
    ----------
    ring : Ring
        Where the frames come.
    sampling : Sampling
        NGS ratio, and time step.
    say : callable
        Receives one line about what happens.
    is_simulated : bool
        Whether the commands are those of the scenario's loop; else the mirror is at rest in the record.

    Attributes
    ----------
    record : Record or None
        The last recording that has ended.
    """

    def __init__(self, ring: Ring, sampling: Sampling, say: Callable[[str], None], is_simulated: bool):
        self._ring, self._sampling, self._say, self._is_simulated = ring, sampling, say, is_simulated
        self._recording: Recording | None = None
        self._lock = Lock()
        self.record: Record | None = None

    @property
    def is_on(self) -> bool:
        """Whether every frame is kept."""
        return self._recording is not None

    def start(self, look_back: float = 0.0) -> None:
        """Keep every frame from now on, and those of the last so many seconds."""
        with self._lock:
            self._recording = Recording(self._ring, self._sampling, look_back)
        self._say("recording on")

    def stop(self, scenario: Scenario) -> Record | None:
        """Return what has been recorded as a record of the scenario's loop, None where there is nothing."""
        with self._lock:
            recording, self._recording = self._recording, None
            self.record = None if recording is None else self._record(recording, scenario)
        self._say("recording off")
        return self.record

    def collect(self) -> None:
        """Keep what has come; called a few times a second."""
        with self._lock:
            is_full = self._recording is not None and self._recording.collect()
        if is_full:
            self._say(f"recording is full: {LONGEST} frames")

    def _record(self, recording: Recording, scenario: Scenario) -> Record | None:
        frames = recording.frames()
        if frames is None:
            return None
        return record_of(frames, scenario) if self._is_simulated else open_loop_record(frames, self._sampling)

    def look_back(self, seconds: float, scenario: Scenario) -> Record:
        """Return the last so many seconds as a record, as far back as there are frames. Raises SettingError without a frame."""
        record = self._record(Recording(self._ring, self._sampling, seconds), scenario)
        if record is None:
            raise SettingError("no frame has come yet")
        return record


def first_frame(ring: Ring, sampling: Sampling, seconds: float) -> int:
    """Return the first frame of the last so many seconds that is there still, and has an NGS measurement."""
    ratio = sampling.ratio or 1
    there = min(round(seconds / sampling.dt), CAPACITY - ratio - 2)
    return -(-max(0, ring.count - there) // ratio) * ratio


def open_loop_record(frames: LiveFrame, sampling: Sampling) -> Record:
    """Return frames of which only the pseudo-open-loop measurement is known as a record with the mirror at rest."""
    ngs = frames.ngs.copy()
    ngs[0] = np.nan
    y_ngs = None if sampling.ratio is None else ngs
    return Record(frames.z, np.zeros_like(frames.z), sampling.dt, y_ngs=y_ngs, ratio=sampling.ratio, **_truth_of(frames))


def record_of(frames: LiveFrame, scenario: Scenario) -> Record:
    """Return frames as a record of the scenario's loop; without truth where they have none."""
    ngs = frames.ngs.copy()
    ngs[0] = np.nan  # a record begins before its first NGS frame
    return Record(**vars(measure_closed_loop(scenario, OpenLoop(frames.z, ngs))), **_truth_of(frames))


def _truth_of(frames: LiveFrame) -> dict[str, Any]:
    """Return the truth of frames by name; nothing where they have none."""
    return {} if np.isnan(frames.turbulence).all() else {name: getattr(frames, name) for name in TARGETS}
