"""What the page of the live loop does: a job that goes on as long as somebody watches."""

from __future__ import annotations

import logging
from time import sleep
from typing import Any

from wfsobs.app.jobs.job import CLICK, Job, Tell
from wfsobs.app.jobs.task import BackgroundTask
from wfsobs.app.live_order import LiveOrder
from wfsobs.app.logs import event
from wfsobs.app.service import Service
from wfsobs.live.loop import LiveLoop
from wfsobs.progress import Watch
from wfsobs.settings.errors import SettingError

LOOK = 0.2
"""Pause between two looks whether the loop goes on [s]."""
ENDED = "the processes of the loop have ended"


def compute(order: LiveOrder, service: Service, watch: Watch, tell: Tell) -> None:
    """Run a loop until the job is stopped. Raises SettingError, Cancelled."""
    loop = service.start(lambda: LiveLoop(order.source, order.scenario, order.observers, order.speed))
    try:
        order.begin(loop)
        loop.play()
        tell(latest=loop)
        while True:
            watch.check()
            if not loop.observers_are_alive:
                loop.tend()
                raise SettingError(loop.events[-1].line if loop.events else ENDED)
            sleep(LOOK)
    finally:
        order.end(loop)
        loop.stop()


def share_loop(order: LiveOrder, service: Service) -> None:
    """Run a loop that all sessions watch, until the server ends."""
    service.live = order
    service.queue.submit(live_job(order, service), "server", lambda news: _log_end(news.get("message", "")))


def _log_end(message: str) -> None:
    if message:
        event("live-ended", logging.ERROR, reason=message)


class LiveTask(BackgroundTask):
    """The live loop of a session, or the one that all sessions share."""

    def begin(self, order: LiveOrder) -> None:
        """Run a loop, in place of the one before."""
        if self.session.service.queue.workers < 2:
            self.refuse("A live loop takes one of at least two jobs at once: wfsobs serve --runs 2")
            return
        self.start(live_job(order, self.session.service))

    @property
    def loop(self) -> LiveLoop | None:
        """The loop, once it runs."""
        return self.latest


def live_job(order: LiveOrder, service: Service) -> Job:
    """Make the job of a loop."""
    work: Any = lambda watch, tell: compute(order, service, watch, tell)  # noqa: E731
    limits = service.limits
    return Job("live", work, key=order.key, priority=CLICK, time_limit=limits.live_seconds, endless=True, refusal=SettingError)
