"""Computations of the server: jobs that sessions share, their queue, and the state of a job in a session."""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import logging
import sys
import threading
from collections.abc import Callable, Hashable, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import partial
from math import inf
from time import monotonic
from typing import Any, ClassVar

from wfsobs.app.cache import Cache
from wfsobs.app.logs import event
from wfsobs.progress import Cancelled, Watch

log: logging.Logger = logging.getLogger(__name__)

RUNNING, DONE, CANCELLED, FAILED = "running", "done", "cancelled", "failed"

CLICK, BATCH, IDLE_TIME = 0, 1, 2
"""Priorities: answers to clicks; searches and long runs; computations without a request, which run while the queue is empty and
start again after all other jobs."""

LONG = 5.0
"""Maximum cost of a job with the priority of a click [s]."""

INTERVAL = 0.15
"""Minimum time between two reports of progress [s]."""

Tell = Callable[..., None]
"""Reports of the work, by keyword: `latest`, its progress, or `result`, the result so far."""

Work = Callable[[Watch, Tell], Any]
"""(watch, tell) -> result."""

Listener = Callable[[Mapping[str, Any]], None]
"""Receives changes of state, place, progress, latest, result and message, from any thread. Must not block."""


@dataclass(eq=False)
class Job:
    """A computation, shared by its listeners; it stops when the last of them leaves.

    kind       : what it is called in the log
    key        : names its result, where sessions may share it
    cost       : how long it takes, about [s]
    priority   : CLICK or BATCH; by its cost if not given
    time_limit : of the work, after which it is told to stop [s]
    refusal    : exceptions of the work that are a reason in one line; others are bugs, and logged
    endless    : goes on until it is stopped; one place among the jobs is kept free of such
    quiet      : one of many in a second, of which the log says nothing unless it is asked for everything
    """

    _numbers: ClassVar = itertools.count(1)

    kind: str
    work: Work
    _: KW_ONLY
    key: str = ""
    cost: float = 0.0
    priority: int = -1
    time_limit: float = inf
    refusal: type[Exception] = ValueError
    endless: bool = False
    quiet: bool = False

    def __post_init__(self) -> None:
        """Choose the priority by the cost, if it was not given."""
        if self.priority < CLICK:
            self.priority = CLICK if self.cost <= LONG else BATCH
        self.number: int = next(Job._numbers)
        self.since: float = monotonic()
        self.turn: int = 0
        self._level = logging.DEBUG if self.quiet else logging.INFO
        self._lock = threading.RLock()  # where a session has no thread of its own, a listener may leave
        self._listeners: dict[Listener, Hashable] = {}
        self._is_unwanted = False
        self._state: dict[str, Any] = {}

    @property
    def owner(self) -> Hashable:
        """Owner of the oldest listener."""
        with self._lock:
            return next(iter(self._listeners.values()), None)

    def join(self, owner: Hashable, listener: Listener) -> bool:
        """Add a listener, which receives the present state at once; return False where the job has been cancelled."""
        with self._lock:
            if self._is_unwanted:
                return False
            self._listeners[listener] = owner
            if self._state:
                listener(dict(self._state))
            return True

    def leave(self, listener: Listener) -> bool:
        """Remove a listener; return whether it was the last one, so that the job stops."""
        with self._lock:
            self._listeners.pop(listener, None)
            self._is_unwanted = not self._listeners
            return self._is_unwanted

    def tell(self, **news: Any) -> None:
        """Notify all listeners."""
        with self._lock:
            self._state |= news
            for listener in [*self._listeners]:
                listener(news)

    def tell_place(self, place: int) -> None:
        """Notify the listeners of the place in the queue, if it has changed."""
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

        end = ""  # that it comes to before it is done

        def stops() -> bool:
            nonlocal end
            if self._is_unwanted or closing():
                end = "cancelled"
            elif not end and self.priority == IDLE_TIME and busy():
                end = "gave way"
            elif not end and monotonic() - start > self.time_limit:
                end = "late"
            return bool(end)

        said, news = "failed", {"state": FAILED}
        try:
            result = self.work(Watch(progress, stops), self.tell)
            if self.key:
                keep(self.key, result)
            said, news = "done", {"state": DONE, "progress": 1.0, "result": result}
        except Cancelled:
            said = end if stops() else "cancelled"
            if said == "gave way":
                return True
            if said == "late":
                news["message"] = f"It took more than {self.time_limit:g} s, which is what this server allows"
            else:
                news = {"state": CANCELLED}
        except self.refusal as error:
            said, news["message"] = "refused", str(error)
        except (Exception, SystemExit) as error:  # a bug, but the server goes on
            log.exception("%s %d failed", self.kind, self.number)
            news["message"] = f"{type(error).__name__}: {error}"
        finally:
            level = logging.ERROR if said == "failed" else self._level
            event(f"{self.kind}-end", level, **{self.kind: self.number}, state=said, seconds=monotonic() - start)
            if said != "gave way":
                self.tell(**news)
        return False


PATIENCE = 60.0
"""Waiting time after which a sweep has the priority of a click [s]."""

REST = 1.0
"""Time left to the page and the browser before a job for idle time [s]."""


class JobQueue:
    """Threads of their own, as many as jobs may be done at once, and the results kept of jobs that have a key.

    Clicks go before sweeps, and both before what is done in idle time, which gives way to them. Then turns are taken: the first
    job of every owner before the second of anybody, whoever comes later beginning with the turn that is being done, and within a
    turn first come first served. What is wanted twice is done once.
    """

    def __init__(self, workers: int, cache: Cache, rest: float = REST):
        self.cache = cache
        self.rest = rest
        self.closing: bool = False
        self._waiting: list[Job] = []
        self._running: list[Job] = []
        self._shared_jobs: dict[str, Job] = {}
        self._turn = 0  # the latest that has begun
        self._last_answer = -inf  # when something was last handed over, which is to be drawn
        self._change = threading.Condition()
        self._threads = [threading.Thread(target=self._work, name=f"wfsobs-work-{i}", daemon=True) for i in range(workers)]
        for thread in self._threads:
            thread.start()

    def submit(
        self, job: Job, owner: Hashable, listener: Listener, before: Callable[[], None] = lambda: None
    ) -> Callable[[], None]:
        """Have a job done when its turn comes, or tell the listener what there is of the same; how to take it back.

        before : takes back what this replaces; that would end the same job if it were done any sooner
        """
        with self._change:
            found = self.cache.get(job.key) if job.key else None
            shared = self._shared_jobs.get(job.key) if found is None else None
            joined = shared is not None and shared.join(owner, listener)
            if job.key:
                how = "hit" if found is not None else "joined" if joined else "miss"
                event("result", session=owner, key=job.key[:12], cache=how)
            before()
            if found is not None:
                self._last_answer = monotonic()
                listener({"state": DONE, "progress": 1.0, "result": found})
                return lambda: None
            if shared is not None and joined:
                job = shared
            else:
                job.join(owner, listener)
                self._put(job)
        return partial(self._leave, job, listener)

    def _put(self, job: Job) -> None:
        if self.closing:
            job.tell(state=CANCELLED)
            return
        if job.key:
            self._shared_jobs[job.key] = job
        owner = job.owner
        job.turn = max([self._turn, *(other.turn + 1 for other in self._requests if other.owner == owner)])
        self._waiting.append(job)
        self._change.notify_all()
        self._tell_places()

    def _leave(self, job: Job, listener: Listener) -> None:
        if job.leave(listener):
            with self._change:
                self._take_out(job)

    def _take_out(self, job: Job) -> None:
        """Out of the line and of what is shared."""
        if self._shared_jobs.get(job.key) is job:
            del self._shared_jobs[job.key]
        if job in self._waiting:
            self._waiting.remove(job)
            self._tell_places()

    @property
    def workers(self) -> int:
        """Jobs that may be done at once."""
        return len(self._threads)

    @property
    def length(self) -> int:
        """Number of waiting jobs."""
        with self._change:
            return len(self._waiting)

    @property
    def running(self) -> int:
        """Number of running jobs."""
        with self._change:
            return len(self._running)

    def close(self, timeout: float) -> bool:
        """Start no further job, and wait [s] for the running ones; return whether all have ended."""
        with self._change:
            self.closing = True
            for job in [*self._waiting]:
                self._take_out(job)
                job.tell(state=CANCELLED)
            self._change.notify_all()
        end = monotonic() + timeout
        for thread in self._threads:
            thread.join(max(end - monotonic(), 0.0))
        return not any(thread.is_alive() for thread in self._threads)

    def _work(self) -> None:
        while (job := self._next()) is not None:
            again = False
            try:
                again = job.run(lambda: self.closing, self.cache.put, self.is_busy)
            except (Exception, SystemExit):  # a bug, but the thread is for all
                log.exception("a job failed")
            finally:
                with self._change:
                    self._running.remove(job)
                    self._last_answer = monotonic()
                    if again:
                        self._waiting.append(job)
                    else:
                        self._take_out(job)
                    self._change.notify_all()
                del job
                release_memory()

    def _next(self) -> Job | None:
        """Take the first job of the queue; None after `close`."""
        with self._change:
            while not self.closing:
                job, rest = next(filter(self._has_room, self._line()), None), 0.0
                if job is not None and job.priority == IDLE_TIME:
                    rest = inf if self.is_busy() else self._last_answer + self.rest - monotonic()
                if job is not None and rest <= 0.0:
                    self._waiting.remove(job)
                    self._running.append(job)
                    self._turn = max(self._turn, job.turn)
                    job.tell_place(0)
                    self._tell_places()
                    return job
                self._change.wait(rest if 0.0 < rest < inf else None)
            return None

    def _line(self) -> list[Job]:
        """Return the waiting jobs, in the order of their turns."""
        late = monotonic() - PATIENCE

        def place(job: Job) -> tuple[int, int]:
            return CLICK if job.since < late and job.priority != IDLE_TIME else job.priority, job.turn

        return sorted(self._waiting, key=place)

    def _has_room(self, job: Job) -> bool:
        """Whether a job may begin: one place is kept for those that come to an end."""
        return not job.endless or sum(other.endless for other in self._running) < len(self._threads) - 1

    @property
    def _requests(self) -> list[Job]:
        """Jobs that somebody has asked for, waiting or being done."""
        return [job for job in (*self._running, *self._waiting) if job.priority != IDLE_TIME]

    def is_busy(self) -> bool:
        """Whether a requested job waits."""
        return bool(self._requests)

    def _tell_places(self) -> None:
        """Tell the waiting jobs their places; a free thread takes the next job at once."""
        if len(self._running) >= len(self._threads):
            for place, job in enumerate(self._line(), 1):
                job.tell_place(place)


def release_memory() -> None:
    """Return free memory to the system: glibc keeps what was freed in another thread than the page's."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)
