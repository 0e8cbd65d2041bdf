"""What is counted of every observer, in shared memory, and the last seconds of a live loop: frames, estimates, errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from threading import Lock
from time import monotonic
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wfsobs.evaluation.scores import SHARE
from wfsobs.live.ring import LATE, LiveFrame, Ring, Rows, SharedNumbers, merged_rows
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.record import TOTAL, Sampling, fuse_frames
from wfsobs.streams.follower import EDGES, Latencies
from wfsobs.typing import Array

NEXT = "next"
"""The next measurement: what an observer of turbulence and vibration expects of it is their sum."""
SCORED = (*TARGETS, NEXT, TOTAL)
"""What errors are counted of."""
SLOTS = tuple(o.id for o in OBSERVERS.values() if o.step is not None and "y_stars" not in o.needs)
"""Observers that run frame by frame, on what a live source sends: no LGS by itself; each has its place."""
ADAPTIVE = ("kf-adaptive", "multirate-adaptive", "gpr-adaptive")
"""Observers that identify a window now and then, which takes a tenth of a second."""
LONG_STEPS = (*ADAPTIVE, "gpr-offline")
"""Observers some of whose steps are longer than a frame at 1 kHz."""
CREWS = ("linear", "learning", "long")
"""Processes of observers: linear ones, those that learn from every frame, LONG_STEPS. None need wait for what takes longer."""

Integers = NDArray[np.int64]


def crew_of(observer: str) -> int:
    """Return the place in CREWS of the process in which an observer follows."""
    return CREWS.index("long" if observer in LONG_STEPS else "linear" if OBSERVERS[observer].linear else "learning")


def trace_width(n_modes: int) -> int:
    """Return the width of a row of estimates: number of the frame, its delay [s], and what each observer has."""
    return 2 + len(SLOTS) * slot_width(n_modes)


def slot_width(n_modes: int) -> int:
    """Return the width of what one observer has in a row: the time of its step [s], and an estimate of every target [um]."""
    return 1 + len(TARGETS) * n_modes


class Counts(NamedTuple):
    """What is counted of one observer; all are counted up in place.

    squares, samples : sums of squared errors [um^2] and their numbers, (4, n_modes) for turbulence, vibration, the next
        measurement, and turbulence and vibration together
    histogram : of the latencies of its steps, as `Latencies` counts them
    late, frames, since : steps longer than a frame, steps, first frame, (1,); `since` is -1 while it is off
    """

    squares: Array
    samples: Integers
    histogram: Integers
    late: Integers
    frames: Integers
    since: Integers

    @property
    def latencies(self) -> Latencies:
        """Latencies of its steps."""
        return Latencies(self.histogram)

    def clear(self) -> None:
        """Begin anew; `since` stays."""
        for part in self[:-1]:
            part[:] = 0

    def rms(self, quantity: str) -> Array:
        """Return the rms error, (n_modes,) [um]; NaN without a sample."""
        at = SCORED.index(quantity)
        samples = self.samples[at].copy()
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(self.squares[at] / samples)

    def total_rms(self, targets: Sequence[str]) -> float:
        """Return the rms error over targets and modes [um]; NaN without a sample."""
        at = [SCORED.index(target) for target in targets]
        n = int(self.samples[at].sum())
        return float(np.sqrt(self.squares[at].sum() / n)) if n else float("nan")


class Board(SharedNumbers):
    """The counts of all observers.

    Parameters
    ----------
    n_modes : int
        Number of modes.
    name : str, optional
        That of a board that exists.

    Attributes
    ----------
    losses, is_ready, progress : Integers
        Of the crews: frames lost, whether the observers are ready, and the number of the first frame not counted, (len(CREWS),).
    squares, samples, histogram, late, frames : array
        As in `Counts`, of all observers, in the order of SLOTS.
    """

    losses: Integers
    is_ready: Integers
    progress: Integers
    squares: Array
    samples: Integers
    histogram: Integers
    late: Integers
    frames: Integers

    def __init__(self, n_modes: int, name: str | None = None):
        n, scored, whole = len(SLOTS), (len(SLOTS), len(SCORED), n_modes), np.int64
        kind = np.dtype(
            [
                *((part, whole, len(CREWS)) for part in ("losses", "is_ready", "progress")),
                ("squares", np.float64, scored),
                ("samples", whole, scored),
                ("histogram", whole, (n, len(EDGES) + 1)),
                *((part, whole, (n, 1)) for part in ("late", "frames", "since")),
            ]
        )
        super().__init__(kind.itemsize, name)
        self._look_at(np.ndarray((), kind, self._memory.buf))
        if self._owner:
            self._since[:] = -1

    def _look_at(self, parts: NDArray[np.void]) -> None:
        self._parts = parts
        self.losses, self.is_ready, self.progress = parts["losses"], parts["is_ready"], parts["progress"]
        of_slots = [parts[name] for name in Counts._fields]
        self.squares, self.samples, self.histogram, self.late, self.frames, self._since = of_slots
        self._counts = {slot: Counts(*(part[i] for part in of_slots)) for i, slot in enumerate(SLOTS)}

    def __getitem__(self, observer: str) -> Counts:
        return self._counts[observer]

    def active(self) -> list[str]:
        """Return the ids of the observers that run."""
        return [name for name, counts in self._counts.items() if counts.since[0] >= 0]

    def release(self) -> None:
        """Give the memory back; the counts stay as they are."""
        self._look_at(self._parts.copy())
        super().release()


class Delivery:
    """Counts the frames of a loop.

    A frame is taken once every observer has an estimate of it that is counted, and late where it has it more than 1 ms after the
    frame was due.

    Parameters
    ----------
    ring : Ring
        The frames.
    board : Board
        Where the crews count what they lose.
    parts : callable
        Returns the rows of the crews that take part, by their places in CREWS.
    """

    def __init__(self, ring: Ring, board: Board, parts: Callable[[], Mapping[int, Rows]]):
        self._ring, self._board, self._parts, self._lock = ring, board, parts, Lock()
        self._next = self._n_delays = self._n_late = 0

    @property
    def count(self) -> int:
        """Frames that every observer has taken, or lost."""
        return min(int(self._board.progress[place]) for place in self._parts())

    @property
    def losses(self) -> int:
        """Frames that an observer has lost."""
        return int(self._board.losses.max())

    @property
    def frames(self) -> int:
        """Frames that every observer has taken."""
        return self.count - self.losses

    @property
    def late_share(self) -> float:
        """Share of the frames of which an estimate came more than 1 ms after they were due."""
        return self._n_late / max(self._n_delays, 1)

    @property
    def late_share_sent(self) -> float:
        """Share of the frames that the source sent more than 1 ms after they were due."""
        return self._ring.late / max(self._ring.count, 1)

    def collect(self) -> None:
        """Count what has come since the last call; rows that have been overwritten meanwhile are not known."""
        with self._lock:
            stop = self.count
            delays = merged_rows(self._parts().values(), self._next, stop, 2)[:, 1]
            self._next = stop
            self._n_delays += int((~np.isnan(delays)).sum())
            self._n_late += int((delays > LATE).sum())


SHARED = 0.16
"""For how long pages share what is read of a loop: from a multiple of it to the next one [s]."""


@dataclass(frozen=True)
class LiveView:
    """Consecutive frames, with what every observer makes of them.

    Attributes
    ----------
    first : int
        Number of the first one.
    dt : float
        Time between two [s].
    frames : LiveFrame
        Each part (n, n_modes) [um].
    ratio : int or None
        Frames per NGS frame; None without NGS.
    """

    first: int
    dt: float
    frames: LiveFrame
    _traces: Array
    ratio: int | None = None
    _results: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return what is made of these frames, and made once for all pages that want the same; key : tells what that is."""
        if key not in self._results:
            self._results[key] = make()
        return self._results[key]

    @property
    def n(self) -> int:
        """Number of frames."""
        return len(self._traces)

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return self.frames.z.shape[1]

    def truth(self, target: str) -> Array:
        """Return the truth of a target or of both together, (n, n_modes) [um]; of the next measurement, the measurements."""
        if target == TOTAL:
            return self.frames.turbulence + self.frames.vibration
        return self.frames.z if target == NEXT else getattr(self.frames, target)

    def estimate(self, observer: str, target: str) -> Array:
        """Return what an observer has estimated of a target or of both together, (n, n_modes) [um]; NaN where nothing."""
        own, m = self._of(observer), self.n_modes
        if target == TOTAL:
            return own[:, 1 : 1 + m] + own[:, 1 + m : 1 + 2 * m]
        if target == NEXT:
            out = np.full((self.n, m), np.nan)
            out[1:] = self.estimate(observer, TOTAL)[:-1]
            return out
        at = 1 + TARGETS.index(target) * m
        return own[:, at : at + m]

    def error(self, observer: str, target: str) -> Array:
        """Return the error of an estimate, (n, n_modes) [um]."""
        return self.estimate(observer, target) - self.truth(target)

    def rms(self, observer: str, target: str) -> Array:
        """Return the rms error, (n_modes,) [um]; NaN where there is none.

        That of the next measurement is told by the NGS where at least half of its frames are there.
        """
        return self.once(("rms", observer, target), lambda: rms_of_known(self.estimate(observer, target) - self._judge(target)))

    def _judge(self, target: str) -> Array:
        """Return what an error is against, (n, n_modes) [um]."""
        truth, n = self.truth(target), self.ratio
        if target != NEXT or n is None or np.mean(~np.isnan(self.frames.ngs).all(axis=1)) < SHARE / n:
            return truth
        return self.once("judge", lambda: fuse_frames(truth, self.frames.ngs, n))

    def _of(self, observer: str) -> Array:
        width = slot_width(self.n_modes)
        at = 2 + SLOTS.index(observer) * width
        return self._traces[:, at : at + width]


class SharedView:
    """The last seconds as they were read last, for pages that look one after the other: a reading takes milliseconds."""

    def __init__(self) -> None:
        self._turn, self._views = 0, dict[float, LiveView]()

    def look(self, read: Callable[[float], LiveView], seconds: float, *, anew: bool) -> LiveView:
        """Return the last so many seconds as they were read since the last multiple of SHARED, or read `anew`."""
        if (turn := int(monotonic() / SHARED)) != self._turn:
            self._turn, self._views = turn, {}
        if anew or seconds not in self._views:
            self._views[seconds] = read(seconds)
        return self._views[seconds]


def read_view(ring: Ring, traces: list[Rows], sampling: Sampling, seconds: float) -> LiveView:
    """Return the last so many seconds that all observers have taken."""
    first, stop = last_frames(min(rows.count for rows in traces), sampling.dt, seconds)
    return LiveView(first, sampling.dt, ring.read_frames(first, stop), merged_rows(traces, first, stop), sampling.ratio)


def last_frames(count: int, dt: float, seconds: float) -> tuple[int, int]:
    """Return the numbers of the first of the last so many seconds of frames, and of the one after the last."""
    return max(0, count - max(1, round(seconds / dt))), count


def rms_of_known(x: Array) -> Array:
    """Return the rms over rows, (n_modes,), NaN left out; NaN where there is nothing else."""
    squares = np.einsum("km,km->m", x, x)
    if len(x) and not np.isnan(squares).any():  # as mostly
        return np.sqrt(squares / len(x))
    known = ~np.isnan(x)
    n = known.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt((np.where(known, x, 0.0) ** 2).sum(axis=0) / n)
