"""What the sessions of a server share, and all that they share: the line of runs, the results kept, the limits.

A run that several sessions want is done once: each hears of its progress, and it goes on as long as one still wants it.
"""

from __future__ import annotations

import gc
import itertools
import logging
import threading
from collections.abc import Callable, Hashable
from functools import partial
from time import monotonic

from wfsobs.app.cache import Cache, key_of
from wfsobs.app.limits import Limits
from wfsobs.app.logs import event
from wfsobs.app.queue import Queue, give_back
from wfsobs.app.run import Tell
from wfsobs.app.sources import Source
from wfsobs.app.work import Report, Shown, compute
from wfsobs.cost import run_seconds
from wfsobs.scenario import Scenario
from wfsobs.settings import SettingError
from wfsobs.watch import Cancelled

Work = Callable[..., Shown]
"""(scenario, cancelled, report), and the source of the record where that is not the scenario -> results."""

POLL = 0.1
"""How often somebody who waits looks whether they still want to [s]."""


class Full(Exception):
    """No more sessions on this server: one line saying so."""


class Flight:
    """One run under way, for all who want its result."""

    def __init__(
        self, number: int, scenario: Scenario, work: Callable[[Callable[[], bool], Report], Shown],
        closing: Callable[[], bool],
    ):
        self.number, self.scenario = number, scenario
        self._closing = closing
        self.landed = threading.Event()
        self.shown: Shown | None = None
        self.error: Exception | None = None
        self._work = work
        self._lock = threading.Lock()
        self._wanting: dict[object, tuple[Hashable, Callable[[], bool], Tell]] = {}
        self._unwanted = False
        self._latest: tuple[float, Shown | None, int] = (0.0, None, 0)
        self._since = monotonic()

    @property
    def owner(self) -> Hashable:
        """The session that has wanted it longest and still does; where none does, the first that did."""
        with self._lock:
            asked = list(self._wanting.values())
        still = [owner for owner, cancelled, _ in asked if not cancelled()]
        return next(iter([*still, *(owner for owner, _, _ in asked)]), None)

    def join(self, ticket: object, owner: Hashable, cancelled: Callable[[], bool], tell: Tell) -> bool:
        """One more who wants it, told at once how far it is; false where it has been given up."""
        with self._lock:
            if self._unwanted:
                return False
            self._wanting[ticket] = owner, cancelled, tell
            if self._latest != (0.0, None, 0):
                tell(*self._latest)
            return True

    def leave(self, ticket: object) -> bool:
        """One less; whether it is over, landed or wanted by nobody."""
        with self._lock:
            self._wanting.pop(ticket, None)
            self._unwanted = self._unwanted or not self._wanting
            return self._unwanted or self.landed.is_set()

    def moved(self, place: int) -> None:
        """Its place in the line has changed."""
        self._tell(0.0, None, place)

    def run(self) -> None:
        """Compute, in a thread of the queue."""
        start, state = monotonic(), "failed"
        event("run-start", run=self.number, session=self.owner, wait=start - self._since, estimate=run_seconds(self.scenario))
        try:
            self.shown = self._work(self._given_up, self._report)
            state = "done"
        except Cancelled as error:
            self.error, state = error, "cancelled"
        except SettingError as error:
            self.error, state = error, "refused"
        except Exception as error:  # those who wait log its traceback
            self.error = error
        finally:
            level = logging.ERROR if state == "failed" else logging.INFO
            event("run-end", level, run=self.number, state=state, seconds=monotonic() - start)
            self.landed.set()

    def _given_up(self) -> bool:
        with self._lock:
            self._unwanted = self._unwanted or all(cancelled() for _, cancelled, _ in self._wanting.values())
            return self._unwanted or self._closing()

    def _report(self, fraction: float, shown: Shown | None) -> None:
        self._tell(fraction, shown, 0)

    def _tell(self, fraction: float, shown: Shown | None, place: int) -> None:
        with self._lock:
            self._latest = fraction, shown or self._latest[1], place
            for _, _, tell in self._wanting.values():
                tell(fraction, shown, place)


class Service:
    """One per server.

    workers    : runs at once
    most_bytes : of results kept
    """

    def __init__(self, limits: Limits, workers: int, most_bytes: int, work: Work = compute):
        self.limits = limits
        self.cache: Cache[Shown] = Cache(most_bytes)
        self.queue = Queue(workers)
        self.visits = 0
        self.closing = False
        self._work = work
        self._flights: dict[str, Flight] = {}
        self._lock = threading.Lock()
        self._session_numbers, self._run_numbers = itertools.count(1), itertools.count(1)

    def enter(self) -> Visit:
        """A new session. Raises Full."""
        with self._lock:
            if self.full:
                event("refused", logging.WARNING, what="session", sessions=self.visits)
                raise Full(f"There are {self.visits} visitors, as many as this server takes. Please try again later.")
            self.visits += 1
            number = next(self._session_numbers)
        event("session-start", session=number, sessions=self.visits)
        return Visit(self, number)

    @property
    def full(self) -> bool:
        """Whether there are as many sessions as may be."""
        return self.visits >= self.limits.sessions

    def left(self) -> None:
        """A session has ended."""
        with self._lock:
            self.visits -= 1
            last = self.visits == 0
        if last:  # nobody is kept waiting
            gc.collect()
            give_back()

    def held(self, scenario: Scenario) -> bool:
        """Whether the results are there already."""
        return key_of(scenario) in self.cache

    def join(
        self, owner: int, scenario: Scenario, cancelled: Callable[[], bool], tell: Tell, source: Source | None = None
    ) -> Shown | tuple[Flight, Callable[[], None]]:
        """The results; or the run that will bring them, in the line from now on if it was not, and how to leave it."""
        key, ticket = key_of(scenario, source.key if source else ""), object()
        with self._lock:
            shown = self.cache.get(key)
            flight = self._flights.get(key)
            joined = shown is None and flight is not None and flight.join(ticket, owner, cancelled, tell)
            event("result", session=owner, key=key[:12], cache="hit" if shown else "joined" if joined else "miss")
            if shown is not None:
                return shown
            if flight is None or not joined:
                flight = self._flights[key] = Flight(
                    next(self._run_numbers), scenario, partial(self._compute, key, scenario, source), lambda: self.closing)
                flight.join(ticket, owner, cancelled, tell)
                self.queue.put(flight)
        return flight, partial(self._leave, key, flight, ticket)

    def _compute(
        self, key: str, scenario: Scenario, source: Source | None, cancelled: Callable[[], bool], report: Report
    ) -> Shown:
        return self.cache.put(key, self._work(scenario, cancelled, report, *([source] if source else [])))

    def _leave(self, key: str, flight: Flight, ticket: object) -> None:
        with self._lock:
            over = flight.leave(ticket)
            if over and self._flights.get(key) is flight:
                del self._flights[key]
        if over:
            self.queue.drop(flight)

    def close(self, timeout: float = 1.5) -> bool:
        """Stop every run, those to come too; whether all have ended in time [s]. To set `closing` alone does the same later."""
        self.closing = True
        return self.queue.close(timeout)


class Visit:
    """One session's way to the service."""

    def __init__(self, service: Service, number: int):
        self.service, self.number = service, number
        self._since, self._open = monotonic(), True

    def compute(
        self, scenario: Scenario, cancelled: Callable[[], bool], tell: Tell, source: Source | None = None
    ) -> Shown:
        """The results of a scenario, kept or computed, whoever asked first. Raises SettingError, Cancelled."""
        self.service.limits.check(scenario)
        if source is not None:
            source.check(self.service.limits)
        joined = self.service.join(self.number, scenario, cancelled, tell, source)
        if isinstance(joined, Shown):
            return joined
        flight, leave = joined
        try:
            while not flight.landed.wait(POLL):
                if cancelled() or self.service.closing:
                    raise Cancelled
        finally:
            leave()
        if flight.shown is None:
            raise flight.error or Cancelled()
        return flight.shown

    def leave(self) -> None:
        """The session has ended."""
        if self._open:
            self._open = False
            self.service.left()
            event("session-end", session=self.number, seconds=monotonic() - self._since, sessions=self.service.visits)

