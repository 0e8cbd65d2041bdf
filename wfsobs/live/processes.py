"""The processes of a live loop and their shared memory: made together, ended together."""

from __future__ import annotations

import gc
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess
from queue import Empty
from signal import Signals
from threading import Event, Lock, RLock
from time import monotonic
from typing import Any

from wfsobs.live.board import CREWS, SLOTS, Board, Delivery, LiveView, crew_of, last_frames, read_view, trace_width
from wfsobs.live.crew import ROOM, ControlView, ObserverCrew, Site, control_frames, row_width, warm_up_of
from wfsobs.live.ring import LiveFrame, Ring, Rows, Tracker, merged_rows
from wfsobs.live.source import (
    FAILURE,
    SOURCE,
    Command,
    LiveEvent,
    LiveSource,
    SourceProcess,
    Worker,
    enter_process,
    go_first,
    may_go_first,
    receive,
)
from wfsobs.observers.step import Naming, StepError
from wfsobs.scenario import Scenario
from wfsobs.stepping import design

HOPELESS = 1.0
"""Frames that a process may be behind [s] before it gives way to others: it cannot keep up."""
LOOK = 0.01
"""Pause between two looks at the commands, and the longest wait for a frame [s]."""


def observe_frames(
    site: Site, traces_name: str, place: int, observers: tuple[str, ...], joins_late: bool, inbox: Connection
) -> None:
    """Follow a ring until the process is ended.

    Parameters
    ----------
    site : Site
        What all have in common.
    traces_name : str
        Shared memory of the estimates.
    place : int
        Of the crew in CREWS.
    observers : tuple of str
        Ids of those that run from the start.
    joins_late : bool
        Whether it begins with the newest frame, as others run already; else with the first.
    inbox : Connection
        Commands.
    """
    enter_process()
    try:
        _follow_ring(site, traces_name, place, observers, joins_late, inbox)
    except StepError as error:
        site.news.put(LiveEvent(0, str(error), kind=FAILURE))


def _follow_ring(
    site: Site, traces_name: str, place: int, observers: tuple[str, ...], joins_late: bool, inbox: Connection
) -> None:
    """Follow a ring. Raises StepError where an observer has no design, or ends in an error."""
    sampling = site.sampling
    ring, board = Ring(sampling.n_modes, site.ring_name), Board(sampling.n_modes, site.board_name)
    traces = Rows(trace_width(sampling.n_modes), ROOM, traces_name)
    crew = made_crew(site, board, place, observers)
    gc.collect()
    gc.freeze()
    go_first(SOURCE - 1 - place)  # after the designs, which must not delay the crews that run
    number = -(-ring.count // crew.ratio) * crew.ratio if joins_late else 0
    traces.skip_to(number)
    board.progress[place] = number
    board.is_ready[place] = 1
    look = 0.0
    while True:
        if (now := monotonic()) >= look:
            look = now + LOOK
            if (ring.count - number) * sampling.dt > HOPELESS:
                go_first(0)
            crew.count()
            while inbox.poll():
                crew.follow(receive(inbox), number)
        if ring.count <= number:
            site.wakes[place].acquire(timeout=LOOK)
            continue
        if (frame := ring.read(number)) is None:
            newest = ring.count // crew.ratio * crew.ratio
            crew.lose(newest - number)
            traces.skip_to(newest)
            number = newest
            continue
        traces.write(crew.take(frame, number))
        crew.settle()
        number += 1


def made_crew(site: Site, board: Board, place: int, observers: tuple[str, ...]) -> ObserverCrew:
    """Return a crew with the observers that run from the start. Raises StepError where one has no design."""
    scenario = Scenario.from_dict(dict(site.settings))
    crew = ObserverCrew(site.sampling, warm_up_of(site), board, place, site.news.put)
    for name in observers:
        with Naming(name):
            crew.start(name, design(name, scenario, sampling=site.sampling), 0)
    return crew


class CrewProcess(Worker):
    """A process that follows the frames: observers or controllers.

    Parameters
    ----------
    context, name
        As of a Worker.
    width : int
        Of a row of what it writes.
    work : callable
        Receives site, name of the rows, the further arguments, and its end of a pipe.
    site : Site
        Where.
    *more
        Further arguments.

    Attributes
    ----------
    rows : Rows
        Its estimates or residuals.
    """

    def __init__(self, context: SpawnContext, name: str, width: int, work: Callable[..., None], site: Site, *more: object):
        self.rows: Rows = Rows(width, ROOM)
        super().__init__(context, name, work, site, self.rows.name, *more)

    def stop(self) -> None:
        """End it and give the memory back."""
        super().stop()
        self.rows.release()


class LiveProcesses:
    """Source, observers, and a workshop for what is made beside them.

    Parameters
    ----------
    source : LiveSource
        Of the frames.
    scenario : Scenario
        What the observers are told.
    observers : tuple of str
        Ids of those that run from the start.
    speed : float
        1 is real time.
    n_frames : int or None
        Frames until the source ends; None for no end.

    Attributes
    ----------
    feed : SourceProcess
        The source.
    board : Board
        What is counted of the observers.
    delivery : Delivery
        What is counted of the frames.
    controllers : CrewProcess or None
        Begun with the first controller.
    workshop : SideProcess
        For what is made beside them.
    is_over : threading.Event
        Whether all has ended.
    """

    feed: SourceProcess
    is_over: Event
    board: Board

    def __init__(self, source: LiveSource, scenario: Scenario, observers: tuple[str, ...], speed: float, n_frames: int | None):
        self._context, self._tracker, self.is_over, self._lock = get_context("spawn"), Tracker(), Event(), RLock()
        news = self._context.Queue()
        wakes = tuple(self._context.BoundedSemaphore() for _ in CREWS)
        self.feed = SourceProcess(source, self._context, news, wakes, speed, n_frames)
        self.board = Board(source.sampling.n_modes)
        self._site = Site(scenario.to_dict(), source.sampling, self.feed.ring.name, self.board.name, news, wakes)
        self.crews: dict[int, CrewProcess] = {}
        self._late: set[int] = set()
        self.controllers: CrewProcess | None = None
        for place in range(len(CREWS)):
            own = tuple(name for name in observers if crew_of(name) == place)
            if own or not place:
                self._start_crew(place, own)
        self.delivery: Delivery = Delivery(self.feed.ring, self.board, self._parts)
        self.workshop: SideProcess = SideProcess(self._context)

    def _start_crew(self, place: int, observers: tuple[str, ...], *, joins_late: bool = False) -> CrewProcess:
        if joins_late:
            self._late.add(place)
        name, width = f"the observers ({CREWS[place]})", trace_width(self._site.sampling.n_modes)
        crew = CrewProcess(self._context, name, width, observe_frames, self._site, place, observers, joins_late)
        self.crews[place] = crew
        return crew

    def _parts(self) -> dict[int, Rows]:
        """Return the estimates of the crews without which no frame is taken by all: those that began late once they are ready."""
        return {k: crew.rows for k, crew in list(self.crews.items()) if self.board.is_ready[k] or k not in self._late}

    def traces(self) -> list[Rows]:
        """Return the estimates of the crews that take part."""
        return list(self._parts().values())

    def frames(self, seconds: float) -> tuple[int, LiveFrame]:
        """Return the number of the first of the last so many seconds of frames that the source has sent, and these frames."""
        ring = self.feed.ring
        first, stop = last_frames(ring.count, self._site.sampling.dt, seconds)
        return first, ring.read_frames(first, stop)

    def views(self, seconds: float) -> list[tuple[LiveView, list[str]]]:
        """Return the last so many seconds that each process of observers has taken, and the ids of its observers that run."""
        ring, sampling, running = self.feed.ring, self._site.sampling, self.board.active()
        crews = [(crew, [name for name in running if crew_of(name) == place]) for place, crew in list(self.crews.items())]
        return [(read_view(ring, [crew.rows], sampling, seconds), names) for crew, names in crews if names]

    def control_view(self, seconds: float) -> ControlView | None:
        """Return what the controllers leave of the last so many seconds that they have taken; None before the first one."""
        if self.controllers is None:
            return None
        rows, dt = self.controllers.rows, self._site.sampling.dt
        first, stop = last_frames(rows.count, dt, seconds)
        return ControlView(first, dt, merged_rows([rows], first, stop))

    @property
    def are_ready(self) -> bool:
        """Whether the observers that take part are ready for the first frame."""
        return all(self.board.is_ready[place] for place in self._parts())

    @property
    def observers_are_alive(self) -> bool:
        """Whether the observers take what comes."""
        return not self.is_over.is_set() and all(crew.process.is_alive() for crew in list(self.crews.values()))

    @property
    def processes(self) -> list[BaseProcess]:
        """All that have begun."""
        return [worker.process for worker in (*self.feed.workers, *self._followers(), *filter(None, [self.workshop.worker]))]

    def _followers(self) -> list[CrewProcess]:
        """Return all that follow the frames."""
        return [*self.crews.values(), *filter(None, [self.controllers])]

    def failure(self) -> str:
        """Return one line that names the processes that have ended otherwise than by themselves; "" without one."""
        lines = []
        for process in self.processes:
            if status := process.exitcode:
                cause = f"an error, exit status {status}" if status > 0 else f"signal {-status} ({Signals(-status).name})"
                lines.append(f"the process of {process.name} ({process.pid}) was ended by {cause}")
        if self._tracker.is_gone:
            lines.append("the resource tracker of Python was killed")
        return f"live: {'; '.join(lines)}" if lines else ""

    def tell(self, command: Command) -> None:
        """Give a command to the process of the observer or controller that it is about, which begins with its first one."""
        place = crew_of(command["id"]) if command["id"] in SLOTS else None
        with self._lock:
            crew = self.controllers if place is None else self.crews.get(place)
            if self.is_over.is_set() or (crew is None and command["design"] is None):
                return
            if place is None:
                width = row_width(self._site.sampling.n_modes)
                crew = crew or CrewProcess(self._context, "the controllers", width, control_frames, self._site)
                self.controllers = crew
            else:
                crew = crew or self._start_crew(place, (), joins_late=True)
            crew.tell(command)

    def news(self) -> list[LiveEvent]:
        """Return the events since the last call."""
        out = []
        with suppress(Empty):
            while True:
                out.append(self._site.news.get_nowait())
        return out

    def release(self) -> None:
        """End the processes and give the memory back."""
        with self._lock:
            self.is_over.set()
        self.delivery.collect()
        self._tracker.release()
        for crew in self._followers():
            crew.stop()
        self.workshop.stop()
        self.feed.stop()
        self.board.release()


class SideProcess:
    """A process at low priority that computes one thing after the other; it begins with the first.

    Parameters
    ----------
    context : SpawnContext
        By which it is made.

    Attributes
    ----------
    worker : Worker or None
        It, once it has begun.
    """

    def __init__(self, context: SpawnContext):
        self.worker: Worker | None = None
        self._context, self._lock, self._asker = context, Lock(), ThreadPoolExecutor(1, "wfsobs-live-side")
        self._has_ended = False

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Have a function computed; return the result to come, which is cancelled where all has ended."""
        with self._lock:
            if self._has_ended:
                (ended := Future[Any]()).cancel()
                return ended
            if self.worker is None:
                self.worker = Worker(self._context, "the designs", compute)
            return self._asker.submit(_ask, self.worker.pipe, function, arguments)

    def stop(self) -> None:
        """End it."""
        with self._lock:
            self._has_ended = True
            self._asker.shutdown(wait=False, cancel_futures=True)
            if self.worker is not None:
                self.worker.stop()


def _ask(pipe: Connection, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Return the result of a function. Raises what it raises, and EOFError where the process has ended."""
    try:
        pipe.send((function, arguments))
        answer = pipe.recv()
    except OSError:
        raise EOFError from None
    if isinstance(answer, Exception):
        raise answer
    return answer


def compute(pipe: Connection) -> None:
    """Answer (function, arguments) with the result, or the exception, until the process is ended.

    Its niceness is 10 only where the processes of the loop have no real-time priority: below both, it would hardly run.
    """
    enter_process(0 if may_go_first() else 10)
    while True:
        function, arguments = receive(pipe)
        try:
            answer = function(*arguments)
        except Exception as error:
            answer = error
        pipe.send(answer)
