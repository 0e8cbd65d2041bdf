"""What runs beside a live loop, frame by frame: crews, and those of observers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing.queues import Queue
from time import monotonic
from typing import Any, Generic, TypeVar

import numpy as np

from wfsobs.latencies import EDGES
from wfsobs.live.board import NEXT, SCORED, SLOTS, Board
from wfsobs.live.paced import Command, LiveEvent
from wfsobs.live.ring import LiveFrame
from wfsobs.observers.base import TARGETS
from wfsobs.observers.step import StepError, StepObserver
from wfsobs.record import Sampling
from wfsobs.typing import Array

D = TypeVar("D")
M = TypeVar("M")

TRUTHS = (*TARGETS, NEXT)
"""What errors are against; that of both targets together is the sum of theirs."""
ROOM = 1 << 14
"""Rows of estimates or residuals that are kept: a quarter of a minute at 1 kHz."""
COUNTED = 64
"""Frames that are counted together at most."""


def trace_width(n_modes: int) -> int:
    """Return the width of a row of estimates: number of the frame, its delay [s], and what each observer has."""
    return 2 + len(SLOTS) * slot_width(n_modes)


def slot_width(n_modes: int) -> int:
    """Return the width of what one observer has in a row: the time of its step [s], and an estimate of every target [um]."""
    return 1 + len(TARGETS) * n_modes


@dataclass(frozen=True)
class Site:
    """What the processes of crews have in common.

    settings : of the scenario that observers and controllers are told of
    sampling : modes, step and NGS ratio of the source
    ring_name, board_name : shared memory
    news     : events
    """

    settings: Mapping[str, Any]
    sampling: Sampling
    ring_name: str
    board_name: str
    news: Queue[LiveEvent]


def warm_up_of(site: Site) -> int:
    """Return the frames of an observer or a controller before the first that counts."""
    return round(site.settings["run"]["warm_up"] / site.sampling.dt)


class Crew(ABC, Generic[D, M]):
    """What runs in one process: designs D, as the members M of the crew.

    Parameters
    ----------
    sampling : Sampling
        Modes, step and NGS ratio of the source.
    warm_up : int
        Frames of a member before the first that counts.
    say : callable
        Receives events.
    """

    ratio: int

    def __init__(self, sampling: Sampling, warm_up: int, say: Callable[[LiveEvent], None]):
        self.ratio, self._warm_up, self._say = sampling.ratio or 1, warm_up, say
        self._active: dict[str, M] = {}
        self._waiting: dict[str, D] = {}

    def follow(self, command: Command, number: int) -> None:
        """Switch a member off, or a new design on, which goes on where the one before is."""
        name, design = command["id"], command["design"]
        if design is None:
            self._waiting.pop(name, None)
            if (member := self._active.pop(name, None)) is not None:
                self._clear(name, member)
                self._say(LiveEvent(number, "{} off", name))
        elif (member := self._active.get(name)) is None:
            self._waiting[name] = design
        else:
            try:
                self._swap(name, member, design)
            except StepError as error:
                self._waiting[name] = design
                self._say(LiveEvent(number, "{} restarted", name, f": {error}"))
            else:
                self._say(LiveEvent(number, "{} has a new design", name))

    def _start_waiting(self, number: int) -> None:
        """Start those that wait for an NGS frame."""
        if self._waiting and number % self.ratio == 0:
            for name, design in self._waiting.items():
                self.start(name, design, number)
                self._say(LiveEvent(number, "{} on", name))
            self._waiting.clear()

    @abstractmethod
    def start(self, name: str, design: D, number: int) -> None:
        """Let a design follow from a frame on."""

    @abstractmethod
    def _swap(self, name: str, member: M, design: D) -> None:
        """Have a design go on where a member is. Raises StepError."""

    @abstractmethod
    def _clear(self, name: str, member: M) -> None:
        """Clear what one had that is off."""


class Follower:
    """One observer on a source.

    Parameters
    ----------
    observer : StepObserver
        Before its first frame.
    slot : int
        Its place in SLOTS.
    estimates : Array
        Where its estimates go, (len(TARGETS), n_modes) [um].
    """

    observer: StepObserver
    slot: int

    def __init__(self, observer: StepObserver, slot: int, estimates: Array):
        self.observer, self.slot = observer, slot
        self._outs = [(target, estimates[TARGETS.index(target)]) for target in observer.targets]

    def take(self, z: Array, ngs: Array | None, u: Array) -> None:
        """Update and estimate; `u` goes to those alone that need it, and no NGS measurement to a first frame."""
        observer = self.observer
        observer.update(z, ngs if observer.frame else None, u if observer.estimator.needs_command else None)
        for target, out in self._outs:
            out[:] = observer.predict(0, target)[0]


class ObserverCrew(Crew[StepObserver, Follower]):
    """The observers that follow in one process: each takes every frame, all are scored together.

    Parameters
    ----------
    sampling : Sampling
        Modes, step and NGS ratio of the source.
    warm_up : int
        Frames of an observer before the first that is scored.
    board : Board
        Where errors and latencies are counted.
    place : int
        Of the crew in CREWS.
    say : callable
        Receives events.
    """

    def __init__(self, sampling: Sampling, warm_up: int, board: Board, place: int, say: Callable[[LiveEvent], None]):
        super().__init__(sampling, warm_up, say)
        n, m = len(SLOTS), sampling.n_modes
        self._dt, self._board, self._place = sampling.dt, board, place
        self._row = np.full(trace_width(m), np.nan)
        slots = self._row[2:].reshape(n, slot_width(m))
        self._times, self._estimates = slots[:, 0], slots[:, 1:].reshape(n, len(TARGETS), m)  # views of the row
        self._rows, self._truth, self._waits = np.empty((COUNTED, *slots.shape)), np.empty((COUNTED, len(TRUTHS), m)), 0
        self._next, self._running = np.full((n, m), np.nan), np.empty(0, dtype=np.intp)

    def take(self, frame: LiveFrame, number: int) -> Array:
        """Have every observer take a frame; return the row of their estimates. `settle` follows once that is written."""
        if self._waits == COUNTED:
            self.count()
        self._start_waiting(number)
        ngs = None if np.isnan(frame.ngs[0]) else frame.ngs
        before = monotonic()
        for follower in self._active.values():
            follower.take(frame.z, ngs, frame.u)
            now = monotonic()
            self._times[follower.slot], before = now - before, now
        self._row[:2] = number, before - float(frame.due)
        self._rows[self._waits].reshape(-1)[:], truth = self._row[2:], self._truth[self._waits]
        truth[0], truth[1], truth[2] = frame.turbulence, frame.vibration, frame.z
        self._waits += 1
        return self._row

    def settle(self) -> None:
        """Have those learn that learn from every frame."""
        for follower in self._active.values():
            follower.observer.settle()

    def count(self) -> None:
        """Count latencies and squared errors of the frames that wait for it; what is NaN is not known.

        Each takes as long as several together do, so that it is not done with every frame.
        """
        board, running, n = self._board, self._running, self._waits
        self._waits = 0
        if n:
            board.progress[self._place] += n
        if not n or not len(running):
            return
        rows = self._rows[:n, running]
        spent, estimates = rows[:, :, 0], rows[:, :, 1:].reshape(n, len(running), len(TARGETS), -1)
        np.add.at(board.histograms, (running, np.searchsorted(EDGES, spent)), 1)
        board.late[running] += (spent > self._dt).sum(axis=0)
        board.frames[running] += n
        errors = self._errors(estimates, self._truth[:n])
        is_known = errors == errors
        errors[~is_known] = 0.0
        board.squares[running] += (errors * errors).sum(axis=0)  # the other crew writes its own rows
        board.samples[running] += is_known.sum(axis=0)

    def _errors(self, estimates: Array, truth: Array) -> Array:
        """Return the errors of consecutive frames, NaN during a warm-up, (n, running observers, len(SCORED), n_modes) [um]."""
        n, running = len(truth), self._running
        out = np.empty((n, len(running), len(SCORED), truth.shape[2]))
        np.subtract(estimates, truth[:, None, :2], out=out[:, :, :2])
        expected = np.concatenate((self._next[None, running], estimates.sum(axis=2)))  # of each measurement from the frame before
        np.subtract(expected[:-1], truth[:, 2, None], out=out[:, :, 2])
        np.add(out[:, :, 0], out[:, :, 1], out=out[:, :, 3])
        self._next[running] = expected[-1]
        for at, follower in enumerate(self._active.values()):
            out[: max(0, n - max(0, follower.observer.frame - self._warm_up)), at] = np.nan
        return out

    def lose(self, count: int) -> None:
        """Start anew after frames that were overwritten."""
        self.count()
        self._board.losses[self._place] += count
        self._board.progress[self._place] += count
        self._next[:] = np.nan
        for follower in self._active.values():
            follower.observer.reset()

    def follow(self, command: Command, number: int) -> None:
        """Switch an observer off, or a new design on, which goes on where the one before is."""
        self.count()
        super().follow(command, number)

    def _clear(self, name: str, member: Follower) -> None:
        self._estimates[member.slot] = self._times[member.slot] = self._next[member.slot] = np.nan
        self._board[name].since[0] = -1
        self._list_running()

    def _swap(self, name: str, member: Follower, design: StepObserver) -> None:
        design.take_over(member.observer)
        member.observer = design

    def start(self, name: str, design: StepObserver, number: int) -> None:
        """Let an observer follow from a frame on."""
        self.count()
        counts, slot = self._board[name], SLOTS.index(name)
        counts.clear()
        counts.since[0] = number
        self._next[slot] = np.nan
        self._active[name] = Follower(design, slot, self._estimates[slot])
        self._active = {slot: self._active[slot] for slot in SLOTS if slot in self._active}
        self._list_running()

    def _list_running(self) -> None:
        self._running = np.array([follower.slot for follower in self._active.values()], dtype=np.intp)
