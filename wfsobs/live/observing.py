"""Observers that follow a source in processes of their own, so that nothing that reads them delays them."""

from __future__ import annotations

import gc
from multiprocessing.connection import Connection
from time import monotonic, sleep

from wfsobs.live.board import Board
from wfsobs.live.crew import ROOM, ObserverCrew, Site, trace_width, warm_up_of
from wfsobs.live.paced import FAILURE, SOURCE, LiveEvent, enter_process, go_first
from wfsobs.live.ring import Ring
from wfsobs.live.rows import Rows
from wfsobs.scenario import Scenario
from wfsobs.stepping import design

POLL = 1e-4
"""Pause between two looks at a ring whose next frame is due [s]."""
REST = 2e-3
"""Pause between two looks at a ring that stands still, and the longest one [s]."""
HOPELESS = 1.0
"""Frames that a process may be behind [s] before it gives way to others: it cannot keep up."""
LOOK = 0.01
"""Pause between two looks at the commands [s]."""


def observe_frames(
    site: Site, traces_name: str, inbox: Connection, place: int, observers: tuple[str, ...], joins_late: bool
) -> None:
    """Follow a ring until the process is ended.

    Parameters
    ----------
    site : Site
        What all have in common.
    traces_name : str
        Shared memory of the estimates.
    inbox : Connection
        Commands.
    place : int
        Of the crew in CREWS.
    observers : tuple of str
        Ids of those that run from the start.
    joins_late : bool
        Whether it begins with the newest frame, as others run already; else with the first.
    """
    enter_process(turn=SOURCE - 1 - place)
    sampling = site.sampling
    ring, board = Ring(sampling.n_modes, site.ring_name), Board(sampling.n_modes, site.board_name)
    traces = Rows(trace_width(sampling.n_modes), ROOM, traces_name)
    try:
        crew = made_crew(site, board, place, observers)
    except ValueError as error:
        site.news.put(LiveEvent(0, str(error), kind=FAILURE))
        return
    gc.collect()
    gc.freeze()
    number = -(-ring.count // crew.ratio) * crew.ratio if joins_late else 0
    traces.skip_to(number)
    board.progress[place] = number
    board.is_ready[place] = 1
    pause, look = Pause(), 0.0
    while True:
        if (now := monotonic()) >= look:
            look = now + LOOK
            if (ring.count - number) * sampling.dt > HOPELESS:
                go_first(0)
            crew.count()
            while inbox.poll():
                crew.follow(inbox.recv(), number)
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


def made_crew(site: Site, board: Board, place: int, observers: tuple[str, ...]) -> ObserverCrew:
    """Return a crew with the observers that run from the start. Raises ValueError where one has no design."""
    scenario = Scenario.from_dict(dict(site.settings))
    crew = ObserverCrew(site.sampling, warm_up_of(site), board, place, site.news.put)
    for name in observers:
        crew.start(name, design(name, scenario, sampling=site.sampling), 0)
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
