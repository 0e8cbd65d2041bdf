"""A bounded load and abuse run against the served dashboard on this machine: `make load`.

    python scripts/load.py [--sessions 20] [--changes 10]

Starts `wfsobs serve` with its limits on and drives it through its websockets, without a browser. Prints what was done
and measured; the status is non-zero on any wrong or mixed result, missed bound, error or traceback in the server's log.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from abuse import abuse, crowd
from rich.console import Console
from rich.table import Table as RichTable
from tornado.httpclient import AsyncHTTPClient
from visitor import Visitor

import wfsobs
from wfsobs.app.display import per_micrometre
from wfsobs.app.render import number
from wfsobs.scenario import Scenario

ROOT = Path(__file__).parents[1]
LIFETIME = 3.0
SHORT = {
    "run.duration": 2.0,
    "run.warm_up": 0.5,
    "gpr_offline.training_size": 60,
    "gpr_offline.depth": 30,
    "gpr_online.training_size": 60,
    "gpr_online.depth": 30,
}
LONG = {"run.duration": 110.0, "gpr_online.training_size": 1024, "gpr_offline.training_size": 1024}
SETTINGS = 60
"""Different settings in a batch: sessions meet in some of them."""

CLICKS = 60
ANSWER = 0.2
GROWTH = 0.2
STOP = 2.0


class Server:
    """The server under test, its log in a file."""

    def __init__(self, folder: Path, *more: str):
        self.log = folder / "log"
        with socket.socket() as s:
            s.bind(("127.0.0.1", 0))
            self.port = s.getsockname()[1]
        self.base = f"localhost:{self.port}"
        flags = ["--public", "--port", str(self.port), "--lifetime", str(LIFETIME), "--cache-mb", "32", *more]
        environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}", "OPENBLAS_NUM_THREADS": "1"}
        with self.log.open("w") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "wfsobs", "serve", *flags], cwd=folder, env=environment, stdout=out, stderr=out
            )

    async def health(self) -> dict[str, Any]:
        """What /liveness says."""
        return json.loads((await AsyncHTTPClient().fetch(f"http://{self.base}/liveness", request_timeout=60.0)).body)

    async def until(self, condition: Callable[[dict[str, Any]], bool], timeout: float = 60.0) -> None:
        """Wait for what /liveness says."""
        async with asyncio.timeout(timeout):
            while True:
                try:
                    if condition(await self.health()):
                        return
                except OSError:
                    if self.process.poll() is not None:
                        raise
                await asyncio.sleep(0.1)

    def used(self) -> tuple[float, int]:
        """Resident memory [MB], and processor time so far [s]."""
        command = ["ps", "-o", "rss=,cputimes=", "-p", str(self.process.pid)]
        memory, seconds = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
        return int(memory) / 1e3, int(seconds)

    async def stop(self) -> tuple[float, int]:
        """Ask it to end: seconds that took, and its status."""
        start = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        status = await asyncio.to_thread(self.process.wait, 30)
        return time.monotonic() - start, status

    def end(self) -> None:
        """Have it end, whatever it does."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()

    def faults(self) -> list[str]:
        """Errors in the log, by their first line."""
        lines = self.log.read_text().splitlines()
        return [line for line in lines if " ERROR " in line or "Traceback" in line]


class Report:
    """What was done, and whether it was as it must be."""

    def __init__(self) -> None:
        self.rows: list[tuple[str, str, str, bool]] = []

    def add(self, what: str, measured: str, bound: str, good: bool) -> None:
        """One line."""
        self.rows.append((what, measured, bound, good))
        print(f"{'ok  ' if good else 'FAIL'} {what}: {measured}", flush=True)

    def show(self) -> int:
        """Print all; the status of the process."""
        table = RichTable("What", "Measured", "Must be", "")
        for what, measured, bound, good in self.rows:
            table.add_row(what, measured, bound, "ok" if good else "FAIL")
        Console(width=150).print(table)
        return 0 if all(good for *_, good in self.rows) else 1


def query_of(settings: dict[str, Any]) -> str:
    """A link's query."""
    return "?" + "&".join(f"{key}={value:g}" for key, value in settings.items())


def expected(settings: dict[str, Any]) -> dict[tuple[str, str], tuple[str, str]]:
    """(observer, target) -> error and truth [nm] as the table must have them, computed here."""
    scenario = wfsobs.PRESETS["paper"]().replace(settings)
    scale = per_micrometre("nm", scenario.telescope.diameter)
    mode = scenario.modes[0].name
    return {
        (s.observer, s.target): (number(s.rms * scale), number(s.truth_rms * scale))
        for s in wfsobs.run(scenario).scores
        if s.mode == mode
    }


Seen = tuple[dict[str, Any], dict[tuple[str, str], tuple[str, ...]]]


async def session(base: str, changes: int, rng: random.Random, door: asyncio.Lock) -> tuple[list[Seen], list[float]]:
    """One visitor, who comes in after the one before: what was shown for which settings, and how long each took [s]."""
    async with door:
        visitor = await Visitor(base).open(query_of(SHORT))
    await visitor.until(lambda: visitor.status.startswith("Done"))
    await visitor.ask("SERVER-INFO-REQ", {})  # all that was sent with it has arrived
    await visitor.set(visitor.find("IntInput", label="Seeds"), value=1)  # further seeds change the table while it says "Done"
    box = visitor.find("TextInput", label="Wind speed V₀ [m/s]")
    seen: list[Seen] = []
    seconds: list[float] = []
    speeds = rng.sample([5.25 + 0.5 * i for i in range(SETTINGS)], changes)
    for speed in speeds:
        start, before = time.monotonic(), visitor.numbers
        await visitor.set(box, value=f"{speed:g}")
        # not the line on the run: two results that took as long read the same
        try:
            await visitor.until(lambda before=before: visitor.numbers != before and visitor.status.startswith("Done"))
        except TimeoutError:
            raise TimeoutError(
                f"{speed:g} m/s asked for, the page says {visitor.status!r}, settings {visitor.query!r}, "
                f"table {'as before' if visitor.numbers == before else 'new'}"
            ) from None
        await visitor.ask("SERVER-INFO-REQ", {})
        seconds.append(time.monotonic() - start)
        seen.append(({**SHORT, "turbulence.wind_speed": speed}, visitor.table()))
        await asyncio.sleep(rng.uniform(0.0, 0.2))
    visitor.close()
    return seen, seconds


async def batch(server: Server, report: Report, name: str, sessions: int, changes: int, seed: int) -> tuple[list[Seen], float]:
    """Many sessions at once: all that they saw, and the server's memory once they are gone [MB]."""
    start, (_, before) = time.monotonic(), server.used()
    door = asyncio.Lock()
    done = await asyncio.gather(*(session(server.base, changes, random.Random(seed + i), door) for i in range(sessions)))
    took = time.monotonic() - start
    seconds = [second for _, own in done for second in own]
    await server.until(lambda health: health["sessions"] == 0)
    await asyncio.sleep(LIFETIME)
    memory, processor = server.used()
    report.add(
        f"{name}: {sessions} sessions, {changes} changes each",
        f"{took:.0f} s ({processor - before} s of processor); a change {statistics.median(seconds):.2f} s, "
        f"worst {max(seconds):.2f} s; then {memory:.0f} MB",
        "no error",
        True,
    )
    return [one for own, _ in done for one in own], memory


def check_results(report: Report, seen: list[Seen]) -> None:
    """Whether everybody was shown what belongs to their own settings."""
    wanted: dict[str, Any] = {}
    wrong = 0
    for settings, table in seen:
        key = json.dumps(settings)
        if key not in wanted:
            wanted[key] = expected(settings)
        wrong += {k: v for k, v in table.items() if v[0] not in ("", "–")} != wanted[key]
    report.add(
        "Tables against a direct computation",
        f"{len(seen)} tables of {len(wanted)} settings, {wrong} wrong",
        "0 wrong",
        wrong == 0 and len(seen) > 0,
    )


async def long_runs(server: Server, count: int) -> list[Visitor]:
    """Visitors whose long runs are under way."""
    visitors = [await Visitor(server.base).open(query_of({**LONG, "run.seed": 100 + i})) for i in range(count)]
    for visitor in visitors:
        await visitor.until(lambda visitor=visitor: "press Run" in visitor.status)
        await visitor.set(visitor.find("Button", label="Run"), clicks=1)
        await visitor.until(lambda visitor=visitor: visitor.status.startswith(("Running", "Waiting")))
    return visitors


async def clicks(server: Server, report: Report, busy: int) -> None:
    """Another visitor's clicks while long runs go on."""
    visitor = await Visitor(server.base).open(query_of(SHORT))
    await visitor.until(lambda: visitor.status.startswith("Done"))
    switches = [
        (visitor.find("RadioButtonGroup", value="Error"), ("Signal", "Error")),
        (visitor.find("RadioButtonGroup", value="Tip"), ("Tilt", "Tip")),
    ]
    drawings, seconds, quiet = [], [], []
    for which, values in switches:  # how much there is to draw, and how long it takes while nothing else goes on
        for value in values:
            await asyncio.sleep(1.0)
            before, start = len(visitor.drawn), time.perf_counter()
            await visitor.set(which, value=value)
            await asyncio.sleep(1.0)
            quiet.append(visitor.drawn[-1] - start)
        drawings.append(len(visitor.drawn) - before)
    idle = statistics.median(quiet)
    others = await long_runs(server, busy)
    await server.until(lambda health: health["running"] == busy)
    for i in range(CLICKS):
        which, values = switches[i % 2]
        seconds.append(await visitor.click(which, values[i // 2 % 2], drawings[i % 2]))
        await asyncio.sleep(0.05)
    still = (await server.health())["running"]
    for one in (visitor, *others):
        one.close()
    first, whole = (sorted(column) for column in zip(*seconds, strict=True))
    p95 = whole[int(0.95 * len(whole))]
    report.add(
        f"A visitor's {CLICKS} clicks beside {busy} long run(s), {still} still going after",
        f"first figure after {statistics.median(first):.3f} s, all {statistics.median(whole):.3f} s, 95 % within "
        f"{p95:.3f} s, worst {whole[-1]:.3f} s; {idle:.3f} s with nothing else going on",
        f"95 % within {ANSWER} s",
        p95 <= ANSWER and still == busy,
    )
    await server.until(lambda health: health["sessions"] == health["running"] == 0)


async def dropped(server: Server, report: Report) -> None:
    """Sessions that go away in the middle of their runs."""
    visitors = await long_runs(server, 5)
    places = [int(v.status.rpartition(" ")[2]) for v in visitors if v.status.startswith("Waiting")]
    for visitor in visitors:
        visitor.close()
    start = time.monotonic()
    await server.until(lambda health: health["sessions"] == health["running"] == health["waiting"] == 0)
    seconds = time.monotonic() - start
    report.add(
        "5 sessions dropped mid-run",
        f"{len(places)} of them in the line; all gone after {seconds:.1f} s",
        f"within {4 * LIFETIME:.0f} s",
        seconds < 4 * LIFETIME,
    )


async def crowded(report: Report) -> None:
    """More visitors than a server takes."""
    with tempfile.TemporaryDirectory(prefix="wfsobs-load-") as folder:
        server = Server(Path(folder), "--max-sessions", "5", "--lifetime", "60")
        try:
            await server.until(lambda health: health["ok"])
            await crowd(server.base, 5, report.add)
        finally:
            server.end()


async def stopped(server: Server, report: Report) -> None:
    """The server told to stop while it computes."""
    visitors = await long_runs(server, 3)
    seconds, status = await server.stop()
    for visitor in visitors:
        visitor.close()
    report.add(
        "SIGTERM in the middle of 3 runs",
        f"ended after {seconds:.1f} s, status {status}",
        f"within {STOP} s, 0",
        seconds <= STOP and status == 0,
    )


async def everything(server: Server, report: Report, sessions: int, changes: int) -> None:
    """One after the other."""
    await server.until(lambda health: health["ok"])
    await batch(server, report, "Warming up", 2, 2, 0)
    seen, first = await batch(server, report, "First batch", sessions, changes, 1000)
    more, second = await batch(server, report, "Second batch", sessions, changes, 2000)
    report.add(
        "Memory after the second batch over the first",
        f"{second:.0f} / {first:.0f} MB: {second / first - 1:+.0%}",
        f"at most {GROWTH:+.0%}",
        second <= (1 + GROWTH) * first,
    )
    await asyncio.to_thread(check_results, report, seen + more)
    runs = os.cpu_count() or 1
    for busy in sorted({1, runs}):
        await clicks(server, report, busy)
    await abuse(server.base, report.add)
    await server.until(lambda health: health["sessions"] == 0)
    await dropped(server, report)
    await crowded(report)
    await stopped(server, report)


def run(steps: Callable[[Server, Report], Awaitable[None]]) -> int:
    """Start a server, do the steps, stop it, look into its log; the status of the process."""
    AsyncHTTPClient.configure(None, max_clients=100)
    report = Report()
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="wfsobs-load-") as folder:
        server = Server(Path(folder))
        try:
            asyncio.run(steps(server, report))
        except Exception as error:  # named in the table; the rest is not done
            report.add("The run itself", f"{type(error).__name__}: {error}", "no error", False)
        finally:
            server.end()
        faults = server.faults()
        if not all(good for *_, good in report.rows) or faults:
            print(server.log.read_text()[-20_000:], file=sys.stderr)
        report.add("Errors in the server's log", str(len(faults)), "0", not faults)
    print(f"{time.monotonic() - start:.0f} s, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
    return report.show()


def main() -> int:
    """Run it all."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument("--changes", type=int, default=10)
    given = parser.parse_args()
    assert Scenario().replace(SHORT).n_steps == 2000
    return run(lambda server, report: everything(server, report, given.sessions, given.changes))


if __name__ == "__main__":
    sys.exit(main())
