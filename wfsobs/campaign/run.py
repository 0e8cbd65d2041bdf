"""Running what is missing of a campaign: batches on many processes or machines, and the rows of one run."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from time import perf_counter, sleep, time
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from wfsobs.campaign.compare import compare, comparison_groups
from wfsobs.campaign.plan import Campaign, Cell, Stop
from wfsobs.campaign.pools import Workers
from wfsobs.campaign.store import (
    BatchIndex,
    finished_runs,
    open_folder,
    present_rows,
    remove_leftovers,
    row_key,
    scenario_digest,
    write_batch,
)
from wfsobs.closed_loop.design import Design, design
from wfsobs.closed_loop.run import closed_loop
from wfsobs.closed_loop.run import rows as loop_rows
from wfsobs.cost import run_seconds
from wfsobs.evaluation.bound import Bound, record_bounds
from wfsobs.evaluation.result import TIME, Failure, score_rows
from wfsobs.execution import each_estimate
from wfsobs.pipeline import collect
from wfsobs.record import Estimate, Record
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError, error_line
from wfsobs.simulation.loop import simulate
from wfsobs.typing import Array

if TYPE_CHECKING:
    import pyarrow

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


def wfsobs_batch(batch: Batch) -> float:
    """Do the runs of a batch, write their rows to a file, and return the time that they took [s].

    Raises OSError where the file cannot be written.

    The name is what dashboards of schedulers show.
    """
    start = perf_counter()
    with threadpool_limits(1, user_api="blas"):
        rows = [row for cell, seed in batch.runs for row in run_rows(cell, seed, batch.observers, batch.controllers)]
    seconds = perf_counter() - start
    write_batch(Path(batch.folder), rows, {"host": socket.gethostname(), "process": os.getpid(), "written": time()})
    return seconds


@dataclass
class _Ready:
    """A scenario, its digest, and what is the same for every seed: the design of its controllers, its bounds."""

    scenario: Scenario
    digest: str
    design: Design | None = None
    bounds: list[Bound] | None = None


@lru_cache(READY)
def _ready(settings: str) -> _Ready:
    """Return the scenario of a cell's `base` and `changes` in JSON, made once for all its seeds. Raises SettingError."""
    scenario = Cell(0, "", *json.loads(settings)).scenario()
    return _Ready(scenario, scenario_digest(scenario))


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
        ready = _ready(json.dumps([cell.base, cell.changes]))
        ready.scenario.run.seed = seed  # in place: a copy takes longer than a short record
        record = simulate(ready.scenario)
    except ValueError as error:  # settings that exclude each other, met in this cell alone
        names = (*observers, *controllers)
        return [{**same, **_failure(name, str(error)), "key": row_key(repr(cell.changes), seed, name)} for name in names]
    found = _rows_of_all(_observer_rows, record, ready, observers) + _rows_of_all(_controller_rows, record, ready, controllers)
    kernel = blas_kernel()
    return [{**same, **row, "key": row_key(ready.digest, seed, row["name"]), "kernel": kernel} for row in found]


def _rows_of_all(
    rows_of: Callable[[Record, _Ready, Sequence[str]], list[Row]], record: Record, ready: _Ready, names: Sequence[str]
) -> list[Row]:
    """Return the rows of observers or controllers; one that ends in an error is a failure, and the others run without it."""
    if not names:
        return []
    try:
        return rows_of(record, ready, names)
    except Exception as error:  # by an observer of another package, perhaps
        if len(names) == 1:
            return [_failure(names[0], error_line(error))]
        return [row for name in names for row in _rows_of_all(rows_of, record, replace(ready, design=None), [name])]


def _observer_rows(record: Record, ready: _Ready, observers: Sequence[str]) -> list[Row]:
    """Return the rows of observers and of their bounds; each is a failure where the settings of all cannot be used."""
    try:
        items = list(each_estimate(record, ready.scenario, observers=observers))
        estimates = [item for item in items if isinstance(item, Estimate)]
        if ready.bounds is None:
            ready.bounds = record_bounds(ready.scenario, record, {item.observer for item in estimates})
        failures = [item for item in items if isinstance(item, Failure)]
        result = collect(ready.scenario, record, estimates, failures, least=ready.bounds)
    except SettingError as error:
        return [_failure(name, str(error)) for name in observers]
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
    ready.design = ready.design or design(ready.scenario, controllers)
    result = closed_loop(record, ready.design)
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


BATCH = 3.0
"""Wanted time of a batch [s]: long against the overhead of a scheduler, short against the wait for the last ones."""
MOST_RUNS = 2000
"""Maximum number of runs of a batch."""
LOOK = 0.5
"""Time between two looks at the executor and at whether to stop [s]."""
AHEAD = 2
"""Batches in the executor per worker."""
BREAKS = 20
"""How often in a row an executor may break with no batch finished in between."""


HELD = 20_000
"""Rows that are held at a time, but for a scenario that has more."""


@dataclass
class Progress:
    """State of a campaign.

    Attributes
    ----------
    total, before : int
        Runs in this call's share, and how many of them were done before.
    n_done : int
        Runs done by now, those before included.
    runs : int
        Runs of this call.
    breaks : int
        How often workers died and their batches started again.
    """

    total: int
    before: int
    n_done: int = 0
    runs: int = 0
    breaks: int = 0


def run_campaign(
    plan: Campaign,
    folder: Path,
    workers: Workers,
    *,
    shard: tuple[int, int] = (1, 1),
    report: Callable[[Progress], None] = lambda _: None,
    must_stop: Callable[[], bool] = lambda: False,
) -> Progress:
    """Run what is missing of a campaign; call it again to resume.

    Parameters
    ----------
    plan : Campaign
        What to run.
    folder : Path
        Where the results are; they are written by the workers, one file per batch.
    workers : Workers
        Where batches run.
    shard : tuple of int
        (k, n): the k-th of n shares of the runs, from 1.
    report : callable
        Receives the progress after every batch.
    must_stop : callable
        Asked before every batch; true ends the campaign when the batches that run are finished.

    Returns
    -------
    Progress
        What is done.

    Raises
    ------
    SettingError
        The folder is that of another plan, or the workers die one after the other.
    OSError
        Results cannot be written.
    """
    open_folder(plan, folder)
    remove_leftovers(folder)
    progress = Progress(0, 0)
    try:
        while True:
            wanted, finished = _wanted_runs(plan, folder, shard)
            progress.total, progress.n_done = int(wanted.sum()), int((wanted & finished).sum())
            todo = np.flatnonzero(wanted & ~finished)
            if progress.runs == 0:
                progress.before = progress.n_done
            report(progress)
            if not len(todo) or must_stop():
                return progress
            _drive(_Batches(plan, todo, str(folder)), workers, progress, report, must_stop)
            if plan.stop is None or shard != (1, 1):  # shares decide when all of them have ended
                return progress
    except KeyboardInterrupt:
        workers.close(at_once=True)
        raise
    finally:
        workers.close()


def _wanted_runs(plan: Campaign, folder: Path, shard: tuple[int, int]) -> tuple[Array, Array]:
    """Return the runs of a share that are wanted by now, and those that are finished, bool (n_runs,)."""
    finished = finished_runs(plan, folder)
    seeds = wanted_seeds(plan, finished, BatchIndex(folder)) if plan.stop else np.full(len(plan.cells), len(plan.seeds))
    wanted = np.arange(len(plan.seeds)) < seeds[:, None]
    k, n = shard
    share = np.arange(plan.n_runs) % n == k - 1  # of every scenario some seeds, so that shares take equally long
    return wanted.ravel() & share, finished.ravel()


def wanted_seeds(plan: Campaign, complete: Array, rows: BatchIndex) -> Array:
    """Return how many seeds each scenario is to have by what is known, (n_cells,).

    At each look the first seeds alone count, so that the order of arrival does not matter. Some scenarios are decided at a time,
    so that as many rows are held whatever the number of scenarios.

    Parameters
    ----------
    plan : Campaign
        The campaign.
    complete : Array
        Runs that are finished, bool (n_cells, n_seeds).
    rows : BatchIndex
        Their rows.
    """
    assert plan.stop is not None
    wanted = np.full(len(plan.cells), plan.stop.looks[0])
    size = max(1, int(HELD / max(1.0, rows.n_rows / max(1, complete.sum()) * complete.sum(axis=1).max())))
    for start in range(0, len(wanted), size):
        cells = range(start, min(start + size, len(wanted)))
        if complete[cells, : plan.stop.looks[0]].all(axis=1).any():
            wanted[cells] = _wanted_of(plan, plan.stop, cells, complete[cells], present_rows(plan, rows.read(cells)))
    return wanted


def _wanted_of(plan: Campaign, stop: Stop, cells: range, complete: Array, table: pyarrow.Table) -> Array:
    """Return how many seeds some scenarios are to have, (n,); complete : (n, n_seeds)."""
    import pyarrow as pa

    wanted, undecided = np.full(len(cells), stop.looks[0]), np.ones(len(cells), dtype=bool)
    for count in stop.looks:
        wanted[undecided] = count
        undecided &= complete[:, :count].all(axis=1)  # the others wait for their seeds
        if not undecided.any():
            break
        table = table.filter(pa.array(undecided[table["cell"].to_numpy() - cells.start]))
        first = table.filter(pa.array(table["seed"].to_numpy() < plan.seeds.start + count))
        groups = comparison_groups(compare(first, stop.level))
        open_cells = {key[0] for key, compared in groups.items() if not stop.is_decided(compared)}
        undecided &= np.isin(cells, list(open_cells))
    return wanted


class _Batches:
    """The batches that are still to be done, as long as the wanted time by what runs took so far."""

    def __init__(self, plan: Campaign, todo: Array, folder: str):
        self.plan, self.todo, self.folder = plan, todo, folder
        self.position = 0
        self.again: list[Batch] = []
        self.actual_seconds, self.expected_seconds = 0.0, 0.0
        self.cost = lru_cache(MOST_RUNS)(partial(run_cost, plan))

    def __iter__(self) -> Iterator[Batch]:
        return self

    def __next__(self) -> Batch:
        """Return the next batch."""
        if self.again:
            return self.again.pop()
        if self.position >= len(self.todo):
            raise StopIteration
        runs: list[tuple[Cell, int]] = []
        seconds, speed = 0.0, self.actual_seconds / self.expected_seconds if self.expected_seconds else 1.0
        while self.position < len(self.todo) and len(runs) < MOST_RUNS and (not runs or seconds < BATCH):
            cell, seed = divmod(int(self.todo[self.position]), len(self.plan.seeds))
            seconds += speed * self.cost(cell)
            runs.append((self.plan.cells[cell], self.plan.seeds[seed]))
            self.position += 1
        return Batch(tuple(runs), self.plan.observers, self.plan.controllers, self.folder)

    def learn(self, batch: Batch, seconds: float) -> None:
        """Correct the expected times by that of a batch [s]."""
        self.actual_seconds += seconds
        self.expected_seconds += sum(self.cost(cell.index) for cell, _ in batch.runs)


def run_cost(plan: Campaign, cell: int) -> float:
    """Estimate the time of one run of a scenario [s]."""
    try:
        scenario = plan.cells[cell].scenario()
    except SettingError:
        return 1e-3
    return 2e-3 + run_seconds(scenario, plan.observers)


def _drive(
    batches: _Batches, workers: Workers, progress: Progress, report: Callable[[Progress], None], must_stop: Callable[[], bool]
) -> None:
    """Keep the executor busy until all batches are done."""
    executor, running, in_a_row = workers.executor(), dict[Future[float], Batch](), 0
    while True:
        if not (count := workers.count()):
            if must_stop():  # nothing would end what waits
                return
            sleep(LOOK)
            continue
        while not must_stop() and len(running) < AHEAD * count and (batch := next(batches, None)) is not None:
            try:
                running[executor.submit(wfsobs_batch, batch)] = batch
            except (BrokenExecutor, RuntimeError):  # noticed by a batch that runs, too
                batches.again.append(batch)
                break
        if not running and (must_stop() or not batches.again):
            return
        broken = not running
        for future in wait(running, timeout=LOOK, return_when=FIRST_COMPLETED).done:
            batch = running.pop(future)
            try:
                batches.learn(batch, future.result())
            except Exception as error:
                if not _is_loss(error):
                    raise
                broken = True
                batches.again.append(batch)
                continue
            progress.n_done += len(batch.runs)
            progress.runs += len(batch.runs)
            in_a_row = 0
            report(progress)
        if broken:
            in_a_row += 1
            progress.breaks += 1
            if in_a_row > BREAKS:
                raise SettingError(
                    f"workers died {in_a_row} times in a row with no batch finished: see their memory and time limits"
                )
            batches.again += running.values()
            running.clear()
            executor = workers.executor()


def _is_loss(error: Exception) -> bool:
    """Return whether an error says that a worker or a scheduler was lost, and not that a batch cannot be done."""
    if isinstance(error, OSError):
        return error.errno is None or isinstance(error, ConnectionError)
    return isinstance(error, (BrokenExecutor, CancelledError)) or type(error).__module__.startswith("distributed")
