"""Run a campaign: batches on an executor until no run is missing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from dataclasses import dataclass
from pathlib import Path
from time import sleep

import numpy as np

from wfsobs.campaign.plan import Campaign, Cell, wanted_seeds
from wfsobs.campaign.pools import Workers
from wfsobs.campaign.store import BatchIndex, finished_runs, open_folder, remove_leftovers
from wfsobs.campaign.work import Batch, Summary, wfsobs_batch
from wfsobs.cost import run_seconds
from wfsobs.settings.errors import SettingError
from wfsobs.typing import Array

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
    finally:
        workers.close()


def _wanted_runs(plan: Campaign, folder: Path, shard: tuple[int, int]) -> tuple[Array, Array]:
    """Return the runs of a share that are wanted by now, and those that are finished, bool (n_runs,)."""
    finished = finished_runs(plan, folder)
    seeds = wanted_seeds(plan, finished, BatchIndex(folder)) if plan.stop else np.full(len(plan.cells), len(plan.seeds))
    wanted = np.arange(len(plan.seeds)) < seeds[:, None]
    return wanted.ravel() & _share(plan, shard), finished.ravel()


def _share(plan: Campaign, shard: tuple[int, int]) -> Array:
    """Return the runs of a share, bool (n_runs,): of every scenario some seeds, so that shares take equally long."""
    k, n = shard
    return np.arange(plan.n_runs) % n == k - 1


class _Batches:
    """The batches that are still to be done, as long as the wanted time by what runs took so far."""

    def __init__(self, plan: Campaign, todo: Array, folder: str):
        self.plan, self.todo, self.folder = plan, todo, folder
        self.position = 0
        self.again: list[Batch] = []
        self.actual_seconds, self.expected_seconds = 0.0, 0.0
        self._cost: dict[int, float] = {}

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

    def learn(self, batch: Batch, summary: Summary) -> None:
        """Correct the expected times by that of a batch."""
        self.actual_seconds += summary.seconds
        self.expected_seconds += sum(self.cost(cell.index) for cell, _ in batch.runs)

    def cost(self, cell: int) -> float:
        """Return the expected time of a run [s]."""
        if cell not in self._cost:
            if len(self._cost) > MOST_RUNS:
                self._cost.clear()
            self._cost[cell] = run_cost(self.plan, cell)
        return self._cost[cell]


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
    executor, running, in_a_row = workers.executor(), dict[Future[Summary], Batch](), 0
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
                summary = future.result()
            except Exception as error:
                if not _is_loss(error):
                    raise
                broken = True
                batches.again.append(batch)
                continue
            batches.learn(batch, summary)
            progress.n_done += summary.runs
            progress.runs += summary.runs
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
