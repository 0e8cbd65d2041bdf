"""Observers that follow a source in a process of their own, so that nothing that reads them delays them."""

from __future__ import annotations

import gc
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.queues import Queue
from time import monotonic, sleep
from typing import Any

import numpy as np

from wfsobs.live.board import SLOTS, Board
from wfsobs.live.follow import LATE, POLL, Follower
from wfsobs.live.paced import Command, enter_process
from wfsobs.live.ring import LiveFrame, Ring
from wfsobs.live.rows import Rows
from wfsobs.observers.base import TARGETS
from wfsobs.observers.step import StepObserver
from wfsobs.observers.step_checks import StepError
from wfsobs.record import Sampling
from wfsobs.scenario import Scenario
from wfsobs.stepping import design
from wfsobs.typing import Array

TRACE_CAPACITY = 1 << 14
"""Rows of estimates that are kept: a quarter of a minute at 1 kHz."""
REST = 2e-3
"""Pause between two looks at a ring that stands still [s]."""


@dataclass(frozen=True)
class Order:
    """What the process is told.

    settings  : of the scenario that the observers are told of
    observers : ids of those that run from the start
    sampling  : modes, step and NGS ratio of the source
    ring_name, traces_name, board_name : shared memory
    inbox     : commands
    news      : (number of the frame, one line)
    """

    settings: Mapping[str, Any]
    observers: tuple[str, ...]
    sampling: Sampling
    ring_name: str
    traces_name: str
    board_name: str
    inbox: Connection
    news: Queue[tuple[int, str]]


def trace_width(n_modes: int) -> int:
    """Return the width of a row of estimates: number of the frame, its delay [s], and what each observer has."""
    return 2 + len(SLOTS) * slot_width(n_modes)


def slot_width(n_modes: int) -> int:
    """Return the width of what one observer has in a row: the time of its step [s], and an estimate of every target [um]."""
    return 1 + len(TARGETS) * n_modes


class Crew:
    """The observers that follow.

    Parameters
    ----------
    order : Order
        What the process is told.
    """

    def __init__(self, order: Order):
        scenario = Scenario.from_dict(dict(order.settings))
        sampling = order.sampling
        self._dt, self._ratio, self._n = sampling.dt, sampling.ratio or 1, sampling.n_modes
        self._warm_up = round(scenario.run.warm_up / sampling.dt)
        self._board, self._say = Board(order.sampling.n_modes, order.board_name), order.news.put
        self._row, self._width = np.full(trace_width(order.sampling.n_modes), np.nan), slot_width(order.sampling.n_modes)
        self._active: dict[str, Follower] = {}
        self._waiting: dict[str, StepObserver] = {}
        for name in order.observers:
            self._start(name, design(name, scenario, sampling=sampling), 0)

    def take(self, frame: LiveFrame, number: int) -> Array:
        """Have every observer take a frame; return the row of their estimates."""
        if self._waiting and number % self._ratio == 0:
            for name, observer in self._waiting.items():
                self._start(name, observer, number)
            self._waiting.clear()
        late = monotonic() - float(frame.due)
        self._row[:2] = number, late
        for name, follower in self._active.items():
            spent, means = follower.take(frame)
            at = 2 + SLOTS.index(name) * self._width
            self._row[at] = spent
            for target, mean in zip(follower.observer.targets, means, strict=True):
                place = at + 1 + TARGETS.index(target) * self._n
                self._row[place : place + self._n] = mean
        self._board.totals[0] += 1
        self._board.totals[2] += late > LATE
        return self._row

    def lose(self, count: int) -> None:
        """Start anew after frames that were overwritten."""
        self._board.totals[1] += count
        for follower in self._active.values():
            follower.observer.reset()

    def follow(self, command: Command, number: int) -> None:
        """Switch an observer off, or a new design on, which goes on where the one before is."""
        name, observer = command["observer"], command["design"]
        if observer is None:
            self._waiting.pop(name, None)
            if self._active.pop(name, None) is not None:
                at = 2 + SLOTS.index(name) * self._width
                self._row[at : at + self._width] = np.nan
                self._board[name].since[0] = -1
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

    def _start(self, name: str, observer: StepObserver, number: int) -> None:
        counts = self._board[name]
        counts.clear()
        counts.since[0] = number
        self._active[name] = Follower(observer, self._warm_up, self._dt, counts)
        self._active = {slot: self._active[slot] for slot in SLOTS if slot in self._active}
        if number:
            self._say((number, f"{name} on"))

    @property
    def ratio(self) -> int:
        """Frames from one with an NGS measurement to the next."""
        return self._ratio

    def be_ready(self) -> None:
        """Say that the first frame may come."""
        self._board.totals[3] = 1


def observe_frames(order: Order) -> None:
    """Follow a ring until the process is ended."""
    enter_process()
    ring = Ring(order.sampling.n_modes, order.ring_name)
    traces = Rows(trace_width(order.sampling.n_modes), TRACE_CAPACITY, order.traces_name)
    try:
        crew = Crew(order)
    except ValueError as error:
        order.news.put((0, str(error)))
        return
    gc.collect()
    gc.freeze()
    crew.be_ready()
    number, alive = 0, 0.0
    while True:
        if order.inbox.poll():
            crew.follow(order.inbox.recv(), number)
        if ring.count <= number:
            sleep(POLL if monotonic() - alive < 10 * REST else REST)
            continue
        if (frame := ring.read(number)) is None:
            newest = ring.count // crew.ratio * crew.ratio
            crew.lose(newest - number)
            traces.skip_to(newest)
            number = newest
            continue
        alive = monotonic()
        traces.write(crew.take(frame, number))
        number += 1
