"""What the sessions of a server share, and all that they share: the line of jobs, the results kept, the limits."""

from __future__ import annotations

import gc
import itertools
import logging
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from math import isfinite
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, TypeVar

import param

from wfsobs.app.cache import Cache, key_of
from wfsobs.app.jobs import CANCELLED, DONE, FAILED, IDLE_TIME, RUNNING, Job, JobQueue, Listener, Tell, Work, release_memory
from wfsobs.app.limits import Limits
from wfsobs.app.logs import event
from wfsobs.app.sources import Source
from wfsobs.app.work import RunResults, compute
from wfsobs.cost import run_seconds
from wfsobs.dependence import Memo
from wfsobs.progress import Watch
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError

if TYPE_CHECKING:
    from wfsobs.campaign.follow import CampaignFolder
    from wfsobs.live.loop import LiveLoop, LiveOrder

Compute = Callable[[Scenario, Watch, Tell, Source | None], RunResults]
Post = Callable[[Callable[[], None]], None]
"""Has a function called soon on the thread that owns the session; may itself be called from any thread."""


Made = TypeVar("Made")


class Full(Exception):
    """No more sessions on this server: one line saying so."""


class Service:
    """One per server.

    workers    : jobs at once
    most_bytes : of results kept
    memo       : results by the digest of what they depend on; empty by default
    """

    def __init__(self, limits: Limits, workers: int, most_bytes: int, work: Compute | None = None, memo: Memo | None = None):
        self.limits = limits
        self.memo: Final = Memo() if memo is None else memo
        self.cache: Final = Cache(most_bytes)
        self.queue: Final = JobQueue(workers, self.cache)
        self.sessions: int = 0
        self._last_wish = monotonic()
        self.live: LiveOrder | None = None  # the loop that all sessions watch
        self.live_loop: LiveLoop | None = None
        self.campaign: CampaignFolder | None = None  # shown to all sessions; no visitor names a folder
        # Its thread is not one of low priority, as those of the jobs are: processes that it starts inherit that.
        self._starter = ThreadPoolExecutor(1, "wfsobs-start")
        self._starter.submit(bool)
        self._work = work or partial(compute, memo=self.memo)
        self._lock = threading.Lock()
        self._numbers = itertools.count(1)

    def enter(self) -> Session:
        """Open a new session. Raises Full."""
        session = Session(self)
        session.enter()
        return session

    def count_session(self) -> int:
        """Count a session that begins, and return its number. Raises Full."""
        with self._lock:
            if self.full:
                event("refused", logging.WARNING, what="session", sessions=self.sessions)
                raise Full(f"There are {self.sessions} visitors, as many as this server takes. Please try again later.")
            self.sessions += 1
            number = next(self._numbers)
        event("session-start", session=number, sessions=self.sessions)
        return number

    def note_wish(self) -> None:
        """Note that somebody wants something now."""
        self._last_wish = monotonic()

    @property
    def quiet_seconds(self) -> float:
        """For how long nobody has wanted anything [s]."""
        return 0.0 if self.queue.is_busy() else monotonic() - self._last_wish

    @property
    def full(self) -> bool:
        """Whether there are as many sessions as may be."""
        return self.sessions >= self.limits.sessions

    def is_cached(self, scenario: Scenario, source: Source | None = None) -> bool:
        """Whether the results are there already."""
        return run_key(scenario, source) in self.cache

    def session_share(self, most: int) -> int:
        """Return what one session may hold, at most a quarter, of what as many as there may be hold together [bytes]."""
        return int(most // max(4, self.limits.sessions if isfinite(self.limits.sessions) else 0))

    def keep_page(self) -> None:
        """Have the collector pass over what stands until a session ends: to look through five pages takes a third of a second."""
        gc.collect(1)
        gc.freeze()

    def end_session(self) -> None:
        """Count a session that has ended."""
        with self._lock:
            self.sessions -= 1
            last = self.sessions == 0
        gc.unfreeze()
        if last:  # nobody is kept waiting
            gc.collect()
            release_memory()

    def run(self, scenario: Scenario, source: Source | None = None, seconds: float | None = None) -> Job:
        """Make the job that computes a scenario, or the observers on another record. Raises SettingError.

        seconds : about how long it takes, where what is known makes it shorter than a whole run
        """
        self.limits.check(scenario)
        if source is not None:
            source.check(self.limits)
        work: Work = lambda watch, tell: self._work(scenario, watch, tell, source)  # noqa: E731
        cost = run_seconds(scenario) if seconds is None else seconds
        return Job("run", work, key=run_key(scenario, source), cost=cost, refusal=SettingError)

    def start(self, make: Callable[[], Made]) -> Made:
        """Make something that starts processes which keep to a clock."""
        return self._starter.submit(make).result()

    def close(self, timeout: float = 1.5) -> bool:
        """Stop every job; whether all have ended in time [s]. To set `queue.closing` alone does the same later."""
        return self.queue.close(timeout)


class Session(param.Parameterized):
    """One visitor: their number, their tasks, and how another thread has something done on theirs.

    Before the visitor has come, what is not known already waits for them.
    """

    doing: param.Parameter[dict[str, tuple[float, str]]] = param.Parameter(
        {}, doc="What is at work beside the run: its name -> fraction done, and how it is going in a line."
    )

    def __init__(self, service: Service):
        super().__init__()
        self.service = service
        self.number: int = 0
        self.post: Post = lambda function: function()
        self.tasks: list[BackgroundTask] = []
        self.is_closed: bool = False
        self._waiting: dict[Listener, Job] | None = {}
        self._leave: dict[Listener, Callable[[], None]] = {}
        self._since = monotonic()

    def enter(self) -> None:
        """Have the visitor come, and what waited for them done. Raises Full."""
        self.number = self.service.count_session()
        self._since = monotonic()
        waiting, self._waiting = self._waiting or {}, None
        for listener, job in waiting.items():
            self._leave[listener] = self.submit(job, listener)

    def submit(self, job: Job, listener: Listener, before: Callable[[], None] = lambda: None) -> Callable[[], None]:
        """Have a job done when its turn comes, in place of the one before; how to take it back."""
        if self.is_closed:
            return lambda: None
        if self._waiting is not None and job.key not in self.service.cache:
            before()
            self._waiting[listener] = job
            return partial(self._take_back, listener)
        if job.priority != IDLE_TIME:
            self.service.note_wish()
        return self.service.queue.submit(job, self.number, listener, before)

    def leave(self) -> None:
        """Close the session, and cancel its jobs."""
        if not self.is_closed:
            self.is_closed = True
            for task in self.tasks:
                task.close()
            if self._waiting is None:
                self.service.end_session()
                event("session-end", session=self.number, seconds=monotonic() - self._since, sessions=self.service.sessions)

    def _take_back(self, listener: Listener) -> None:
        """Take back what waited, or what has become of it."""
        if self._waiting is not None:
            self._waiting.pop(listener, None)
        elif (leave := self._leave.pop(listener, None)) is not None:
            leave()


def run_key(scenario: Scenario, source: Source | None) -> str:
    """Name the results of settings on what they run on."""
    return key_of(scenario, source.key if source else "")


IDLE = "idle"


class BackgroundTask(param.Parameterized):
    """The state of one job of a session.

    Starting another supersedes the one before: it is left, and nothing of it lands any more, however late it comes.
    What is told of a job is gathered and lands in one `param.update` on the session's thread. Where its result is to be
    `drawn_first`, that it is done lands a moment later. A task with a `title` is named at the top of the page while
    it goes on.
    """

    state: param.Selector[str] = param.Selector(default=IDLE, objects=[IDLE, RUNNING, DONE, CANCELLED, FAILED])
    progress: param.Number[float] = param.Number(0.0, bounds=(0.0, 1.0), doc="Fraction done.")
    place: param.Integer[int] = param.Integer(0, doc="Place in the line of jobs, from 1; 0 when it is being done.")
    message: param.String[str] = param.String("", doc="Why it failed, in one line.")
    latest: param.Parameter[Any] = param.Parameter(None, doc="What the work has told of itself so far.")
    result: param.Parameter[Any] = param.Parameter(None, doc="The latest result, in parts where it comes in parts.")

    def __init__(self, session: Session, drawn_first: bool = False, title: str = ""):
        super().__init__()
        self.session = session
        self._drawn_first = drawn_first
        self._title = title
        if title:
            self.param.watch(self._announce, ["state", "progress", "place"])
        session.tasks.append(self)
        self._lock = threading.Lock()
        self._generation = 0
        self._news: dict[str, Any] = {}
        self._is_posted = False  # also where the news was of a job that has been left
        self._leave: Callable[[], None] = lambda: None

    def start(self, job: Job) -> None:
        """Start a job; it supersedes the one before."""
        generation = self._supersede()
        self.param.update(state=RUNNING, progress=0.0, place=0, message="", latest=None)
        self._leave = self.session.submit(job, partial(self._hear, generation), self._leave)

    def cancel(self) -> None:
        """Stop, or leave the queue; results so far are kept."""
        if self.state == RUNNING:
            self.close()
            self.param.update(state=CANCELLED)

    def refuse(self, why: str) -> None:
        """Fail with a reason in one line, without a job."""
        self.close()
        self.param.update(state=FAILED, message=why)

    def attempt(self, act: Callable[[], object]) -> bool:
        """Do something, or fail with the reason why it is refused in one line; return whether it was done."""
        try:
            act()
        except (SettingError, RecordError) as error:
            self.refuse(str(error).removeprefix("--over ").partition("\n")[0])
            return False
        return True

    def close(self) -> None:
        """Leave the job; later news of it is ignored."""
        self._supersede()
        before, self._leave = self._leave, lambda: None
        before()

    def line(self, doing: str = "Running") -> str:
        """Return place in the queue or progress in one line."""
        return f"Waiting: position {self.place}" if self.place else f"{doing}, {int(100 * self.progress)} %"

    def _announce(self, *_: object) -> None:
        others = {title: line for title, line in self.session.doing.items() if title != self._title}
        own = {self._title: (self.progress, self.line(self._title))} if self.state == RUNNING else {}
        self.session.doing = {**others, **own}

    def _supersede(self) -> int:
        with self._lock:
            self._generation += 1
            self._news = {}
            return self._generation

    def _hear(self, generation: int, news: Mapping[str, Any]) -> None:
        """Receive news of the job; from any thread."""
        with self._lock:
            if generation != self._generation:
                return
            self._news |= news
            if self._is_posted:
                return
            self._is_posted = True
        self.session.post(self._land)

    def _land(self) -> None:
        with self._lock:
            news, self._news, self._is_posted = self._news, {}, False
            if self._drawn_first and news.get("state") == DONE and "result" in news:
                self._news, self._is_posted = {"state": news.pop("state")}, True
            again = self._is_posted
        if news:
            self.param.update(**news)
        if again:
            self.session.post(self._land)
