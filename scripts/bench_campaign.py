"""Kill the workers and the client of a campaign at random moments, compare its tables byte by byte, and measure what it costs.

    python scripts/bench_campaign.py [--runs 20000] [--kills 10] [--batch 2] [--seed 1] [--folder DIR]

Does tiny runs by `wfsobs campaign run` on two worker processes: a quarter of them on one pool and as two shares at once; all
of them undisturbed; on a Dask scheduler with two workers, and as two shares, where processes get SIGKILL at random moments. One
of the moments is the client's, which is started again, the others are workers', on Dask every third time with the nanny that
would start it again. Prints a JSON object per part: the digest of the table (`wfsobs campaign table --csv`), what was killed, the
peak of the memory of the driver, also where it is started again with all done. Then, for one worker, the overhead of batches over
their compute by wall clock, and the processor time beside the compute [cores]; and the size of the report of 1e5 rows. Needs
requirements-test.txt, and Linux.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from wfsobs.campaign.plan import Campaign, parse_plan
from wfsobs.campaign.pools import DaskCluster, Processes, Workers
from wfsobs.campaign.report import write_report
from wfsobs.campaign.run import AHEAD, Batch, run_rows, wfsobs_batch
from wfsobs.campaign.store import open_folder, write_batch

TINY = """
name = "Tiny"
seeds = {seeds}
observers = ["persistence"]
[settings]
run.duration = 0.1
run.warm_up = 0.02
[grid]
turbulence.wind_speed = [5, 10, 15, 20]
"""
CELLS = 4
DRIVER = """
import sys
from wfsobs.campaign import run
from wfsobs.cli import main

run.BATCH = {batch}
if __name__ == "__main__":
    try:
        main()
    finally:
        peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
        print(int(peak.split()[1]) / 1024, file=sys.stderr)
"""
"""The command line with batches of another length, which says at its end how much memory it took [MB]."""

NAMES = ("kf-lgs", "kf-multi", "multirate", "persistence")
ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}


class Cluster:
    """A Dask scheduler and its workers, each with a nanny that starts it again."""

    def __init__(self, folder: Path, count: int):
        self.folder, self.nannies = folder, list[subprocess.Popen[bytes]]()
        info = folder / "scheduler.json"
        info.unlink(missing_ok=True)
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(info))
        while not info.exists():
            time.sleep(0.1)
        self.address = json.loads(info.read_text())["address"]
        for _ in range(count):
            self.add_worker()

    def _start(self, what: str, *options: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", *options, "--no-dashboard"]
        return subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.DEVNULL)

    def add_worker(self) -> None:
        """Start a nanny, which starts a worker."""
        self.nannies.append(self._start("worker", self.address, "--nthreads", "1", "--local-directory", str(self.folder)))

    def workers(self) -> list[psutil.Process]:
        """Return the workers; in the place of a nanny that has given up another one is started."""
        for nanny in [n for n in self.nannies if n.poll() is not None]:
            self.nannies.remove(nanny)
            self.add_worker()
        return [worker for nanny in self.nannies for worker in spawned(nanny.pid)]

    def kill_nanny(self, worker: psutil.Process) -> None:
        """Kill the nanny of a worker, and start another one."""
        for nanny in [n for n in self.nannies if worker in descendants(n.pid)]:
            nanny.kill()
            nanny.wait()
            self.nannies.remove(nanny)
            self.add_worker()

    def close(self) -> None:
        """Kill all of it."""
        roots = [*self.nannies, self.scheduler]
        family = [p for root in roots for p in descendants(root.pid)]
        for root in roots:
            root.kill()
            root.wait()
        for process in family:
            kill(process)


def descendants(pid: int) -> list[psutil.Process]:
    """Return the processes that a process has started."""
    try:
        return psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def spawned(pid: int) -> list[psutil.Process]:
    """Return the workers among them."""
    out = []
    for process in descendants(pid):
        try:
            if "spawn_main" in " ".join(process.cmdline()):
                out.append(process)
        except psutil.NoSuchProcess:
            continue
    return out


def kill(process: psutil.Process) -> None:
    """Kill a process, if it is still there."""
    try:
        process.kill()
    except psutil.NoSuchProcess:
        pass


def kill_worker(worker: psutil.Process, cluster: Cluster | None) -> str:
    """Kill a worker, and its nanny where a cluster is given; return what was killed."""
    if cluster is not None:
        cluster.kill_nanny(worker)
    kill(worker)
    return "worker" if cluster is None else "worker and nanny"


class RowCounter:
    """Counts the rows of files, each read once."""

    def __init__(self) -> None:
        self.known: dict[Path, int] = {}

    def count(self, files: Sequence[Path]) -> int:
        """Return the number of rows."""
        import pyarrow.parquet as pq

        self.known.update({f: pq.read_metadata(f).num_rows for f in files if f not in self.known})
        return sum(self.known.values())


class Bench:
    """One plan, run in several ways."""

    def __init__(self, folder: Path, runs: int, batch: float):
        self.folder, self.batch = folder, batch
        self.path = folder / f"tiny-{runs}.toml"
        self.path.write_text(TINY.format(seeds=max(1, runs // CELLS)), encoding="utf-8")

    def start(self, out: str, options: Sequence[str]) -> subprocess.Popen[bytes]:
        """Start `wfsobs campaign run`."""
        program = [sys.executable, "-c", DRIVER.format(batch=self.batch)]
        command = [*program, "campaign", "run", str(self.path), "--out", str(self.folder / out), "--json", *options]
        return subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def run(
        self,
        out: str,
        shares: Sequence[Sequence[str]],
        moments: Sequence[int] = (),
        rng: np.random.Generator | None = None,
        cluster: Cluster | None = None,
    ) -> dict[str, Any]:
        """Run all shares at once, kill something when so many rows are written, and return what happened."""
        started, running = time.monotonic(), [self.start(out, options) for options in shares]
        while not self.files(out) and all(p.poll() is None for p in running):
            time.sleep(0.02)
        first = time.monotonic()
        kills, errors = list[str](), list[str]()
        client, counter = int(rng.integers(len(moments))) if rng is not None else -1, RowCounter()
        for i, moment in enumerate(moments):
            while (alive := [p for p in running if p.poll() is None]) and counter.count(self.files(out)) < moment:
                time.sleep(0.1)
            if not alive or rng is None:
                break
            time.sleep(rng.uniform(0.0, self.batch))  # somewhere within a batch
            if i == client:
                k = running.index(alive[rng.integers(len(alive))])
                running[k].kill()
                running[k].communicate()
                running[k] = self.start(out, shares[k])
                kills.append("client")
                continue
            while not (found := cluster.workers() if cluster else [w for p in alive for w in spawned(p.pid)]):
                time.sleep(0.1)  # they are just starting
                if all(p.poll() is not None for p in alive):
                    break
            if found:
                kills.append(kill_worker(found[rng.integers(len(found))], cluster if i % 3 == 2 else None))
        said = []
        for k, process in enumerate(running):
            answer, trouble = process.communicate()
            while process.returncode:
                errors.append(trouble.decode()[-500:])
                if len(errors) > 5:
                    raise SystemExit(f"{out}: {errors}")
                process = self.start(out, shares[k])
                answer, trouble = process.communicate()
            said.append(json.loads(answer) | {"peak_mb": round(float(trouble.split()[-1]), 1)})
        seconds = [round(time.monotonic() - since, 1) for since in (started, first)]
        return {
            "part": out,
            "seconds": seconds[0],
            "since_first_rows_s": seconds[1],
            "kills": kills,
            "ended_in_error": errors,
            "drivers": said,
        }

    def files(self, out: str) -> list[Path]:
        """Return the files of rows."""
        return list((self.folder / out / "rows").glob("[!.]*.parquet"))

    def digest(self, out: str) -> dict[str, Any]:
        """Return the digest of a table, its rows, and how many were computed twice."""
        folder = self.folder / out
        command = [sys.executable, "-m", "wfsobs", "campaign", "table", str(folder), "--csv"]
        text = subprocess.run(command, env=ENVIRONMENT, check=True, stdout=subprocess.PIPE).stdout
        files = self.files(out)
        rows, stored = text.count(b"\n") - 1, RowCounter().count(files)
        return {"sha256": hashlib.sha256(text).hexdigest(), "rows": rows, "twice": stored - rows, "files": len(files)}


def do_batch(batch: Batch) -> tuple[float, float, float]:
    """Do a batch; return the time of its runs, that of all of it [s], and the processor time of the thread that did it [s]."""
    start, cpu = time.perf_counter(), time.thread_time()
    seconds = wfsobs_batch(batch)
    return seconds, time.perf_counter() - start, time.thread_time() - cpu


def measure_cost(workers: Workers, batches: Sequence[Batch], family: Callable[[], dict[str, psutil.Process]]) -> dict[str, Any]:
    """Return the overhead of one worker over the compute of its batches; the first batch, with its imports, is not counted."""
    executor = workers.executor()
    executor.submit(do_batch, batches[0]).result()
    before, start = cpu_seconds(family()), time.perf_counter()
    todo, running, done = list(batches[1:]), set[Any](), list[tuple[float, float, float]]()
    while todo or running:
        while todo and len(running) < AHEAD:
            running.add(executor.submit(do_batch, todo.pop()))
        finished, running = wait(running, return_when=FIRST_COMPLETED)
        done += [future.result() for future in finished]
    wall, after = time.perf_counter() - start, cpu_seconds(family())
    workers.close()
    runs, inside, thread = (sum(values) for values in zip(*done, strict=True))
    used = {name: after[name] - before[name] for name in after}
    used["worker"] -= thread
    return {
        "batches": len(done),
        "batch_s": round(inside / len(done), 2),
        "batching_wall": round((inside - runs) / runs, 4),
        "all_wall": round((wall - runs) / runs, 4),
        "cores_beside": {name: round(seconds / wall, 4) for name, seconds in used.items()},
        "compute_cpu_s": round(thread / len(done), 2),
    }


def cpu_seconds(processes: dict[str, psutil.Process]) -> dict[str, float]:
    """Return the processor time of processes [s]."""
    return {name: sum(p.cpu_times()[:2]) for name, p in processes.items()}


def make_batches(plan: Campaign, folder: Path, seconds: float, count: int) -> list[Batch]:
    """Return batches of about the same processor time [s]."""
    run_rows(plan.cells[0], 1, plan.observers, ())
    start = time.process_time()
    for seed in range(2, 22):
        run_rows(plan.cells[0], seed, plan.observers, ())
    size = max(1, round(20 * seconds / (time.process_time() - start)))
    runs = [tuple((plan.cells[0], 1 + i * size + j) for j in range(size)) for i in range(count)]
    return [Batch(one, plan.observers, (), str(folder)) for one in runs]


def measure_report(folder: Path) -> dict[str, Any]:
    """Return the size of the report of 1e5 rows [MB], and the time that it took [s]."""
    grid = "[grid]\nturbulence.wind_speed = [5, 10, 15, 20, 25]\nsensors.exposure_ratio = [2, 5, 10, 20, 40]\n"
    plan, rng = parse_plan(f"seeds = 500\nobservers = {json.dumps(NAMES)}\n{grid}", folder), np.random.default_rng(2)
    open_folder(plan, folder)
    same = {"scenario": "paper", "mode": "tip", "apart": False, "note": ""}
    rows = [
        {**same, "key": f"{c}-{s}-{name}", "cell": c, "seed": s, "name": name, "target": t, "rms_nm": 10.0 + i + rng.normal()}
        for c in range(25)
        for s in plan.seeds
        for i, name in enumerate(NAMES)
        for t in ("turbulence", "vibration")
    ]
    write_batch(folder, rows, {"host": "", "process": 0, "written": 0.0})
    start = time.perf_counter()
    write_report(folder, folder / "report.html")
    size = (folder / "report.html").stat().st_size
    return {"part": "report", "rows": len(rows), "mb": round(size / 1e6, 2), "seconds": round(time.perf_counter() - start, 1)}


def say(result: dict[str, Any]) -> None:
    """Print a result, and how busy the machine is."""
    print(json.dumps(result | {"load": round(os.getloadavg()[0], 1)}), flush=True)


POOL = [("--workers", "2")]
SHARES = [("--shard", f"{k}/2", "--workers", "1") for k in (1, 2)]


def compare_shares(bench: Bench) -> None:
    """Run a plan on one pool and as shares, undisturbed."""
    for part, options in (("quarter", POOL), ("quarter-shares", SHARES)):
        say(bench.run(part, options) | bench.digest(part))


def disturb(bench: Bench, kills: int, seed: int) -> None:
    """Run a plan undisturbed and disturbed; say whether the tables are the same."""
    rng = np.random.default_rng(seed)
    whole = bench.run("undisturbed", POOL)
    expected = bench.digest("undisturbed")
    say(whole | expected)
    say(bench.run("undisturbed", POOL) | {"part": "started again"})

    def moments() -> list[int]:
        return [int(share * expected["rows"]) for share in np.sort(rng.uniform(0.02, 0.9, kills))]

    cluster = Cluster(bench.folder, 2)
    try:
        said = bench.run("dask-killed", [("--scheduler", cluster.address)], moments(), rng, cluster)
    finally:
        cluster.close()
    say_whether_same(said, bench.digest("dask-killed"), expected)
    say_whether_same(bench.run("shares-killed", SHARES, moments(), rng), bench.digest("shares-killed"), expected)


def say_whether_same(said: dict[str, Any], found: dict[str, Any], expected: dict[str, Any]) -> None:
    """Print a result, and whether its table is the expected one."""
    say(said | found | {"identical": found["sha256"] == expected["sha256"]})


def measure(folder: Path, batch: float, count: int) -> None:
    """Say what batches cost on one process of a pool, and on one Dask worker."""
    plan, me = parse_plan(TINY.format(seeds=1), folder), psutil.Process()
    (folder / "cost" / "rows").mkdir(parents=True, exist_ok=True)
    batches = make_batches(plan, folder / "cost", batch, count + 1)
    say({"part": "pool"} | measure_cost(Processes(1), batches, lambda: {"client": me, "worker": spawned(me.pid)[0]}))
    cluster = Cluster(folder, 1)
    try:
        here = {"client": me} | {
            n: psutil.Process(p.pid) for n, p in (("scheduler", cluster.scheduler), ("nanny", cluster.nannies[0]))
        }
        family = lambda: here | {"worker": cluster.workers()[0]}  # noqa: E731
        say({"part": "dask"} | measure_cost(DaskCluster(cluster.address), batches, family))
    finally:
        cluster.close()


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=20_000)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--batch", type=float, default=2.0, help="wanted time of a batch [s]")
    parser.add_argument("--batches", type=int, default=20, help="batches by which the overhead is measured")
    parser.add_argument("--seed", type=int, default=1, help="of the moments and the victims")
    parser.add_argument("--folder", type=Path, default=None, help="where the results stay; a temporary one unless told")
    a = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = a.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        compare_shares(Bench(folder, a.runs // 4, a.batch))
        disturb(Bench(folder, a.runs, a.batch), a.kills, a.seed)
        measure(folder, a.batch, a.batches)
        (folder / "report").mkdir(exist_ok=True)
        say(measure_report(folder / "report"))


if __name__ == "__main__":
    main()
