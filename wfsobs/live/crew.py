"""What runs beside a live loop, frame by frame: crews of observers, and of controllers with the plant they act on."""

from __future__ import annotations

import gc
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.queues import Queue
from multiprocessing.synchronize import BoundedSemaphore
from time import monotonic, sleep
from typing import Any, Generic, TypeVar

import numpy as np

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.step import StepController
from wfsobs.control.supervisor import SupervisedController, Supervision
from wfsobs.control.true_plant import ActingLoop, TruePlant
from wfsobs.live.board import NEXT, SCORED, SLOTS, Board, rms_of_known, slot_width, trace_width
from wfsobs.live.ring import CAPACITY, LiveFrame, Ring, Rows
from wfsobs.live.source import ALARM, Command, LiveEvent, enter_process, receive
from wfsobs.observers.base import TARGETS
from wfsobs.observers.step import StepError, StepObserver
from wfsobs.record import Sampling, fuse_frames
from wfsobs.streams.follower import EDGES
from wfsobs.typing import Array

D = TypeVar("D", StepObserver, "Beside")

TRUTHS = (*TARGETS, NEXT, "ngs")
"""What errors are against: that of both targets together is the sum of theirs, that of the next measurement is from both."""
ROOM = 1 << 14
"""Rows of estimates or residuals that are kept: a quarter of a minute at 1 kHz."""
COUNTED = 64
"""Frames that are counted together at most."""


@dataclass(frozen=True)
class Site:
    """What the processes of crews have in common.

    settings : of the scenario that observers and controllers are told of
    sampling : modes, step and NGS ratio of the source
    ring_name, board_name : shared memory
    news     : events
    wakes    : semaphores of the crews of observers, released with every frame
    """

    settings: Mapping[str, Any]
    sampling: Sampling
    ring_name: str
    board_name: str
    news: Queue[LiveEvent]
    wakes: Sequence[BoundedSemaphore] = ()


def warm_up_of(site: Site) -> int:
    """Return the frames of an observer or a controller before the first that counts."""
    return round(site.settings["run"]["warm_up"] / site.sampling.dt)


class Crew(ABC, Generic[D]):
    """What runs in one process, by id.

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
        self._active: dict[str, D] = {}
        self._waiting: dict[str, D] = {}

    def follow(self, command: Command, number: int) -> None:
        """Switch a member off, or a new design on, which goes on where the one before is."""
        name, design = command["id"], command["design"]
        if design is None:
            self._waiting.pop(name, None)
            if self._active.pop(name, None) is not None:
                self._clear(name)
                self._say(LiveEvent(number, "{} off", name))
        elif (before := self._active.get(name)) is None:
            self._waiting[name] = design
        else:
            try:
                design.take_over(before)
            except StepError as error:
                self._waiting[name] = design
                self._say(LiveEvent(number, "{} restarted", name, f": {error}"))
            else:
                self._active[name] = design
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
    def _clear(self, name: str) -> None:
        """Clear what one had that is off."""


class ObserverCrew(Crew[StepObserver]):
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
        self._has_ngs = sampling.ratio is not None
        self._list_running()
        self._past, self._past_z = np.full((self.ratio, n, m), np.nan), np.full((self.ratio - 1, m), np.nan)

    def take(self, frame: LiveFrame, number: int) -> Array:
        """Have every observer take a frame; return the row of their estimates. `settle` follows once that is written.

        Raises StepError, as `settle` does, where an observer ends in an error.
        """
        if self._waits == COUNTED:
            self.count()
        self._start_waiting(number)
        ngs = None if np.isnan(frame.ngs[0]) else frame.ngs
        before = monotonic()
        for slot, observer, outs in self._followers:
            # u goes to those alone that need it, and no NGS measurement to a first frame
            u = frame.u if observer.estimator.needs_command else None
            observer.update(frame.z, ngs if observer.frame else None, u)
            for target, out in outs:
                out[:] = observer.predict(0, target)[0]
            now = monotonic()
            self._times[slot], before = now - before, now
        self._row[:2] = number, before - float(frame.due)
        self._rows[self._waits].reshape(-1)[:], truth = self._row[2:], self._truth[self._waits]
        truth[0], truth[1], truth[2], truth[3] = frame.turbulence, frame.vibration, frame.z, frame.ngs
        self._waits += 1
        return self._row

    def settle(self) -> None:
        """Have those learn that learn from every frame."""
        for observer in self._active.values():
            observer.settle()

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
        np.add.at(board.histogram, (running, np.searchsorted(EDGES, spent)), 1)
        board.late[running, 0] += (spent > self._dt).sum(axis=0)
        board.frames[running] += n
        errors = self._errors(estimates, self._truth[:n])
        is_known = errors == errors
        errors[~is_known] = 0.0
        board.squares[running] += (errors * errors).sum(axis=0)  # the other crew writes its own rows
        board.samples[running] += is_known.sum(axis=0)

    def _errors(self, estimates: Array, truth: Array) -> Array:
        """Return errors, NaN during a warm-up, (at least n, running observers, len(SCORED), n_modes) [um].

        Those of the next measurement that an NGS frame tells are of the frames before, too.
        """
        before, running = len(self._past_z), self._running
        totals = np.concatenate((self._past[:, running], estimates.sum(axis=2)))
        z = np.concatenate((self._past_z, truth[:, 2]))
        out = np.full((len(z), len(running), len(SCORED), truth.shape[2]), np.nan)
        np.subtract(estimates, truth[:, None, :2], out=out[before:, :, :2])
        frames = np.concatenate((np.full_like(self._past_z, np.nan), truth[:, 3]))
        seen = fuse_frames(z, frames, self.ratio) if self._has_ngs else z
        np.subtract(totals[:-1], seen[:, None], out=out[:, :, 2])
        np.add(out[:, :, 0], out[:, :, 1], out=out[:, :, 3])
        self._past[:, running], self._past_z = totals[len(truth) :], z[len(truth) :]
        for at, observer in enumerate(self._active.values()):
            out[: max(0, len(z) - max(0, observer.frame - self._warm_up)), at] = np.nan
        return out

    def lose(self, count: int) -> None:
        """Start anew after frames that were overwritten."""
        self.count()
        self._board.losses[self._place] += count
        self._board.progress[self._place] += count
        self._past[:] = self._past_z[:] = np.nan
        for observer in self._active.values():
            observer.reset()

    def follow(self, command: Command, number: int) -> None:
        """Switch an observer off, or a new design on, which goes on where the one before is."""
        self.count()
        super().follow(command, number)
        self._list_running()

    def _clear(self, name: str) -> None:
        slot = SLOTS.index(name)
        self._estimates[slot] = self._times[slot] = self._past[:, slot] = np.nan
        self._board[name].since[0] = -1

    def start(self, name: str, design: StepObserver, number: int) -> None:
        """Let an observer follow from a frame on."""
        self.count()
        counts = self._board[name]
        counts.clear()
        counts.since[0] = number
        self._past[:, SLOTS.index(name)] = np.nan
        self._active[name] = design
        self._active = {slot: self._active[slot] for slot in SLOTS if slot in self._active}
        self._list_running()

    def _list_running(self) -> None:
        """Note the slots of those that run, and where each writes its estimates."""
        slots = [SLOTS.index(name) for name in self._active]
        self._running = np.array(slots, dtype=np.intp)
        self._followers = [
            (slot, observer, [(target, self._estimates[slot, TARGETS.index(target)]) for target in observer.targets])
            for slot, observer in zip(slots, self._active.values(), strict=True)
        ]


class Beside:
    """One loop on the frames of a source.

    Parameters
    ----------
    controller : StepController
        Before its first frame.
    plant : TruePlant
        As it is, its optical gain aside.
    rng : numpy.random.Generator
        Of delays and losses of commands.
    supervision : Supervision or None
        When an integrator takes over; None for never.

    Attributes
    ----------
    loop : ActingLoop
        It.
    """

    controller: StepController
    supervisor: SupervisedController | None

    def __init__(self, controller: StepController, plant: TruePlant, rng: np.random.Generator, supervision: Supervision | None):
        self.controller, self._rng = controller, rng
        self.supervisor = SupervisedController(controller, supervision) if supervision else None
        self._plant = plant
        self.loop: ActingLoop = self._at_rest()

    def _at_rest(self) -> ActingLoop:
        return ActingLoop(self.supervisor or self.controller, self._plant, self.controller.sampling.ratio)

    @property
    def id(self) -> str:
        """Id of the controller."""
        return self.controller.id

    @property
    def reason(self) -> str:
        """Why an integrator closes the loop; "" while the controller does."""
        return self.supervisor.reason if self.supervisor else ""

    def take(self, z: Array, ngs: Array | None) -> None:
        """Take the measurements of the disturbance alone of a frame, (n_modes,) [um]."""
        late, is_lost = self._plant.jitter * self._rng.uniform(-1.0, 1.0), self._rng.uniform() < self._plant.loss
        self.loop.take(z, ngs if self.controller.frame else None, late=late, is_lost=is_lost)
        self.controller.settle()

    def take_over(self, old: Beside) -> None:
        """Go on where another design of the same controller is, with the mirror where that has it. Raises StepError."""
        if self.supervisor and old.supervisor:
            self.supervisor.take_over(old.supervisor)
        elif self.supervisor or old.supervisor:
            raise StepError("its supervision is another")
        else:
            self.controller.take_over(old.controller)
        self.loop.go_on(old.loop)

    def reset(self) -> None:
        """Start anew, the mirror at rest."""
        (self.supervisor or self.controller).reset()
        self.loop = self._at_rest()


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


class ControlCrew(Crew[Beside]):
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
        """Have every controller take a frame; return the row of what they leave.

        A controller that diverges or ends in an error is switched off.
        """
        self._start_waiting(number)
        ngs = None if np.isnan(frame.ngs[0]) else frame.ngs
        disturbance = frame.turbulence + frame.vibration
        self._row[0] = number
        for name, member in list(self._active.items()):
            seat, controller = SEATS.index(name), member.controller
            measured = frame.z + member.loop.correction
            try:
                member.take(frame.z, ngs)
                self._tell_reason(name, member, number)
                end = LiveEvent(number, "{} diverges", name, kind=ALARM) if member.loop.has_diverged else None
            except StepError as error:
                end = LiveEvent(number, str(error), kind=ALARM)
            if end:
                self.follow({"id": name, "design": None}, number)
                self._say(end)
                continue
            left = disturbance + member.loop.correction
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

    def _clear(self, name: str) -> None:
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
            crew.follow(receive(inbox), rows.count)
        newest = ring.count
        if crew.is_idle or newest - rows.count > CAPACITY - BATCH:
            crew.reset()
            rows.skip_to(-(-newest // crew.ratio) * crew.ratio)
        stop = min(newest, rows.count + BATCH)
        while rows.count < stop and (frame := ring.read(rows.count)) is not None:
            rows.write(crew.take(frame, rows.count))
        if rows.count >= newest:
            sleep(LOOK)
