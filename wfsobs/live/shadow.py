"""Looks after a loop: alarms every second, an identification every minute.

Frames are judged as they come, and the errors of observers as each process of them goes on: none waits for the slowest.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from wfsobs.live.alarms import Alarms
from wfsobs.live.finding import Finding, identify_frames
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.settings.group import SettingError

if TYPE_CHECKING:
    from wfsobs.live.loop import LiveLoop
    from wfsobs.live.processes import LiveProcesses

SECOND, MINUTE = 1.0, 60.0


class Shadow:
    """Called by its loop a few times a second."""

    def __init__(self, say: Callable[[str], None], processes: LiveProcesses):
        """Say : receives one line; processes : of its loop."""
        self._alarms, self._processes = Alarms(say), processes
        self._next_second, self._next_minute = SECOND, MINUTE
        self._identification: Future[Finding] | None = None

    def __call__(self, loop: LiveLoop) -> None:
        """Judge what has come since the last call."""
        now = loop.newest * loop.sampling.dt
        if now >= self._next_second:
            self._next_second = now + SECOND
            first, frames = self._processes.frames(SECOND)
            self._alarms.look_at(frames, first, loop.sampling.ratio)
            for view, observers in self._processes.views(SECOND):
                both = [name for name in observers if len(OBSERVERS[name].targets) == len(TARGETS)]
                self._alarms.judge(view, both)
        if now >= self._next_minute:
            self._next_minute = now + MINUTE
            if self._identification is None or self._identification.done():  # many peaks may take more than a minute
                self._identification = self._identify(loop)

    def _identify(self, loop: LiveLoop) -> Future[Finding] | None:
        """Have the last minute identified and compared; return what is found in time, None where nothing has come."""
        try:
            record = loop.recorder.look_back(MINUTE, loop.scenario)
        except SettingError:
            return None

        def take(finding: Finding) -> None:
            loop.workshop.keep(finding)
            self._alarms.compare(finding)

        return loop.workshop.do(identify_frames, record, loop.scenario.to_dict(), then=take)


def append_line(path: str, seconds: float, line: str) -> None:
    """Append a line to a log: the time in UTC, that of the loop, what has happened. Raises OSError."""
    with open(path, "a", encoding="utf-8") as file:
        file.write(f"{datetime.now(UTC).isoformat(timespec='milliseconds')} {seconds:.3f} {line}\n")
