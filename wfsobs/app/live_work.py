"""A live loop as it is asked for, and the job that runs it as long as somebody watches."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import partial
from time import sleep
from typing import Any

from wfsobs.app.downloads import Save, TooLarge, record_file
from wfsobs.app.jobs import CLICK, Job, Tell
from wfsobs.app.logs import event
from wfsobs.app.service import Service
from wfsobs.live.loop import LiveLoop, LiveOrder
from wfsobs.progress import Watch
from wfsobs.record import Record, RecordError
from wfsobs.settings.values import SettingError

LOOK = 0.2
"""Pause between two looks whether the loop goes on [s]."""
FORMATS = {"NPZ": ".npz", "AOT": ".aot.fits"}
"""Of recordings: their endings."""


def compute(order: LiveOrder, service: Service, watch: Watch, tell: Tell) -> None:
    """Run a loop until the job is stopped. Raises SettingError, Cancelled."""
    loop = service.start(lambda: LiveLoop(order.source, order.scenario, order.observers, speed=order.speed))
    try:
        order.begin(loop)
        loop.play()
        tell(latest=loop)
        while True:
            watch.check()
            if reason := loop.failure():
                raise SettingError(reason)
            sleep(LOOK)
    finally:
        try:
            if lost := order.end(loop):
                event("live-recording", logging.WARNING, reason=lost)
        finally:
            loop.stop()


def share_loop(order: LiveOrder, service: Service, fail: Callable[[], None]) -> None:
    """Run a loop that all sessions watch, until the server ends; `fail` is called once it cannot go on."""

    def hear(news: Mapping[str, Any]) -> None:
        service.live_loop = news.get("latest", service.live_loop)
        if message := news.get("message"):
            event("live-failed", logging.ERROR, reason=message)
            fail()

    service.live = order
    service.queue.submit(live_job(order, service), "server", hear)


def live_counts(loop: LiveLoop | None) -> dict[str, Any]:
    """Return what is counted of a loop, as JSON takes it; nothing without one."""
    if loop is None:
        return {}
    delivery = loop.delivery
    late = {"late_share": delivery.late_share, "late_share_sent": delivery.late_share_sent}
    behind = (loop.newest - loop.count) * loop.sampling.dt
    return {"live": {"frames": delivery.frames, "lost": delivery.losses, **late, "behind_s": round(behind, 3)}}


def live_job(order: LiveOrder, service: Service) -> Job:
    """Make the job of a loop. Raises SettingError where there is no room for one."""
    if service.queue.workers < 2:
        raise SettingError("A live loop takes one of at least two jobs at once: wfsobs serve --runs 2")
    return Job(
        "live",
        partial(compute, order, service),
        key=order.key,
        priority=CLICK,
        time_limit=service.limits.live_seconds,
        endless=True,
        refusal=SettingError,
    )


def record_saves(loop: LiveLoop | None, look_back: float) -> dict[str, Save | None]:
    """Offer the last recording of a loop, and its last so many seconds, in each of FORMATS."""

    def save(name: str, is_there: bool, make: Callable[[LiveLoop], Record | None]) -> Save | None:
        if (live := loop) is None or not is_there:
            return None
        return Save(name, "application/octet-stream", lambda: _content(name, make(live), live))

    recorded = loop is not None and loop.recorder.record is not None
    sent = loop is not None and loop.newest > 0
    return {
        f"{what} as {kind}": save(name + end, is_there, make)
        for what, name, is_there, make in (
            ("Recording", "wfsobs-live", recorded, lambda live: live.recorder.record),
            ("Last two minutes", "wfsobs-live-last", sent, lambda live: live.recorder.look_back(look_back, live.scenario)),
        )
        for kind, end in FORMATS.items()
    }


def _content(name: str, record: Record | None, loop: LiveLoop) -> bytes:
    """Return a record as a file. Raises TooLarge with one line where its format does not take it."""
    assert record is not None
    try:
        return record_file(name, record, loop.scenario)
    except RecordError as error:
        raise TooLarge(str(error)) from None
