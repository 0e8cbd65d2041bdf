"""The dashboard's report, made in a process of its own: no page waits for it, and Panel is not in it."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import wfsobs
from wfsobs.app.report.data import Report, state_of
from wfsobs.app.report.packing import packed
from wfsobs.app.work import Shown
from wfsobs.progress import Watch

log = logging.getLogger(__name__)

LIMIT = 60.0
"""The most that waiting for others, and then the making, may take [s]."""

POLL = 0.1
"""How often it is looked whether anybody still wants it [s]."""


class ReportError(Exception):
    """Why there is no report, in one line."""


def make(shown: Shown, preset: str, watch: Watch, _tell: object = None) -> bytes:
    """The file of the results shown; blocks, so that it belongs into a job. Raises ReportError, Cancelled."""
    content: bytes | None = packed(Report(preset, shown.scenario, (), (state_of(shown.result),), shown.recorded))
    root = str(Path(wfsobs.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))}
    with subprocess.Popen(
        [sys.executable, "-m", "wfsobs.app.report"],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        try:
            while True:
                try:
                    page, said = process.communicate(content, timeout=POLL)
                    break
                except subprocess.TimeoutExpired:
                    content = None  # it is on its way
                    watch.check()
        except BaseException:
            process.kill()
            raise
    if process.returncode:
        log.error("the report could not be made:\n%s", said.decode(errors="replace"))
        raise ReportError("it could not be made; the server's log has the details")
    return page
