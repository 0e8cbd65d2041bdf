"""Frames of a loop, and rows of numbers, in shared memory: one writer, any number of readers; and frames as a record."""

from __future__ import annotations

import os
import select
import warnings
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import pairwise
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory
from threading import Lock
from time import monotonic
from typing import Any, NamedTuple

import numpy as np

from wfsobs.observers.base import TARGETS
from wfsobs.record import Record, Sampling
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.simulation.loop import measure_closed_loop
from wfsobs.simulation.sensing import OpenLoop
from wfsobs.typing import Array

HEAD = 24
"""Bytes before the rows: the count, whether the writer has ended, and how many came late."""


class SharedNumbers:
    """Numbers in memory that processes share.

    Parameters
    ----------
    size : int
        Bytes.
    name : str or None
        That of memory that exists; None to own a new one.
    """

    def __init__(self, size: int, name: str | None):
        self._memory = SharedMemory(name=name, create=name is None, size=size if name is None else 0)
        self._owner = name is None

    @property
    def name(self) -> str:
        """Name by which another process finds it."""
        return self._memory.name

    def release(self) -> None:
        """Give the memory back."""
        self._memory.close()
        if self._owner:
            with suppress(FileNotFoundError):  # a resource tracker has done so: that of this process was killed
                self._memory.unlink()


class Rows(SharedNumbers):
    """A ring of rows.

    Parameters
    ----------
    width : int
        Numbers in a row.
    capacity : int
        Rows that it holds.
    name : str, optional
        That of a ring that exists.

    Raises
    ------
    OSError
        There is no ring of this name.
    """

    capacity: int

    def __init__(self, width: int, capacity: int, name: str | None = None):
        super().__init__(HEAD + 8 * capacity * width, name)
        self._head = np.ndarray(3, dtype=np.int64, buffer=self._memory.buf)
        self._rows = np.ndarray((capacity, width), buffer=self._memory.buf, offset=HEAD)
        self.capacity = capacity
        if self._owner:
            self._rows[0] = np.nan  # else it would be the one of number 0 before it is written

    @property
    def count(self) -> int:
        """Number of rows written so far."""
        return int(self._head[0])

    @property
    def is_closed(self) -> bool:
        """Whether the writer has ended."""
        return bool(self._head[1])

    def write(self, row: Array) -> None:
        """Append a row: the numbers first, then the count."""
        self._rows[self._head[0] % self.capacity] = row
        self._head[0] += 1

    def skip_to(self, index: int) -> None:
        """Go on with the row of this number; those between are not written, and hold what was there."""
        self._head[0] = index

    def read_rows(self, first: int, stop: int, width: int | None = None) -> Array:
        """Return copies of the rows first ... stop - 1, (n, width); NaN where they have been overwritten or are yet to come."""
        first, at = max(first, 0), np.arange(max(first, 0), max(stop, first, 0))
        rows = self._rows[:, :width][at % self.capacity]
        head = int(self._head[0])
        rows[(head - at > self.capacity - 1) | (at >= head)] = np.nan
        return rows

    def close_writer(self) -> None:
        """Say that no row follows."""
        self._head[1] = 1

    def release(self) -> None:
        """Give the memory back; what is read from then on is NaN."""
        self._head, self._rows = self._head.copy(), np.broadcast_to(np.nan, self._rows.shape)
        super().release()


class Tracker:
    """The process of Python that gives shared memory back where its owner was killed."""

    def __init__(self) -> None:
        pipe = resource_tracker.getfd() if os.name == "posix" else None
        self._pipe = None if pipe is None else os.dup(pipe)

    @property
    def is_gone(self) -> bool:
        """Whether it has been killed: nobody reads from its pipe."""
        if self._pipe is None:
            return False
        (look := select.poll()).register(self._pipe, 0)
        return bool(look.poll(0))

    def release(self) -> None:
        """Have another one in place of one that is gone; what it says of memory that it has never heard of is not shown."""
        is_gone, pipe, self._pipe = self.is_gone, self._pipe, None
        if pipe is not None:
            os.close(pipe)
        if is_gone:
            shown = os.dup(2)
            with open(os.devnull, "w") as nothing, warnings.catch_warnings():
                warnings.simplefilter("ignore")
                os.dup2(nothing.fileno(), 2)
                resource_tracker.ensure_running()
                os.dup2(shown, 2)
            os.close(shown)


CAPACITY = 1 << 17
"""Frames in the ring: two minutes at 1 kHz."""


LATE = 1e-3
"""From which delay a frame counts as late [s]."""


class LiveFrame(NamedTuple):
    """One frame of a loop, or several, with one row each.

    due : when it was due, on the monotonic clock [s];  z, ngs, u : see `StepObserver.update`, (n_modes,) [um]
    turbulence, vibration : truth, (n_modes,) [um]; NaN where there is none
    """

    due: Array | float
    z: Array
    ngs: Array
    u: Array
    turbulence: Array
    vibration: Array


class Ring(Rows):
    """A ring of frames.

    Parameters
    ----------
    n_modes : int
        Number of modes.
    name : str, optional
        That of a ring that exists.
    """

    def __init__(self, n_modes: int, name: str | None = None):
        super().__init__(1 + 5 * n_modes, CAPACITY, name)
        self._parts = [1 + i * n_modes for i in range(6)]

    @property
    def late(self) -> int:
        """Number of frames that were sent more than LATE after they were due."""
        return int(self._head[2])

    def send(self, row: Array) -> None:
        """Append a frame, the time first at which it was due."""
        self.write(row)
        self._head[2] += monotonic() - row[0] > LATE

    def read(self, index: int) -> LiveFrame | None:
        """Return the frame of this number, None where it has been overwritten."""
        row = self._rows[index % self.capacity].copy()
        if self._head[0] - index > self.capacity - 1:  # perhaps while it was copied
            return None
        return LiveFrame(float(row[0]), *(row[a:b] for a, b in pairwise(self._parts)))

    def read_frames(self, first: int, stop: int) -> LiveFrame:
        """Return the frames first ... stop - 1, each part (n, n_modes), the times (n,); NaN where there is none any more."""
        rows = self.read_rows(first, stop)
        return LiveFrame(rows[:, 0], *(rows[:, a:b] for a, b in pairwise(self._parts)))


def merged_rows(traces: Iterable[Rows], first: int, stop: int, width: int | None = None) -> Array:
    """Return what the crews together have in the rows first ... stop - 1, (n, width): the longest delay, every estimate.

    A row that is not that of its frame holds what was there before: it is NaN, but for its number.
    """
    numbers, out = np.arange(max(first, 0), max(stop, first, 0)), None
    for rows in traces:
        own = rows.read_rows(first, stop, width)
        own[own[:, 0] != numbers] = np.nan
        out = own if out is None else np.fmax(out, own)
    assert out is not None
    out[:, 0] = numbers
    return out


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
        Time before now that is kept, too, as far as it is there still [s].
    """

    def __init__(self, ring: Ring, sampling: Sampling, look_back: float):
        self._ring, ratio = ring, sampling.ratio or 1
        there = min(round(look_back / sampling.dt), CAPACITY - ratio - 2)
        self._next = self._first = -(-max(0, ring.count - there) // ratio) * ratio  # it has an NGS measurement
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
