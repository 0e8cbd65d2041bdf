"""What theory says for a page, one answer after the other: the newest wish of every figure; what came before it is dropped."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from wfsobs.app.jobs.job import CANCELLED, CLICK, DONE, FAILED, Job
from wfsobs.app.service import Session

Work = Callable[[], Any]
Land = Callable[[Any, str], None]
"""Told what the work gave, None where it gave nothing, and why it did not."""


class Frames:
    """The answers of one session. One thread works on them at a time, so that they may share what they keep."""

    def __init__(self, session: Session):
        self.session = session
        self._next: dict[str, tuple[Work, Land]] = {}
        self._busy = False

    def ask(self, name: str, work: Work, land: Land) -> None:
        """Have something computed for a figure, in place of what it still waits for; the work raises ValueError with a reason."""
        self._next[name] = work, land
        self._go()

    def _go(self) -> None:
        if self._busy or not self._next:
            return
        self._busy = True
        work, land = self._next.pop(next(iter(self._next)))
        job = Job("prediction", lambda _watch, _tell: work(), priority=CLICK, quiet=True)
        self.session.submit(job, partial(self._hear, land))

    def _hear(self, land: Land, news: Mapping[str, Any]) -> None:
        """In any thread."""
        if news.get("state") in (DONE, FAILED, CANCELLED):
            self.session.post(partial(self._land, land, news))

    def _land(self, land: Land, news: Mapping[str, Any]) -> None:
        self._busy = False
        land(news.get("result"), news.get("message", ""))
        self._go()
