"""The observers that follow in one process: each takes every frame, all are scored together."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic

import numpy as np

from wfsobs.latencies import EDGES
from wfsobs.live.board import SCORED, SLOTS, Board
from wfsobs.live.paced import Command
from wfsobs.live.ring import LiveFrame
from wfsobs.observers.base import TARGETS
from wfsobs.observers.step import StepObserver
from wfsobs.observers.step_checks import StepError
from wfsobs.record import Sampling
from wfsobs.typing import Array


def trace_width(n_modes: int) -> int:
    """Return the width of a row of estimates: number of the frame, its delay [s], and what each observer has."""
    return 2 + len(SLOTS) * slot_width(n_modes)


def slot_width(n_modes: int) -> int:
    """Return the width of what one observer has in a row: the time of its step [s], and an estimate of every target [um]."""
    return 1 + len(TARGETS) * n_modes


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

    def __init__(self, observer: StepObserver, slot: int, estimates: Array):
        self.observer, self.slot = observer, slot
        self._outs = [(target, estimates[TARGETS.index(target)]) for target in observer.targets]

    def take(self, z: Array, ngs: Array | None, u: Array) -> None:
        """Update and estimate; `u` goes to those alone that need it, and no NGS measurement to a first frame."""
        observer = self.observer
        observer.update(z, ngs if observer.frame else None, u if observer.estimator.needs_command else None)
        for target, out in self._outs:
            out[:] = observer.predict(0, target)[0]


class Crew:
    """The observers that follow in one process.

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
        Receives (number of the frame, one line) about what happens.
    """

    def __init__(self, sampling: Sampling, warm_up: int, board: Board, place: int, say: Callable[[tuple[int, str]], None]):
        n, m = len(SLOTS), sampling.n_modes
        self._dt, self.ratio, self._warm_up = sampling.dt, sampling.ratio or 1, warm_up
        self._board, self._place, self._say = board, place, say
        self._row = np.full(trace_width(m), np.nan)
        slots = self._row[2:].reshape(n, slot_width(m))
        self._times, self._estimates = slots[:, 0], slots[:, 1:].reshape(n, len(TARGETS), m)  # views of the row
        self._next, self._errors = np.full((n, m), np.nan), np.empty((n, len(SCORED), m))
        self._is_scored, self._running = np.zeros((n, 1, 1), dtype=bool), np.empty(0, dtype=np.intp)
        self._active: dict[str, Follower] = {}
        self._waiting: dict[str, StepObserver] = {}

    def take(self, frame: LiveFrame, number: int) -> Array:
        """Have every observer take a frame; return the row of their estimates. `settle` follows once that is written."""
        if self._waiting and number % self.ratio == 0:
            for name, observer in self._waiting.items():
                self.start(name, observer, number)
            self._waiting.clear()
        ngs = None if np.isnan(frame.ngs[0]) else frame.ngs
        before = monotonic()
        for follower in self._active.values():
            follower.take(frame.z, ngs, frame.u)
            now = monotonic()
            self._times[follower.slot], before = now - before, now
        self._row[:2] = number, before - float(frame.due)
        self._count(frame)
        return self._row

    def settle(self) -> None:
        """Have those learn that learn from every frame."""
        for follower in self._active.values():
            follower.observer.settle()

    def _count(self, frame: LiveFrame) -> None:
        """Count latencies and squared errors of all observers at once; what is NaN is not known."""
        board, running, errors = self._board, self._running, self._errors
        spent = self._times[running]
        board.histograms[running, np.searchsorted(EDGES, spent)] += 1
        board.late[running] += spent > self._dt
        board.frames[running] += 1
        for follower in self._active.values():
            self._is_scored[follower.slot] = follower.observer.frame > self._warm_up
        np.subtract(self._estimates[:, 0], frame.turbulence, out=errors[:, 0])
        np.subtract(self._estimates[:, 1], frame.vibration, out=errors[:, 1])
        np.subtract(self._next, frame.z, out=errors[:, 2])
        np.add(self._estimates[:, 0], self._estimates[:, 1], out=self._next)
        is_known = (errors == errors) & self._is_scored
        errors[~is_known] = 0.0
        board.squares[running] += (errors * errors)[running]  # the other crew writes its own rows
        board.samples[running] += is_known[running]

    def lose(self, count: int) -> None:
        """Start anew after frames that were overwritten."""
        self._board.losses[self._place] += count
        self._next[:] = np.nan
        for follower in self._active.values():
            follower.observer.reset()

    def follow(self, command: Command, number: int) -> None:
        """Switch an observer off, or a new design on, which goes on where the one before is."""
        name, observer = command["observer"], command["design"]
        if observer is None:
            self._waiting.pop(name, None)
            if (follower := self._active.pop(name, None)) is not None:
                self._estimates[follower.slot] = self._times[follower.slot] = np.nan
                self._next[follower.slot] = np.nan
                self._board[name].since[0] = -1
                self._list_running()
                self._say((number, f"{name} off"))
        elif (follower := self._active.get(name)) is None:
            self._waiting[name] = observer
        else:
            self._swap(follower, observer, number)

    def _swap(self, follower: Follower, observer: StepObserver, number: int) -> None:
        try:
            observer.take_over(follower.observer)
        except StepError as error:
            self._waiting[observer.id] = observer
            self._say((number, f"{error}: it starts anew"))
        else:
            follower.observer = observer
            self._say((number, f"{observer.id} has a new design"))

    def start(self, name: str, observer: StepObserver, number: int) -> None:
        """Let an observer follow from a frame on."""
        counts, slot = self._board[name], SLOTS.index(name)
        counts.clear()
        counts.since[0] = number
        self._next[slot] = np.nan
        self._active[name] = Follower(observer, slot, self._estimates[slot])
        self._active = {slot: self._active[slot] for slot in SLOTS if slot in self._active}
        self._list_running()
        if number:
            self._say((number, f"{name} on"))

    def _list_running(self) -> None:
        self._running = np.array([follower.slot for follower in self._active.values()], dtype=np.intp)
