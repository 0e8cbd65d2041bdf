"""The line of jobs before the processors: so many at once, of every kind, and each told its place."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import math
import os
import sys
import threading
from collections.abc import Callable, Hashable
from functools import partial
from time import monotonic
from typing import Any

from wfsobs.app.cache import Cache
from wfsobs.app.jobs.job import CANCELLED, CLICK, DONE, FAILED, IDLE_TIME, Job, Listener
from wfsobs.app.logs import event

log = logging.getLogger(__name__)

PATIENCE = 60.0
"""A sweep that has waited longer goes like a click [s], so that its turn comes."""

REST = 1.0
"""Time left to the page and the browser before a job for idle time [s]."""


class JobQueue:
    """Threads of their own, as many as jobs may be done at once, and the results kept of jobs that have a key.

    Clicks go before sweeps, and both before what is done in idle time, which gives way to them. Then turns are taken: the first
    job of every owner before the second of anybody, whoever comes later beginning with the turn that is being done, and within a
    turn first come first served. What is wanted twice is done once.
    """

    def __init__(self, workers: int, cache: Cache[Any], rest: float = REST):
        self.cache, self.rest = cache, rest
        self.closing = False
        self._waiting: list[Job] = []
        self._running: list[Job] = []
        self._shared_jobs: dict[str, Job] = {}
        self._turn = 0  # the latest that has begun
        self._last_answer = -math.inf  # when something was last handed over, which is to be drawn
        self._change = threading.Condition()
        self._timers: dict[Job, threading.Timer] = {}
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
        if job.wait_limit < math.inf:
            self._timers[job] = threading.Timer(job.wait_limit, self._overdue, (job,))
            self._timers[job].daemon = True
            self._timers[job].start()
        owner = job.owner
        job.turn = max([self._turn, *(other.turn + 1 for other in self._requests if other.owner == owner)])
        self._waiting.append(job)
        self._change.notify_all()
        self._tell_places()

    def _leave(self, job: Job, listener: Listener) -> None:
        if job.leave(listener):
            with self._change:
                self._take_out(job)

    def _overdue(self, job: Job) -> None:
        with self._change:
            if self._take_out(job):
                job.tell(state=FAILED, message=f"the server is busy: no turn within {job.wait_limit:g} s, try again")

    def _take_out(self, job: Job) -> bool:
        """Out of the line and of what is shared; whether it was in the line."""
        if self._shared_jobs.get(job.key) is job:
            del self._shared_jobs[job.key]
        if job not in self._waiting:
            return False
        self._waiting.remove(job)
        if job in self._timers:
            self._timers.pop(job).cancel()
        self._tell_places()
        return True

    @property
    def workers(self) -> int:
        """Jobs that may be done at once."""
        return len(self._threads)

    @property
    def length(self) -> int:
        """How many wait."""
        with self._change:
            return len(self._waiting)

    @property
    def running(self) -> int:
        """How many are being done."""
        with self._change:
            return len(self._running)

    def close(self, timeout: float) -> bool:
        """Start nothing any more, and wait [s] for what is being done; whether all of that has ended."""
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
        lower_priority()
        while (job := self._next()) is not None:
            again = False
            try:
                again = job.run(lambda: self.closing, self.cache.put, self.is_busy)
            except Exception:  # a bug, but the thread is for all
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
        """Take the first job of the line; None when there will be no more."""
        with self._change:
            while not self.closing:
                job, rest = next(filter(self._has_room, self._line()), None), 0.0
                if job is not None and job.priority == IDLE_TIME:
                    rest = math.inf if self.is_busy() else self._last_answer + self.rest - monotonic()
                if job is not None and rest <= 0.0:
                    self._waiting.remove(job)
                    if job in self._timers:
                        self._timers.pop(job).cancel()
                    self._running.append(job)
                    self._turn = max(self._turn, job.turn)
                    job.tell_place(0)
                    self._tell_places()
                    return job
                self._change.wait(rest if 0.0 < rest < math.inf else None)
            return None

    def _line(self) -> list[Job]:
        """Who waits, in the order of their turns."""
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
        """Whether somebody waits for a job."""
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


def lower_priority() -> None:
    """Let the page's own thread, and a browser on the same machine, go first. On Linux priority is the thread's own."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
