"""The line of runs before the processors: so many at once, one per session, first come first served."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import sys
import threading
from collections.abc import Hashable
from time import monotonic
from typing import Protocol

log = logging.getLogger(__name__)


class Job(Protocol):
    """Something to be done when its turn comes."""

    @property
    def owner(self) -> Hashable:
        """Whose it is: of one owner's jobs one is done at a time."""

    def run(self) -> None:
        """Do it."""

    def moved(self, place: int) -> None:
        """Told its place in the line, from 1; 0 when its turn has come. Must not wait, nor call the queue."""


class Queue:
    """Threads of their own, as many as jobs may be done at once.

    An owner whose job is being done is passed over, so that nobody holds two places. A job's turn never comes
    later for jobs put in after it, but for those that pass over such an owner.
    """

    def __init__(self, workers: int):
        self._waiting: list[Job] = []
        self._running: list[Job] = []
        self._closed = False
        self._changed = threading.Condition()
        self._threads = [
            threading.Thread(target=self._work, name=f"wfsobs-work-{i}", daemon=True) for i in range(workers)]
        for thread in self._threads:
            thread.start()

    def put(self, job: Job) -> None:
        """Have a job done when its turn comes."""
        with self._changed:
            self._waiting.append(job)
            self._changed.notify_all()
            if len(self._running) >= len(self._threads):
                job.moved(len(self._waiting))

    def drop(self, job: Job) -> None:
        """Take a job out of the line, if it is still there."""
        with self._changed:
            if job in self._waiting:
                self._waiting.remove(job)
                self._tell()

    @property
    def workers(self) -> int:
        """Jobs that may be done at once."""
        return len(self._threads)

    @property
    def length(self) -> int:
        """How many wait."""
        with self._changed:
            return len(self._waiting)

    @property
    def running(self) -> int:
        """How many are being done."""
        with self._changed:
            return len(self._running)

    def close(self, timeout: float) -> bool:
        """Start nothing any more, and wait [s] for what is being done; whether all of that has ended."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
            self._changed.notify_all()
        end = monotonic() + timeout
        for thread in self._threads:
            thread.join(max(end - monotonic(), 0.0))
        return not any(thread.is_alive() for thread in self._threads)

    def _work(self) -> None:
        step_back()
        while (job := self._next()) is not None:
            try:
                job.run()
            except Exception:  # a bug, but the thread is for all
                log.exception("a job failed")
            finally:
                with self._changed:
                    self._running.remove(job)
                    self._changed.notify_all()
                del job
                give_back()

    def _next(self) -> Job | None:
        """The first in the line whose owner has nothing under way; None when there will be no more."""
        with self._changed:
            while not self._closed:
                busy = {job.owner for job in self._running}
                job = next((job for job in self._waiting if job.owner not in busy), None)
                if job is not None:
                    self._waiting.remove(job)
                    self._running.append(job)
                    job.moved(0)
                    self._tell()
                    return job
                self._changed.wait()
            return None

    def _tell(self) -> None:
        for place, job in enumerate(self._waiting, 1):
            job.moved(place)


def give_back() -> None:
    """Return free memory to the system: glibc keeps what was freed in another thread than the page's."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).malloc_trim(0)


def step_back() -> None:
    """Let the page's own thread, and a browser on the same machine, go first. On Linux priority is the thread's own."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)
