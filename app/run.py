"""The one computation of a session, in a thread of its own."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import param

from wfsobs.app.queue import step_back
from wfsobs.app.work import Shown, compute
from wfsobs.scenario import Scenario
from wfsobs.settings import SettingError
from wfsobs.watch import Cancelled

log = logging.getLogger(__name__)


class Tell(Protocol):
    """How whoever does the work tells of it."""

    def __call__(self, fraction: float, shown: Shown | None, place: int = 0) -> None:
        """The fraction done, what is done where that has grown, and the place in the line while the work waits."""


Compute = Callable[[Scenario, Callable[[], bool], Tell], Shown]
Post = Callable[[Callable[[], None]], None]
"""Has a function called soon on the thread that owns the session; may itself be called from any thread."""

IDLE, RUNNING, DONE, CANCELLED, FAILED = "idle", "running", "done", "cancelled", "failed"

THREADS = 6
"""Of a session: what has been told to stop may take a while to hear it, beside a run, a closed loop, an identification and a
tuning. None is made before it is needed."""


class Run(param.Parameterized):
    """The state machine of the one computation of a session.

    Starting a run supersedes the one before: it is told to stop, and nothing of it lands any more, however
    late it comes. What the worker reports is gathered and lands in one `param.update` on the session's thread.
    """

    state = param.Selector(default=IDLE, objects=[IDLE, RUNNING, DONE, CANCELLED, FAILED])
    progress = param.Number(0.0, bounds=(0.0, 1.0), doc="Fraction done.")
    place = param.Integer(0, doc="Place in the line of runs, from 1; 0 when it is being done.")
    message = param.String("", doc="Why the run failed, in one line.")
    shown = param.ClassSelector(class_=Shown, default=None, allow_None=True, doc="The latest results.")

    def __init__(self, post: Post, work: Compute = compute):
        super().__init__()
        self._post, self._compute = post, work
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="wfsobs-run", initializer=step_back)
        self._lock = threading.Lock()
        self._generation = 0
        self._cancel = threading.Event()
        self._news: dict[str, Any] = {}
        self._posted = False
        self.closed = False

    def start(self, scenario: Scenario) -> None:
        """Run a scenario, in place of whatever is running."""
        generation, cancel = self._supersede()
        self.param.update(state=RUNNING, progress=0.0, place=0, message="")
        self._pool.submit(self._work, scenario, generation, cancel)

    def cancel(self) -> None:
        """Stop; what has been delivered stays."""
        if self.state == RUNNING:
            self._supersede()
            self.param.update(state=CANCELLED)

    def aside(self, function: Callable[[], None]) -> None:
        """Have something done in a thread, beside the run."""
        self._pool.submit(function)

    def post(self, function: Callable[[], None]) -> None:
        """Have something done on the session's thread; may be called from any."""
        self._post(function)

    def close(self) -> None:
        """Stop and let the threads go: the session has ended."""
        self.closed = True
        self._supersede()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _supersede(self) -> tuple[int, threading.Event]:
        with self._lock:
            self._cancel.set()
            self._cancel = threading.Event()
            self._generation += 1
            self._news = {}
            return self._generation, self._cancel

    def _work(self, scenario: Scenario, generation: int, cancel: threading.Event) -> None:
        """In a thread of the pool."""
        def report(fraction: float, shown: Shown | None, place: int = 0) -> None:
            news: dict[str, Any] = {"progress": min(max(fraction, 0.0), 1.0), "place": place}
            self._tell(generation, news if shown is None else news | {"shown": shown})

        try:
            shown = self._compute(scenario, cancel.is_set, report)
        except Cancelled:
            self._tell(generation, {"state": CANCELLED})
        except SettingError as error:
            self._tell(generation, {"state": FAILED, "message": str(error)})
        except Exception as error:  # a bug, but the session goes on
            log.exception("the run failed")
            self._tell(generation, {"state": FAILED, "message": f"{type(error).__name__}: {error}"})
        else:
            self._tell(generation, {"state": DONE, "progress": 1.0, "shown": shown})

    def _tell(self, generation: int, news: dict[str, Any]) -> None:
        with self._lock:
            if generation != self._generation:
                return
            self._news |= news
            if self._posted:
                return
            self._posted = True
        self._post(self._land)

    def _land(self) -> None:
        with self._lock:
            news, self._news, self._posted = self._news, {}, False
        if news:
            self.param.update(**news)
