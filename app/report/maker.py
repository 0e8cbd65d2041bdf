"""The dashboard's report, made in a process of its own: no page waits for it, and Panel is not in it."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from pathlib import Path

import wfsobs
from wfsobs.app.report.data import Report, state_of
from wfsobs.app.report.packing import packed
from wfsobs.app.work import Shown

log = logging.getLogger(__name__)

LIMIT = 60.0
"""The most that waiting for others, and then the making, may take [s]."""

FAILED = "it could not be made; the server's log has the details"

_room = threading.BoundedSemaphore(1)  # of the server, however many sessions ask


class ReportError(Exception):
    """Why there is no report, in one line."""


class Maker:
    """The reports of one session."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False

    def make(self, shown: Shown, preset: str) -> bytes:
        """The file of the results shown; blocks, so that it belongs into a thread. Raises ReportError."""
        content = packed(Report(preset, shown.scenario, (), (state_of(shown.result),), shown.recorded))
        if not _room.acquire(timeout=LIMIT):
            raise ReportError("the server is busy with other reports, try again")
        try:
            return self._made(content)
        finally:
            _room.release()

    def close(self) -> None:
        """The session has ended: stop what is being made."""
        with self._lock:
            self._closed = True
            if self._process is not None:
                self._process.kill()

    def _made(self, content: bytes) -> bytes:
        with self._started() as process:
            try:
                page, said = process.communicate(content, timeout=LIMIT)
            except BaseException as error:
                process.kill()
                if isinstance(error, subprocess.TimeoutExpired):
                    raise ReportError(f"it took longer than {LIMIT:g} s") from None
                raise
            finally:
                self._process = None
        if self._closed:
            raise ReportError("stopped")
        if process.returncode:
            log.error("the report could not be made:\n%s", said.decode(errors="replace"))
            raise ReportError(FAILED)
        return page

    def _started(self) -> subprocess.Popen[bytes]:
        root = str(Path(wfsobs.__file__).parents[1])
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))}
        with self._lock:
            if self._closed:
                raise ReportError("stopped")
            self._process = subprocess.Popen(
                [sys.executable, "-m", "wfsobs.app.report"], env=environment,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
            return self._process
