"""One batch of a campaign: simulate, run everything on each record, write one file."""

from __future__ import annotations

import json
import os
import socket
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from time import perf_counter, time
from typing import Any

from threadpoolctl import threadpool_info, threadpool_limits

from wfsobs.campaign.keys import row_key, scenario_digest
from wfsobs.campaign.plan import Cell
from wfsobs.campaign.store import write_batch
from wfsobs.closed_loop.design import Design, design
from wfsobs.closed_loop.rows import rows as loop_rows
from wfsobs.closed_loop.run import closed_loop
from wfsobs.evaluation.bound import Bound, record_bounds
from wfsobs.evaluation.result import Failure
from wfsobs.evaluation.rows import TIME, score_rows
from wfsobs.execution import each_estimate
from wfsobs.observers.estimates import Estimate
from wfsobs.pipeline import collect
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError
from wfsobs.simulation.loop import simulate

Row = dict[str, Any]

READY = 16
"""Scenarios that a process keeps."""


@dataclass(frozen=True)
class Batch:
    """Runs that one worker does in a row.

    Attributes
    ----------
    runs : tuple of (Cell, int)
        Scenario and seed.
    observers, controllers : tuple of str
        Ids of what runs on every record.
    folder : str
        Folder of the campaign.
    """

    runs: tuple[tuple[Cell, int], ...]
    observers: tuple[str, ...]
    controllers: tuple[str, ...]
    folder: str


@dataclass(frozen=True)
class Summary:
    """Summary of a batch.

    Attributes
    ----------
    runs : int
        Number of runs.
    seconds : float
        Time that they took [s].
    """

    runs: int
    seconds: float


def wfsobs_batch(batch: Batch) -> Summary:
    """Do the runs of a batch and write their rows to a file. Raises OSError where it cannot be written.

    The name is what dashboards of schedulers show.
    """
    start = perf_counter()
    with threadpool_limits(1, user_api="blas"):
        rows = [row for cell, seed in batch.runs for row in run_rows(cell, seed, batch.observers, batch.controllers)]
    seconds = perf_counter() - start
    write_batch(Path(batch.folder), rows, {"host": socket.gethostname(), "process": os.getpid(), "written": time()})
    return Summary(len(batch.runs), seconds)


@dataclass
class _Ready:
    """A scenario, its digest, and what is the same for every seed: the design of its controllers, its bounds."""

    scenario: Scenario
    digest: str
    design: Design | None = None
    bounds: list[Bound] | None = None


_READY: OrderedDict[str, _Ready] = OrderedDict()
"""The last scenarios of this process: the seeds of a cell follow each other."""


def _ready(cell: Cell) -> _Ready:
    """Return the scenario of a cell, made once for all seeds. Raises SettingError."""
    key = json.dumps([cell.base, cell.changes], sort_keys=True)
    if key not in _READY:
        scenario = cell.scenario()
        _READY[key] = _Ready(scenario, scenario_digest(scenario))
        while len(_READY) > READY:
            _READY.popitem(last=False)
    return _READY[key]


def run_rows(cell: Cell, seed: int, observers: Sequence[str], controllers: Sequence[str]) -> list[Row]:
    """Return the rows of one record: errors of observers, residuals of controllers, and what failed.

    Parameters
    ----------
    cell : Cell
        Scenario.
    seed : int
        Seed of the record.
    observers, controllers : sequence of str
        Ids.

    Returns
    -------
    list of dict
        One per observer or controller, target and mode.
    """
    same = {"cell": cell.index, "scenario": cell.name, "seed": seed}
    try:
        ready = _ready(cell)
        ready.scenario.run.seed = seed  # in place: a copy takes longer than a short record
        record = simulate(ready.scenario)
    except ValueError as error:  # settings that exclude each other, met in this cell alone
        names = (*observers, *controllers)
        return [{**same, **_failure(name, str(error)), "key": row_key(repr(cell.changes), seed, name)} for name in names]
    found = _observer_rows(record, ready, observers) + _controller_rows(record, ready, controllers)
    kernel = blas_kernel()
    return [{**same, **row, "key": row_key(ready.digest, seed, row["name"]), "kernel": kernel} for row in found]


def _observer_rows(record: Record, ready: _Ready, observers: Sequence[str]) -> list[Row]:
    """Return the rows of observers; one that ends in an error is a failure, and the others run without it."""
    if not observers:
        return []
    try:
        items = list(each_estimate(record, ready.scenario, observers=observers))
        if ready.bounds is None:
            ready.bounds = record_bounds(ready.scenario, record, {item.observer for item in items if isinstance(item, Estimate)})
        estimates = [item for item in items if isinstance(item, Estimate)]
        failures = [item for item in items if isinstance(item, Failure)]
        result = collect(ready.scenario, record, estimates, failures, least=ready.bounds)
    except SettingError as error:
        return [_failure(name, str(error)) for name in observers]
    except Exception as error:  # by an observer of another package, perhaps
        if len(observers) == 1:
            return [_failure(observers[0], f"{type(error).__name__}: {error}")]
        return [row for name in observers for row in _observer_rows(record, ready, [name])]
    rows = [
        {
            "name": row["observer"],
            "target": row["target"],
            "mode": row["mode"],
            "rms_nm": row["rms_um"] * 1e3,
            "truth_rms_nm": None if row["truth_rms_um"] is None else row["truth_rms_um"] * 1e3,
            "start_s": row["start_s"],
            "apart": row["apart"],
            "step_us": row[TIME],
            "note": "",
        }
        for row in score_rows(result.scores, None)
    ]
    return rows + [_failure(failure.observer, failure.reason) for failure in result.failures]


def _controller_rows(record: Record, ready: _Ready, controllers: Sequence[str]) -> list[Row]:
    """Return the rows of controllers and of their bound."""
    if not controllers:
        return []
    try:
        ready.design = ready.design or design(ready.scenario, controllers)
        result = closed_loop(record, ready.design)
    except Exception as error:
        return [_failure(name, f"{type(error).__name__}: {error}") for name in controllers]
    return [
        {
            "name": row["controller"],
            "target": "residual",
            "mode": row["mode"],
            "rms_nm": row["residual_rms_nm"],
            "start_s": result.design.start,
            "apart": False,
            "note": row["note"],
        }
        for row in loop_rows(result, None)
    ]


def _failure(name: str, reason: str) -> Row:
    return {"name": name, "target": "", "mode": "", "rms_nm": None, "apart": False, "note": reason}


@cache
def blas_kernel() -> str:
    """Return the kernel that the BLAS library of this process has chosen: the last digits depend on it.

    It is chosen once, and to ask takes as long as a tenth of a short run.
    """
    return next((str(lib.get("architecture")) for lib in threadpool_info() if lib.get("user_api") == "blas"), "")
