"""Sources of frames, in processes of their own, by the clock: a simulation, a record, a stream; and the events they tell."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import parent_process, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.queues import Queue
from multiprocessing.synchronize import BoundedSemaphore
from threading import Thread
from time import monotonic, sleep
from typing import Any, NamedTuple, Protocol

import numpy as np

from wfsobs.live.ring import Ring
from wfsobs.record import Record, Sampling
from wfsobs.typing import Array

IDLE = 0.05
"""Pause between two looks at the commands while nothing is sent [s]."""
LOOK = 0.01
"""Pause between two looks at the commands while frames are sent [s]."""
STALL = 1.0
"""Delay beyond which the frames in between are given up, and the clock starts anew [s]."""

SOURCE = 4
"""Turn of the source: what takes least goes first, and delays the others least; those of the crews follow, the last is 1."""

Command = Mapping[str, Any]
"""What a process of a live loop is told: one word and what belongs to it."""

ALARM, FAILURE = "ALARM", "failure"
"""Kinds of events: something is not as it was; observers cannot follow."""


class LiveEvent(NamedTuple):
    """An event of a live loop.

    Attributes
    ----------
    frame : int
        Number of the first frame of it.
    what : str
        What has happened, in a few words; "{}" stands for `about`.
    about : str
        Id of the observer or controller that it is about.
    detail : str
        Numbers that follow, with the punctuation before them.
    origin : str
        Path or address of the stream that it is of.
    kind : str
        ALARM, FAILURE or "".
    """

    frame: int
    what: str
    about: str = ""
    detail: str = ""
    origin: str = ""
    kind: str = ""

    def words(self, name: str) -> str:
        """Return what has happened, with a name for `about`."""
        words = self.what.replace("{}", name) if self.about else self.what
        return f"{ALARM} {words}" if self.kind == ALARM else words

    def text(self, name: str) -> str:
        """Return all of it in one line, with a name for `about`."""
        return f"{self.origin}: {self.words(name)}{self.detail}" if self.origin else self.words(name) + self.detail

    @property
    def line(self) -> str:
        """All of it in one line."""
        return self.text(self.about)


@dataclass(frozen=True)
class Desk:
    """Where a process of a source finds its work, and says what happens.

    ring_name, n_modes : of the ring that it writes
    news  : events
    speed : at the start, 1 is real time
    n_frames : after which it ends; None for no end
    wakes : semaphores of the crews of observers, released with every frame
    """

    ring_name: str
    n_modes: int
    news: Queue[LiveEvent]
    speed: float
    n_frames: int | None
    wakes: Sequence[BoundedSemaphore] = ()

    def say(self, number: int, what: str, origin: str = "") -> None:
        """Tell what happens from a frame on."""
        self.news.put(LiveEvent(number, what, origin=origin))

    def wake(self) -> None:
        """Wake the crews that wait for the frame that has been written."""
        for one in self.wakes:
            with suppress(ValueError):  # at its maximum: this crew is not waiting
                one.release()


class Worker:
    """A process of a live loop.

    Parameters
    ----------
    context : SpawnContext
        By which it is made.
    name : str
        For people.
    work : callable
        Receives the arguments, and last its end of a pipe.
    *arguments
        Of these, queues are kept as long as the worker is: their locks live no longer than they do.

    Attributes
    ----------
    process : BaseProcess
        It.
    pipe : Connection
        This end of its pipe.
    """

    process: BaseProcess
    pipe: Connection

    def __init__(self, context: SpawnContext, name: str, work: Callable[..., None], *arguments: object):
        self.pipe, theirs = context.Pipe()
        self._queues = [it for it in arguments if isinstance(it, Queue)]
        self.process = context.Process(target=work, args=(*arguments, theirs), name=name, daemon=True)
        with _without_interrupts():
            self.process.start()

    def tell(self, command: Command) -> None:
        """Give it a command; where it has ended, nothing."""
        with suppress(OSError):
            self.pipe.send(command)

    def stop(self) -> None:
        """End it, and wait for it."""
        self.process.terminate()
        self.process.join(5)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(5)


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Have what starts here never see Ctrl+C, which would come before it ignores that; where the system has no masks, nothing."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # whose start would let them through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class Pace:
    """The clock of a source.

    Parameters
    ----------
    dt : float
        Time between two frames at the speed 1 [s].
    speed : float
        1 is real time.
    """

    def __init__(self, dt: float, speed: float):
        self._dt, self._speed, self._steps, self._due = dt, speed, 0, 0.0
        self.is_playing = False

    @property
    def runs(self) -> bool:
        """Whether a frame is to be sent."""
        return self.is_playing or self._steps > 0

    def take(self, command: Command) -> None:
        """Follow a command about the clock: "play", "step", "speed"."""
        was_running = self.runs
        self.is_playing: Any = command.get("play", self.is_playing)
        self._steps += command.get("step", 0)
        self._speed = command.get("speed", self._speed)
        if self.runs and not was_running:
            self._due = monotonic() + self._dt / self._speed

    def due(self) -> float:
        """Return when the next frame is due, on the monotonic clock [s]."""
        now = monotonic()
        if now - self._due > STALL:
            self._due = now
        return self._due

    def advance(self) -> None:
        """Count a frame."""
        self._due += self._dt / self._speed
        self._steps = max(0, self._steps - 1)


def send_frames(
    desk: Desk, inbox: Connection, next_row: Callable[[int], Array | None], take: Callable[[Command], str], dt: float
) -> None:
    """Write frames of a source without a clock to the ring when they are due, until there are no more.

    Parameters
    ----------
    desk, inbox
        What there is to do, and commands.
    next_row : callable
        Returns z, ngs, u, turbulence and vibration of the frame of a number, (5 n_modes,) [um]; None after the last one.
    take : callable
        Follows a command about the frames to come; returns a line for the list of events, or "".
    dt : float
        Time between two frames at the speed 1 [s].
    """
    ring, pace, number = Ring(desk.n_modes, desk.ring_name), Pace(dt, desk.speed), 0
    row, rest = np.empty(1 + 5 * desk.n_modes), next_row(0)
    gc.collect()
    gc.freeze()
    look = 0.0
    while number != desk.n_frames and rest is not None:
        if not pace.runs or monotonic() >= look:
            while inbox.poll(0 if pace.runs else IDLE):
                command = receive(inbox)
                pace.take(command)
                if line := take(command):
                    desk.say(number, line)
            look = monotonic() + LOOK
        if not pace.runs:
            continue
        row[0] = due = pace.due()
        row[1:] = rest
        if (wait := due - monotonic()) > 0:
            sleep(wait)
        ring.send(row)
        desk.wake()
        number += 1
        pace.advance()
        rest = next_row(number)
    if rest is None:
        desk.say(number, "the record has ended")
    ring.close_writer()


def enter_process(niceness: int = 0, *, turn: int = 0) -> None:
    """Set up a process of a live loop: it ends with the one that started it, to which alone Ctrl+C goes.

    niceness : of one that may wait;  turn : as in `go_first`, of one that keeps time
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prefer(niceness)
    if turn:
        go_first(turn)
    parent = parent_process()
    assert parent is not None

    def end() -> None:
        parent.join()
        os._exit(1)

    Thread(target=end, daemon=True).start()


def receive(pipe: Connection) -> Any:
    """Return what comes by a pipe from the process that started this one; without that process, end."""
    try:
        return pipe.recv()
    except (EOFError, OSError):
        raise SystemExit(1) from None


def prefer(niceness: int) -> None:
    """Give the calling thread, and what it starts, a niceness, where the system lets it: below 0 it runs before others that wait.

    Only root, and who has CAP_SYS_NICE, may lower it.
    """
    with suppress(AttributeError, OSError):  # another system, or no right to it
        os.setpriority(os.PRIO_PROCESS, 0, niceness)


def go_first(turn: int) -> bool:
    """Have this process run as soon as it has something to do, before all of a lower turn; return whether the system lets it.

    Turns are those of the real-time policy of Linux, which root may take, who has CAP_SYS_NICE, and others as far as
    RLIMIT_RTPRIO says; 0 is the usual policy.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR if turn else os.SCHED_OTHER, os.sched_param(turn))
    except (AttributeError, OSError):  # another system, or no right to it
        return False
    return True


def may_go_first() -> bool:
    """Return whether the system lets processes like this one go first; its own turn is the usual one afterwards."""
    may = go_first(SOURCE)
    go_first(0)
    return may


SIMULATION, RECORD, STREAM = "simulation", "record", "stream"
"""Names of sources."""


class LiveSource(Protocol):
    """A source before it runs: what its processes are told, and nothing that lives."""

    @property
    def name(self) -> str:
        """What it is, in a word or two."""
        ...

    @property
    def has_truth(self) -> bool:
        """Whether its frames have the truth."""
        ...

    @property
    def sampling(self) -> Sampling:
        """Modes, step and NGS ratio."""
        ...

    def staff(self, context: SpawnContext, desk: Desk) -> list[Worker]:
        """Begin its processes; that which writes the ring is the last one."""
        ...


class SourceProcess:
    """A source that runs.

    Parameters
    ----------
    source : LiveSource
        Which.
    context : SpawnContext
        By which its processes are made.
    news : queue
        Receives events.
    wakes : sequence of BoundedSemaphore
        Released with every frame.
    speed : float
        1 is real time.
    n_frames : int or None
        Frames until it ends; None for no end.

    Attributes
    ----------
    ring : Ring
        Its frames.
    workers : list of Worker
        That which writes the ring is the last one.
    """

    ring: Ring

    def __init__(
        self,
        source: LiveSource,
        context: SpawnContext,
        news: Queue[LiveEvent],
        wakes: Sequence[BoundedSemaphore],
        speed: float,
        n_frames: int | None,
    ):
        os.environ["OPENBLAS_NUM_THREADS"] = "1"  # read by the processes
        n_modes = source.sampling.n_modes
        self.ring = Ring(n_modes)
        self.workers: list[Worker] = source.staff(context, Desk(self.ring.name, n_modes, news, speed, n_frames, wakes))

    def tell(self, command: Command) -> None:
        """Give a command to the process that sends; new settings to the others as well."""
        for worker in self.workers if command.get("is_new") else self.workers[-1:]:
            worker.tell(command)

    @property
    def is_alive(self) -> bool:
        """Whether frames may follow."""
        return self.workers[-1].process.is_alive() and not self.ring.is_closed

    def stop(self) -> None:
        """End the processes and give the memory back."""
        for worker in self.workers:
            worker.stop()
        self.ring.release()


@dataclass(frozen=True)
class Replay:
    """A record as a source.

    Attributes
    ----------
    record : Record
        Measurements and commands, with the truth where it is known.
    """

    record: Record
    name = RECORD

    @property
    def has_truth(self) -> bool:
        """Whether the record has the truth."""
        return self.record.turbulence is not None

    @property
    def sampling(self) -> Sampling:
        """Modes, step and NGS ratio."""
        return self.record.sampling

    def staff(self, context: SpawnContext, desk: Desk) -> list[Worker]:
        """Begin its process."""
        return [Worker(context, "the source", _send, frame_rows(self.record), self.record.dt, desk)]


def frame_rows(record: Record) -> Array:
    """Return z, ngs, u, turbulence and vibration of every frame, (n_steps, 5 n_modes) [um]; NaN where there is none."""
    record = record.without_outliers
    nothing = np.full_like(record.z, np.nan)
    ngs = nothing if record.y_ngs is None else record.z_ngs
    truth = [nothing if part is None else part for part in (record.turbulence, record.vibration)]
    return np.hstack([record.z, ngs, record.u, *truth])


def _send(rows: Array, dt: float, desk: Desk, inbox: Connection) -> None:
    enter_process(turn=SOURCE)

    def next_row(number: int) -> Array | None:
        return rows[number] if number < len(rows) else None

    def refuse(command: Command) -> str:
        return "a record cannot be changed" if "line" in command else ""

    send_frames(desk, inbox, next_row, refuse, dt)
