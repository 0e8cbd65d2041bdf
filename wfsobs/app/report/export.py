"""A report from nothing, of every combination of variations of a scenario; and that of the dashboard, in a process of its own."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from wfsobs.app.report.data import Report, pack, state_of
from wfsobs.app.report.page import page
from wfsobs.app.work import RunResults
from wfsobs.evaluation.evidence import Evidence, gather_evidence
from wfsobs.evaluation.result import Result
from wfsobs.files import check_writable, write_whole
from wfsobs.pipeline import run
from wfsobs.progress import QUIET, Watch
from wfsobs.scenario import Scenario
from wfsobs.scenario.grid import Variation, scenarios


def export(
    path: str | Path,
    scenario: Scenario,
    *,
    observers: Sequence[str] | None = None,
    vary: Sequence[Variation] = (),
    preset: str = "paper",
    seeds: int = 1,
    watch: Watch = QUIET,
    on_result: Callable[[Result], None] | None = None,
) -> None:
    """Run a scenario and write a report: one HTML file with figures and numbers that opens without a network.

    Parameters
    ----------
    path : str or Path
        File to write.
    scenario : Scenario
        Settings of the run.
    observers : sequence of str, optional
        Ids of the observers; by default all that the scenario has something for.
    vary : sequence of Variation, optional
        Settings and their values (`wfsobs.scenario.grid.parse_variation`); every combination is run.
    preset : str
        Preset that the report compares the settings with.
    seeds : int
        Number of seeds of every state, `run.seed` and those after it; figures and budgets are of the first, errors have
        intervals over all.
    watch : Watch, optional
        Receives the progress, and is asked at every block of work whether to stop.
    on_result : callable, optional
        Receives every result.

    Raises
    ------
    SettingError
        Two settings exclude each other.
    OSError
        The file cannot be written.
    Cancelled
        `watch` asks to stop.
    """
    chosen = scenarios(scenario, vary)
    check_writable(path)
    kept = []
    for i, one in enumerate(chosen):
        of = []
        for number in range(seeds):
            done, scenario_of_seed = i + number / seeds, one.replace({"run.seed": one.run.seed + number}) if number else one
            inner = Watch(lambda f, done=done: watch.progress((done + f / seeds) / len(chosen)), watch.is_cancelled)
            of.append(run(scenario_of_seed, observers=observers, watch=inner))
        if on_result is not None:
            on_result(of[0])
        evidence = gather_evidence([result.scores for result in of]) if seeds > 1 else None
        kept.append(state_of(of[0], len(chosen), evidence=evidence, observers=observers))
    content = page(Report(preset, scenario, tuple(vary), tuple(kept)), datetime.now().astimezone()).encode()
    write_whole(path, lambda file: file.write(content))


# ---------------------------------------------------------------------------------------------- of the dashboard


log = logging.getLogger(__name__)

LIMIT = 240.0
"""The most that waiting for others, and then the making, may take [s]; long enough for a machine that is busy otherwise."""

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
    root = str(Path(__file__).parents[3])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))}
    # A file, not a pipe: what a pipe has not taken when `communicate` times out is never sent.
    with TemporaryFile() as packet:
        packet.write(content)
        packet.seek(0)
        with subprocess.Popen(
            [sys.executable, "-m", "wfsobs.app.report.page"],
            env=environment,
            stdin=packet,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        ) as process:
            made, said = _output(process, watch)
    if process.returncode:
        log.error("the report could not be made:\n%s", said.decode(errors="replace"))
        raise ReportError("it could not be made; the server's log has the details")
    return made


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
