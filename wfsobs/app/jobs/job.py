"""A computation of the server: what is to be done, for whom, and what is known of it so far."""

from __future__ import annotations

import itertools
import logging
import math
import threading
from collections.abc import Callable, Hashable, Mapping
from time import monotonic
from typing import Any

from wfsobs.app.logs import event
from wfsobs.progress import Cancelled, Watch

log = logging.getLogger(__name__)

RUNNING, DONE, CANCELLED, FAILED = "running", "done", "cancelled", "failed"

CLICK, SWEEP, IDLE_TIME = 0, 1, 2
"""Priorities: somebody waits for the answer to a click; a search or a long run takes its time anyway; what nobody has asked for
is done while there is nothing else, and begins again after all else."""

LONG = 5.0
"""A job that takes longer is no click [s]."""

INTERVAL = 0.15
"""Least time between two reports of progress [s]."""

Tell = Callable[..., None]
"""Told by the work, by keyword: `latest`, how far it is, or `result`, what there is of the result."""

Work = Callable[[Watch, Tell], Any]
"""What is to be done -> its result."""

Listener = Callable[[Mapping[str, Any]], None]
"""Told what has changed, from any thread: state, place, progress, latest, result, message. Must not wait."""


class Job:
    """One computation for all who listen to it; it goes on as long as somebody does.

    kind       : what it is called in the log
    key        : names its result, where sessions may share it
    cost       : how long it takes, about [s]
    priority   : CLICK or SWEEP; by its cost if not given
    time_limit : of the work, after which it is told to stop [s]
    wait_limit : of the time in the line, after which it is given up [s]
    refusal    : exceptions of the work that are a reason in one line; others are bugs, and logged
    endless    : goes on until it is stopped; one place among the jobs is kept free of such
    quiet      : one of many in a second, of which the log says nothing unless it is asked for everything
    """

    numbers = itertools.count(1)

    def __init__(
        self,
        kind: str,
        work: Work,
        *,
        key: str = "",
        cost: float = 0.0,
        priority: int | None = None,
        time_limit: float = math.inf,
        wait_limit: float = math.inf,
        refusal: type[Exception] = ValueError,
        endless: bool = False,
        quiet: bool = False,
    ):
        self.kind, self.key, self.cost = kind, key, cost
        self.priority = (CLICK if cost <= LONG else SWEEP) if priority is None else priority
        self.time_limit, self.wait_limit, self.endless = time_limit, wait_limit, endless
        self.number, self.since, self.turn = next(Job.numbers), monotonic(), 0
        self._work, self._refusal = work, refusal
        self._level = logging.DEBUG if quiet else logging.INFO
        self._lock = threading.RLock()  # where a session has no thread of its own, a listener may leave
        self._listeners: dict[Listener, Hashable] = {}
        self._is_unwanted = False
        self._state: dict[str, Any] = {}

    @property
    def owner(self) -> Hashable:
        """Who has listened longest."""
        with self._lock:
            return next(iter(self._listeners.values()), None)

    def join(self, owner: Hashable, listener: Listener) -> bool:
        """One more who wants the result, told at once what is known; false where the job has been given up."""
        with self._lock:
            if self._is_unwanted:
                return False
            self._listeners[listener] = owner
            if self._state:
                listener(dict(self._state))
            return True

    def leave(self, listener: Listener) -> bool:
        """One less; whether nobody is left, and the job told to stop."""
        with self._lock:
            self._listeners.pop(listener, None)
            self._is_unwanted = not self._listeners
            return self._is_unwanted

    def tell(self, **news: Any) -> None:
        """Tell all who listen."""
        with self._lock:
            self._state |= news
            for listener in [*self._listeners]:
                listener(news)

    def tell_place(self, place: int) -> None:
        """Its place in the line may have changed."""
        if self._state.get("place", 0) != place:
            self.tell(place=place)

    def run(self, closing: Callable[[], bool], keep: Callable[[str, Any], Any], busy: Callable[[], bool] = lambda: False) -> bool:
        """Do the work, in a thread of the queue; return whether it gave way and is to be done again.

        Keep is given the key, if there is one, and the result; busy tells a job for idle time that there is other work.
        """
        start, told = monotonic(), 0.0
        event(
            f"{self.kind}-start",
            self._level,
            **{self.kind: self.number},
            session=self.owner,
            wait=start - self.since,
            estimate=self.cost,
        )

        def progress(fraction: float) -> None:
            nonlocal told
            if (now := monotonic()) - told >= INTERVAL:
                told = now
                self.tell(progress=min(max(fraction, 0.0), 1.0))

        def stopped() -> bool:
            return self._is_unwanted or closing()

        gave_way = False

        def gives_way() -> bool:
            nonlocal gave_way
            gave_way = gave_way or (self.priority == IDLE_TIME and busy())
            return gave_way

        said, news = "failed", {"state": FAILED}
        try:
            result = self._work(
                Watch(progress, lambda: stopped() or gives_way() or monotonic() - start > self.time_limit), self.tell
            )
            if self.key:
                keep(self.key, result)
            said, news = "done", {"state": DONE, "progress": 1.0, "result": result}
        except Cancelled:
            if gave_way and not stopped():
                said = "gave way"
                return True
            if stopped() or monotonic() - start <= self.time_limit:
                said, news = "cancelled", {"state": CANCELLED}
            else:
                said, news["message"] = "late", f"It took more than {self.time_limit:g} s, which is what this server allows"
        except self._refusal as error:
            said, news["message"] = "refused", str(error)
        except Exception as error:  # a bug, but the server goes on
            log.exception("%s %d failed", self.kind, self.number)
            news["message"] = f"{type(error).__name__}: {error}"
        finally:
            level = logging.ERROR if said == "failed" else self._level
            event(f"{self.kind}-end", level, **{self.kind: self.number}, state=said, seconds=monotonic() - start)
            if said != "gave way":
                self.tell(**news)
        return False
