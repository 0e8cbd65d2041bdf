"""Observers that follow a source in processes of their own, so that nothing that reads them delays them."""

from __future__ import annotations

import gc
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from multiprocessing.queues import Queue
from time import monotonic, sleep
from typing import Any

from wfsobs.live.board import CREWS, Board
from wfsobs.live.crew import Crew, trace_width
from wfsobs.live.paced import SOURCE, Command, enter_process, go_first
from wfsobs.live.ring import Ring
from wfsobs.live.rows import Rows
from wfsobs.live.source import end_process, send_command
from wfsobs.record import Sampling
from wfsobs.scenario import Scenario
from wfsobs.stepping import design

TRACE_CAPACITY = 1 << 14
"""Rows of estimates that are kept: a quarter of a minute at 1 kHz."""
POLL = 1e-4
"""Pause between two looks at a ring whose next frame is due [s]."""
REST = 2e-3
"""Pause between two looks at a ring that stands still, and the longest one [s]."""
HOPELESS = 1.0
"""Frames that a process may be behind [s] before it gives way to others: it cannot keep up."""
LOOK = 0.01
"""Pause between two looks at the commands [s]."""


@dataclass(frozen=True)
class Order:
    """What a process of observers is told.

    settings   : of the scenario that the observers are told of
    observers  : ids of those that run from the start
    sampling   : modes, step and NGS ratio of the source
    place      : of the crew in CREWS
    joins_late : whether it begins with the newest frame, as the others run already; else with the first
    ring_name, traces_name, board_name : shared memory
    inbox      : commands
    news       : (number of the frame, one line)
    """

    settings: Mapping[str, Any]
    observers: tuple[str, ...]
    sampling: Sampling
    place: int
    joins_late: bool
    ring_name: str
    traces_name: str
    board_name: str
    inbox: Connection
    news: Queue[tuple[int, str]]


@dataclass(frozen=True)
class Site:
    """What the processes of observers have in common: see `Order`."""

    settings: Mapping[str, Any]
    sampling: Sampling
    ring: Ring
    board: Board
    news: Queue[tuple[int, str]]


class CrewProcess:
    """A process of observers.

    Parameters
    ----------
    context : SpawnContext
        By which it is made.
    site : Site
        Where.
    observers : tuple of str
        Ids of those that run from the start.
    place : int
        Of the crew in CREWS.
    joins_late : bool
        Whether others run already.

    Attributes
    ----------
    traces : Rows
        Its estimates.
    process : BaseProcess
        It.
    """

    def __init__(self, context: SpawnContext, site: Site, observers: tuple[str, ...], place: int, joins_late: bool):
        self.traces = Rows(trace_width(site.sampling.n_modes), TRACE_CAPACITY)
        self._site, self._place, self._joins_late = site, place, joins_late
        inbox, self._outbox = context.Pipe(duplex=False)
        names = site.ring.name, self.traces.name, site.board.name
        order = Order(site.settings, observers, site.sampling, place, joins_late, *names, inbox, site.news)
        self.process = context.Process(target=observe_frames, args=(order,), name=f"the observers ({CREWS[place]})", daemon=True)
        self.process.start()

    @property
    def is_ready(self) -> bool:
        """Whether its observers are ready for the next frame."""
        return bool(self._site.board.is_ready[self._place])

    @property
    def takes_part(self) -> bool:
        """Whether a frame is taken by all only once it has taken it."""
        return self.is_ready or not self._joins_late

    @property
    def is_alive(self) -> bool:
        """Whether it takes what comes."""
        return self.process.is_alive()

    def tell(self, command: Command) -> None:
        """Give it a command."""
        send_command(self._outbox, command)

    def stop(self) -> None:
        """End it and give the memory back."""
        end_process(self.process)
        self.traces.release()


def observe_frames(order: Order) -> None:
    """Follow a ring until the process is ended."""
    enter_process(turn=SOURCE - 1 - order.place)
    sampling = order.sampling
    ring, board = Ring(sampling.n_modes, order.ring_name), Board(sampling.n_modes, order.board_name)
    traces = Rows(trace_width(sampling.n_modes), TRACE_CAPACITY, order.traces_name)
    try:
        crew = made_crew(order, board)
    except ValueError as error:
        order.news.put((0, str(error)))
        return
    gc.collect()
    gc.freeze()
    number = -(-ring.count // crew.ratio) * crew.ratio if order.joins_late else 0
    traces.skip_to(number)
    board.progress[order.place] = number
    board.is_ready[order.place] = 1
    pause, look = Pause(), 0.0
    while True:
        if (now := monotonic()) >= look:
            look = now + LOOK
            if (ring.count - number) * sampling.dt > HOPELESS:
                go_first(0)
            crew.count()
            while order.inbox.poll():
                crew.follow(order.inbox.recv(), number)
        if ring.count <= number:
            pause.rest()
            continue
        if (frame := ring.read(number)) is None:
            newest = ring.count // crew.ratio * crew.ratio
            crew.lose(newest - number)
            traces.skip_to(newest)
            number = newest
            continue
        traces.write(crew.take(frame, number))
        crew.settle()
        pause.note(float(frame.due))
        number += 1


def made_crew(order: Order, board: Board) -> Crew:
    """Return a crew with the observers that run from the start. Raises ValueError where one has no design."""
    scenario = Scenario.from_dict(dict(order.settings))
    crew = Crew(order.sampling, round(scenario.run.warm_up / order.sampling.dt), board, order.place, order.news.put)
    for name in order.observers:
        crew.start(name, design(name, scenario, sampling=order.sampling), 0)
    return crew


class Pause:
    """How long to wait for the next frame: until it is due, if they come by the clock."""

    def __init__(self) -> None:
        self._due, self._next = 0.0, 0.0

    def note(self, due: float) -> None:
        """Note when a frame was due, on the monotonic clock [s].

        The next one is due as long after it as it after the last, and there when the source has written it.
        """
        self._next = due + min(due - self._due, REST) + POLL
        self._due = due

    def rest(self) -> None:
        """Wait: at most REST, short where a frame is awaited."""
        wait = self._next - monotonic()
        sleep(REST if wait < -10 * REST else max(wait, POLL))
