"""The process of the controllers beside a live loop, which may lag behind the frames, and the last seconds of what they leave."""

from __future__ import annotations

import gc
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from multiprocessing.queues import Queue
from time import sleep

import numpy as np

from wfsobs.live.control_crew import SEATS, ControlCrew, row_width
from wfsobs.live.delivery import merged_rows
from wfsobs.live.paced import Command, enter_process
from wfsobs.live.ring import CAPACITY, Ring
from wfsobs.live.rows import Rows
from wfsobs.live.source import end_process, send_command
from wfsobs.live.view import rms_of_known
from wfsobs.record import Sampling
from wfsobs.typing import Array

ROOM = 1 << 14
"""Rows of residuals that are kept: a quarter of a minute at 1 kHz."""
LOOK = 0.05
"""Pause between two looks at the ring [s]: nobody waits for a residual."""
BATCH = 200
"""Frames between two looks at the commands."""
NICENESS = 5
"""Of the process: observers go first."""


@dataclass(frozen=True)
class ControlOrder:
    """What a process of controllers is told.

    sampling : modes, step and NGS ratio of the source
    warm_up  : of each controller [s]
    ring_name, rows_name : shared memory
    inbox    : commands
    news     : (number of the frame, one line)
    """

    sampling: Sampling
    warm_up: float
    ring_name: str
    rows_name: str
    inbox: Connection
    news: Queue[tuple[int, str]]


@dataclass(frozen=True)
class ControlView:
    """What controllers leave of consecutive frames.

    Attributes
    ----------
    first : int
        Number of the first one.
    dt : float
        Time between two [s].
    """

    first: int
    dt: float
    _rows: Array

    def residual(self, controller: str) -> Array:
        """Return what a controller leaves, (n, n_modes) [um]; NaN while it is off. Without truth, what its sensor would see."""
        own = self._of(controller)
        return own[:, : own.shape[1] // 2]

    def rms(self, controller: str) -> Array:
        """Return the rms of the residual, (n_modes,) [um]; NaN where there is none."""
        return rms_of_known(self.residual(controller))

    def rms_since_start(self, controller: str) -> Array:
        """Return the rms of the residual after the warm-up of the controller, (n_modes,) [um]; NaN where there is none."""
        own = self._of(controller)
        m = own.shape[1] // 2
        if not len(own) or not own[-1, -1] > 0:
            return np.full(m, np.nan)
        return np.sqrt(own[-1, m:-1] / own[-1, -1])

    def _of(self, controller: str) -> Array:
        width = (self._rows.shape[1] - 1) // len(SEATS)
        at = 1 + SEATS.index(controller) * width
        return self._rows[:, at : at + width]


class ControlProcess:
    """A process of controllers.

    Parameters
    ----------
    context : SpawnContext
        By which it is made.
    sampling : Sampling
        Modes, step and NGS ratio of the source.
    warm_up : float
        Of each controller [s].
    ring : Ring
        The frames.
    news : queue
        Of (number of the frame, one line).

    Attributes
    ----------
    process : BaseProcess
        It.
    """

    def __init__(self, context: SpawnContext, sampling: Sampling, warm_up: float, ring: Ring, news: Queue[tuple[int, str]]):
        self._rows, self._dt = Rows(row_width(sampling.n_modes), ROOM), sampling.dt
        inbox, self._outbox = context.Pipe(duplex=False)
        order = ControlOrder(sampling, warm_up, ring.name, self._rows.name, inbox, news)
        self.process = context.Process(target=control_frames, args=(order,), name="the controllers", daemon=True)
        self.process.start()

    def tell(self, command: Command) -> None:
        """Give it a command."""
        send_command(self._outbox, command)

    def view(self, seconds: float) -> ControlView:
        """Return the last so many seconds that the controllers have taken."""
        stop = self._rows.count
        first = max(0, stop - max(1, round(seconds / self._dt)))
        return ControlView(first, self._dt, merged_rows([self._rows], first, stop))

    def stop(self) -> None:
        """End it and give the memory back."""
        end_process(self.process)
        self._rows.release()


def control_frames(order: ControlOrder) -> None:
    """Follow a ring until the process is ended."""
    enter_process(NICENESS)
    n_modes = order.sampling.n_modes
    ring, rows = Ring(n_modes, order.ring_name), Rows(row_width(n_modes), ROOM, order.rows_name)
    crew = ControlCrew(order.sampling, round(order.warm_up / order.sampling.dt), order.news.put)
    gc.freeze()
    while True:
        while order.inbox.poll():
            crew.follow(order.inbox.recv(), rows.count)
        newest = ring.count
        if crew.is_idle or newest - rows.count > CAPACITY - BATCH:
            crew.reset()
            rows.skip_to(-(-newest // crew.ratio) * crew.ratio)
        stop = min(newest, rows.count + BATCH)
        while rows.count < stop and (frame := ring.read(rows.count)) is not None:
            rows.write(crew.take(frame, rows.count))
        if rows.count >= newest:
            sleep(LOOK)
