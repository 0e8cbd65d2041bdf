"""Controllers beside a live loop: what each would have left of the same disturbance, and the last seconds of it."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from time import sleep

import numpy as np

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.live.beside import Beside
from wfsobs.live.crew import ROOM, Crew, Site, warm_up_of
from wfsobs.live.paced import ALARM, LiveEvent, enter_process
from wfsobs.live.ring import CAPACITY, LiveFrame, Ring
from wfsobs.live.rows import Rows
from wfsobs.live.view import rms_of_known
from wfsobs.record import Sampling
from wfsobs.typing import Array

LOOK = 0.05
"""Pause between two looks at the ring [s]: nobody waits for a residual."""
BATCH = 200
"""Frames between two looks at the commands."""
NICENESS = 5
"""Of the process: observers go first."""

SEATS = tuple(c.id for c in CONTROLLERS.values() if c.predict is None or c.step_predict is not None)
"""Controllers that run frame by frame; each has its place in a row."""

USUAL = ("none", "integrator", "lqg-kf-multi", "lqg-multirate-multi")
"""Controllers that run unless others are named."""


def row_width(n_modes: int) -> int:
    """Return the width of a row: number of the frame, and what each controller has."""
    return 1 + len(SEATS) * seat_width(n_modes)


def seat_width(n_modes: int) -> int:
    """Return the width of what a controller has in a row: residuals [um], sums of their squares since its start, their number."""
    return 2 * n_modes + 1


class ControlCrew(Crew[Beside, Beside]):
    """The controllers of one process."""

    def __init__(self, sampling: Sampling, warm_up: int, say: Callable[[LiveEvent], None]):
        super().__init__(sampling, warm_up, say)
        m = sampling.n_modes
        self._row = np.full(row_width(m), np.nan)
        seats = self._row[1:].reshape(len(SEATS), seat_width(m))
        self._left, self._squares, self._counts = seats[:, :m], seats[:, m:-1], seats[:, -1]  # views of the row
        self._reasons: dict[str, str] = {}

    @property
    def is_idle(self) -> bool:
        """Whether there is no controller."""
        return not (self._active or self._waiting)

    def take(self, frame: LiveFrame, number: int) -> Array:
        """Have every controller take a frame; return the row of what they leave."""
        self._start_waiting(number)
        ngs = None if np.isnan(frame.ngs[0]) else frame.ngs
        disturbance = frame.turbulence + frame.vibration
        self._row[0] = number
        for name, member in list(self._active.items()):
            seat, controller = SEATS.index(name), member.controller
            measured = frame.z + member.correction
            member.take(frame.z, ngs)
            self._tell_reason(name, member, number)
            if member.has_diverged:
                self.follow({"id": name, "design": None}, number)
                self._say(LiveEvent(number, "{} diverges", name, kind=ALARM))
                continue
            left = disturbance + member.correction
            # without truth, what its sensor would have seen
            self._left[seat] = left = np.where(np.isnan(left), measured, left)
            if controller.frame > self._warm_up and not np.isnan(left).any():
                self._squares[seat] += left * left
                self._counts[seat] += 1
        return self._row

    def reset(self) -> None:
        """Start anew: frames were overwritten."""
        for member in self._active.values():
            member.reset()

    def _tell_reason(self, name: str, member: Beside, number: int) -> None:
        """Tell when an integrator takes over, and when the controller has its loop back."""
        before, now = self._reasons.get(name, member.reason), member.reason
        self._reasons[name] = now
        if now not in ("", "start", before):
            self._say(LiveEvent(number, "integrator in place of {}", name, f": {now}", kind=ALARM))
        elif before and not now:
            self._say(LiveEvent(number, "{} has its loop", name))

    def start(self, name: str, design: Beside, number: int) -> None:
        """Let a controller run from a frame on."""
        self._fill(name, 0.0)
        self._active[name] = design

    def _swap(self, name: str, member: Beside, design: Beside) -> None:
        design.take_over(member)
        self._active[name] = design

    def _clear(self, name: str, member: Beside) -> None:
        self._reasons.pop(name, None)
        self._fill(name, np.nan)

    def _fill(self, name: str, value: float) -> None:
        seat = SEATS.index(name)
        self._left[seat] = np.nan
        self._squares[seat] = self._counts[seat] = value


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


def control_frames(site: Site, rows_name: str, inbox: Connection) -> None:
    """Follow a ring until the process is ended; it may lag behind the frames."""
    enter_process(NICENESS)
    sampling = site.sampling
    ring, rows = Ring(sampling.n_modes, site.ring_name), Rows(row_width(sampling.n_modes), ROOM, rows_name)
    crew = ControlCrew(sampling, warm_up_of(site), site.news.put)
    gc.freeze()
    while True:
        while inbox.poll():
            crew.follow(inbox.recv(), rows.count)
        newest = ring.count
        if crew.is_idle or newest - rows.count > CAPACITY - BATCH:
            crew.reset()
            rows.skip_to(-(-newest // crew.ratio) * crew.ratio)
        stop = min(newest, rows.count + BATCH)
        while rows.count < stop and (frame := ring.read(rows.count)) is not None:
            rows.write(crew.take(frame, rows.count))
        if rows.count >= newest:
            sleep(LOOK)
