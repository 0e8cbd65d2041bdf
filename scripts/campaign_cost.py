"""Say what a large campaign takes, by a small part of it that is measured: core hours, bytes, and load of a Dask scheduler.

    python scripts/campaign_cost.py PLAN [--runs 1000000] [--measured 400] [--tasks 2000]

Does some runs of a plan in this process, in batches as long as those of a campaign, and counts processor time and bytes of their
files; then sends batches that do nothing, with as many runs as a real one has, through a real Dask scheduler and one worker, and
counts the processor time of scheduler and client. Processor time, not that of a clock: other work on the machine moves it by tens
of per cent, not by factors. Prints a JSON object each, and one for all runs. Needs requirements-test.txt, and Linux.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
from bench_campaign import Cluster, cpu_seconds

from wfsobs.campaign.plan import Campaign, load_plan
from wfsobs.campaign.pools import DaskCluster
from wfsobs.campaign.run import AHEAD, BATCH, MOST_RUNS, Batch, run_rows, wfsobs_batch
from wfsobs.campaign.store import ROWS, batch_files


def skip_batch(batch: Batch) -> float:
    """Return the answer to a batch without doing it."""
    return 0.0


def measure_runs(plan: Campaign, folder: Path, measured: int) -> dict[str, Any]:
    """Return processor time [s] and bytes of a run, and how many a batch has."""
    (folder / ROWS).mkdir()
    cells = plan.cells[:4]
    for cell in cells:  # what is imported, designed and kept once
        run_rows(cell, 1, plan.observers, plan.controllers)
    start = time.process_time()
    run_rows(cells[0], 2, plan.observers, plan.controllers)
    size = min(MOST_RUNS, max(1, round(BATCH / (time.process_time() - start))))
    runs = [(cells[i * len(cells) // measured], 3 + i) for i in range(measured)]
    start = time.process_time()
    for first in range(0, measured, size):
        wfsobs_batch(Batch(tuple(runs[first : first + size]), plan.observers, plan.controllers, str(folder)))
    seconds = (time.process_time() - start) / measured
    used = sum(path.stat().st_size for path in batch_files(folder))
    blocks = sum(path.stat().st_blocks * 512 for path in batch_files(folder))
    return {
        "part": "runs",
        "cpu_s_per_run": round(seconds, 4),
        "runs_per_batch": max(1, round(BATCH / seconds)),
        "bytes_per_run": round(used / measured),
        "bytes_per_run_on_disk": round(blocks / measured),
    }


def measure_scheduler(plan: Campaign, folder: Path, runs: int, tasks: int) -> dict[str, Any]:
    """Return the processor time of scheduler and client per batch [s], and how many batches a second went through."""
    batch = Batch(tuple((plan.cells[0], i) for i in range(runs)), plan.observers, plan.controllers, str(folder))
    cluster = Cluster(folder, 1)
    try:
        workers = DaskCluster(cluster.address)
        executor = workers.executor()
        executor.submit(skip_batch, batch).result()
        family = {"scheduler": psutil.Process(cluster.scheduler.pid), "client": psutil.Process()}
        before, start, running, done = cpu_seconds(family), time.perf_counter(), set[Any](), 0
        while done < tasks:
            while len(running) < AHEAD * 8 and done + len(running) < tasks:
                running.add(executor.submit(skip_batch, replace(batch)))
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            done += len(finished)
        wall, after = time.perf_counter() - start, cpu_seconds(family)
        workers.close()
    finally:
        cluster.close()
    each = {f"{name}_cpu_ms": round((after[name] - before[name]) / tasks * 1e3, 3) for name in family}
    return {"part": "scheduler", "tasks": tasks, **each, "tasks_per_s": round(tasks / wall)}


def extrapolate(runs: int, one: dict[str, Any], dask: dict[str, Any]) -> dict[str, Any]:
    """Return what all runs take, and on how many workers a scheduler has half a core to do."""
    batches = runs / one["runs_per_batch"]
    return {
        "part": "all",
        "runs": runs,
        "core_hours": round(runs * one["cpu_s_per_run"] / 3600, 1),
        "files": round(batches),
        "gigabytes": round(runs * one["bytes_per_run"] / 1e9, 2),
        "scheduler_cpu_h": round(batches * dask["scheduler_cpu_ms"] / 3.6e6, 3),
        "workers_for_half_a_core": round(0.5 / (dask["scheduler_cpu_ms"] / 1e3) * BATCH),
    }


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("plan", type=Path)
    parser.add_argument("--runs", type=float, default=1e6)
    parser.add_argument("--measured", type=int, default=400)
    parser.add_argument("--tasks", type=int, default=2000)
    a = parser.parse_args()
    plan = load_plan(str(a.plan))
    with tempfile.TemporaryDirectory() as temporary:
        one = measure_runs(plan, Path(temporary), a.measured)
        dask = measure_scheduler(plan, Path(temporary), one["runs_per_batch"], a.tasks)
    for part in (one, dask, extrapolate(int(a.runs), one, dask)):
        print(json.dumps(part | {"load": round(os.getloadavg()[0], 1)}), flush=True)


if __name__ == "__main__":
    main()
