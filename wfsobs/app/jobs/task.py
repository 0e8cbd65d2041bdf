"""What a session shows of a job that it has asked for: one at a time, the latest."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import param

from wfsobs.app.jobs.job import CANCELLED, DONE, FAILED, RUNNING, Job

if TYPE_CHECKING:
    from wfsobs.app.service import Session

IDLE = "idle"


class BackgroundTask(param.Parameterized):
    """The state of one job of a session.

    Starting another supersedes the one before: it is left, and nothing of it lands any more, however late it comes.
    What is told of a job is gathered and lands in one `param.update` on the session's thread. Where its result is to be
    `drawn_first`, that it is done lands a moment later. A task with a `title` is named at the top of the page while
    it goes on.
    """

    state = param.Selector(default=IDLE, objects=[IDLE, RUNNING, DONE, CANCELLED, FAILED])
    progress = param.Number(0.0, bounds=(0.0, 1.0), doc="Fraction done.")
    place = param.Integer(0, doc="Place in the line of jobs, from 1; 0 when it is being done.")
    message = param.String("", doc="Why it failed, in one line.")
    latest = param.Parameter(None, doc="What the work has told of itself so far.")
    result = param.Parameter(None, doc="The latest result, in parts where it comes in parts.")

    def __init__(self, session: Session, drawn_first: bool = False, title: str = ""):
        super().__init__()
        self.session, self._drawn_first, self._title = session, drawn_first, title
        if title:
            self.param.watch(self._announce, ["state", "progress", "place"])
        session.tasks.append(self)
        self._lock = threading.Lock()
        self._generation = 0
        self._news: dict[str, Any] = {}
        self._is_posted = False
        self._leave: Callable[[], None] = _nothing

    def start(self, job: Job) -> None:
        """Have a job done, in place of the one before."""
        generation = self._supersede()
        self.param.update(state=RUNNING, progress=0.0, place=0, message="", latest=None)
        self._leave = self.session.submit(job, partial(self._hear, generation), self._leave)

    def cancel(self) -> None:
        """Stop, or leave the line; what has been delivered stays."""
        if self.state == RUNNING:
            self.close()
            self.param.update(state=CANCELLED)

    def refuse(self, why: str) -> None:
        """Say in one line why it is not even begun."""
        self.close()
        self.param.update(state=FAILED, message=why)

    def close(self) -> None:
        """Hear no more of it."""
        self._supersede()
        before, self._leave = self._leave, _nothing
        before()

    def line(self, doing: str = "Running") -> str:
        """How it is going, while it is."""
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
        """In any thread."""
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


def _nothing() -> None:
    return None
