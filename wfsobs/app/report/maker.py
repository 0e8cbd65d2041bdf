"""The dashboard's report, made in a process of its own: no page waits for it, and Panel is not in it."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import wfsobs
from wfsobs.app.report.data import Report, state_of
from wfsobs.app.report.packing import pack
from wfsobs.app.work import RunResults
from wfsobs.evaluation.evidence import Evidence
from wfsobs.progress import Watch

log = logging.getLogger(__name__)

LIMIT = 60.0
"""The most that waiting for others, and then the making, may take [s]."""

POLL = 0.1
"""How often it is looked whether anybody still wants it [s]."""


class ReportError(Exception):
    """Why there is no report, in one line."""


def make(
    results: RunResults,
    preset: str,
    watch: Watch,
    _tell: object = None,
    command: str = "",
    sweep: Mapping[str, Any] | None = None,
    evidence: Evidence | None = None,
    comparison: Mapping[str, Any] | None = None,
) -> bytes:
    """Make the file of the results shown; blocks, so call it in a job. Raises ReportError, Cancelled.

    command : what makes the estimates again, of a record that is not the simulation of the settings; sweep, comparison : what
    `Report` has of a sweep and of compared runs; evidence : what further seeds say
    """
    state = state_of(results.result, is_simulated=not results.is_recorded, evidence=evidence)
    content = pack(Report(preset, results.scenario, (), (state,), results.is_recorded, command, sweep, comparison))
    root = str(Path(wfsobs.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))}
    # A file, not a pipe: what a pipe has not taken when `communicate` times out is never sent.
    with TemporaryFile() as packet:
        packet.write(content)
        packet.seek(0)
        with subprocess.Popen(
            [sys.executable, "-m", "wfsobs.app.report"],
            env=environment,
            stdin=packet,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        ) as process:
            page, said = _output(process, watch)
    if process.returncode:
        log.error("the report could not be made:\n%s", said.decode(errors="replace"))
        raise ReportError("it could not be made; the server's log has the details")
    return page


def _output(process: subprocess.Popen[bytes], watch: Watch) -> tuple[bytes, bytes]:
    """Wait for a process and return its standard output and error; kill it where the report is no longer wanted."""
    try:
        while True:
            try:
                return process.communicate(timeout=POLL)
            except subprocess.TimeoutExpired:
                watch.check()
    except BaseException:
        process.kill()
        raise
