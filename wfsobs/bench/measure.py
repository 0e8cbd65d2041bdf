"""Timing, and the latency of observers and controllers called frame by frame, beside a fixed numpy step.

A step back to back has its numbers in the cache; one every millisecond, as in a loop, finds them gone and the processor asleep.
What such a step costs on a machine is seen from the reference: six small calls on 84 numbers. The two take turns, so that both
see the same machine. Garbage collection is off while they run, BLAS has one thread.
"""

from __future__ import annotations

import gc
import os
import platform
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from time import perf_counter, sleep
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.observers import OBSERVERS
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate
from wfsobs.stepping import design
from wfsobs.typing import Array

Row = dict[str, Any]
"""One measurement:

task, size, variant : what was done to what, by whom; variant `ours` is this package
steps               : steps of the work that was timed, None where it has none
median_s            : time of that work [s], median of repeats
per_step_us         : the same per step [us]; of a stream the median over single steps, estimate and update together
p999_us, ready_us   : of a stream: 99.9th percentile of a step, from 1000 steps on; sample to estimate, median [us]
p99_us, max_us      : of steps that are timed one by one: 99th percentile and maximum [us]
ratio_to_ours       : time, per step where there are steps, over that of `ours`
max_error_over_std  : largest error of a result over the standard deviation of the results
peak_memory_mb      : most memory the process has held until then [MB]

What does not apply is None.
"""

BESIDE = ("p99_us", "p999_us", "max_us", "ready_us", "ratio_to_ours", "max_error_over_std", "peak_memory_mb")
"""Keys of a row without a value where they do not apply."""

OURS = "ours"
ENOUGH = 0.25
"""Quick work is repeated for about this long [s]."""
ENOUGH_FOR_P999 = 1000
"""Steps below which a 99.9th percentile says nothing."""

T = TypeVar("T")


def measure_time(work: Callable[[], T], repeats: int) -> tuple[float, T]:
    """Median time of the work [s] over at least `repeats` calls, and what the last one returned."""
    seconds: list[float] = []
    while True:
        start = perf_counter()
        result = work()
        seconds.append(perf_counter() - start)
        if len(seconds) >= repeats and (sum(seconds) > ENOUGH or len(seconds) >= 5 * repeats):
            return median(seconds), result


def row(
    task: str,
    size: str,
    variant: str,
    seconds: float,
    steps: int | None = None,
    **more: float | None,
) -> Row:
    """Return a measurement, without its ratio; more : what else of it is known."""
    per_step = None if steps is None else seconds / steps * 1e6
    known = {"task": task, "size": size, "variant": variant, "steps": steps, "median_s": seconds, "per_step_us": per_step}
    return {**known, **dict.fromkeys(BESIDE), **more}


def with_ratios(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with their ratio to `ours` of the same task and size."""
    ours = {(r["task"], r["size"]): _cost(r) for r in rows if r["variant"] == OURS}
    return [{**r, "ratio_to_ours": _cost(r) / ours[r["task"], r["size"]]} for r in rows]


def _cost(one: Row) -> float:
    return one["median_s"] if one["per_step_us"] is None else one["per_step_us"]


def max_error(values: ArrayLike, exact: ArrayLike, std: float | None = None) -> float:
    """Largest difference over the standard deviation (of `exact` unless given)."""
    exact = np.asarray(exact)
    return float(np.abs(np.asarray(values) - exact).max() / (exact.std() if std is None else std))


def peak_memory_mb() -> float:
    """Most memory that this process has held so far [MB]."""
    import resource  # not on every system

    unit = 1e6 if sys.platform == "darwin" else 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit * (1.0 if sys.platform == "darwin" else 1.024)


def machine(libraries: Iterable[str] = ()) -> str:
    """One line on what was measured with and where."""
    found = [f"Python {platform.python_version()}"]
    for name in ("numpy", "scipy", *libraries):
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join([*found, "one BLAS thread", f"{_processor()}, {os.cpu_count()} cores"])


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


RATE = 1000.0
"""Frames per second of a paced run."""
WARM = 50
"""Steps before the first that counts."""
STATES = 84
"""Numbers in the state of the reference step: two modes of 42."""
SHARE = 0.999
"""Share of the frames that must be done in time."""
RATES = (4000, 3000, 2000, 1500, 1000, 800, 500, 250, 100, 50)
"""Rates [Hz] of which the highest is told that is held."""

Step = Callable[[int], object]


class Latency(NamedTuple):
    """Times of single steps, and for a paced run how late each began, (n,) [s]."""

    seconds: Array
    late: Array

    def percentiles(self) -> dict[str, float | None]:
        """Return p50, p99, p99.9 (None of fewer than 1000) and the maximum of the time of a step [us]."""
        p50, p99, p999, largest = (float(p) for p in np.percentile(self.seconds, [50.0, 99.0, 99.9, 100.0]) * 1e6)
        enough = len(self.seconds) >= ENOUGH_FOR_P999
        return {"per_step_us": p50, "p99_us": p99, "p999_us": p999 if enough else None, "max_us": largest}


def reference_step() -> Step:
    """Return the reference: a filter of 84 states by six small numpy calls."""
    a, c, gain, x = np.full(STATES, 0.99), np.full(STATES, 0.01), np.full(STATES, 0.1), np.zeros(STATES)
    e, out = np.zeros(STATES), np.zeros(1)

    def step(k: int) -> object:
        np.multiply(a, x, out=x)
        expected = c.dot(x)
        np.multiply(gain, 1.0 - expected, out=e)
        np.add(x, e, out=x)
        np.maximum(x, -1e3, out=x)
        out[0] = c.dot(x)
        return out

    return step


@contextmanager
def set_aside() -> Iterator[None]:
    """Have the garbage collector leave alone what is there already: it would go through all of that before every timing."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def quiet() -> Iterator[None]:
    """Keep the garbage collector out."""
    was = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


def back_to_back(step: Step, n: int) -> Latency:
    """Time n steps without a pause."""
    seconds = np.empty(n)
    with quiet():
        for k in range(WARM):
            step(k)
        for k in range(n):
            start = perf_counter()
            step(WARM + k)
            seconds[k] = perf_counter() - start
    return Latency(seconds, np.zeros(n))


def run_paced(steps: tuple[Step, ...], n: int, rate: float = RATE) -> list[Latency]:
    """Time n steps of each at a paced rate [Hz]; they take turns, one per frame."""
    count = len(steps)
    seconds, late, done = np.empty((count, n)), np.empty((count, n)), [0] * count
    with quiet():
        for step in steps:
            for k in range(WARM):
                step(k)
        begin = perf_counter()
        for k in range(n * count):
            which, due = k % count, begin + (k + 1) / rate
            while (left := due - perf_counter()) > 0.0:
                sleep(left)
            start = perf_counter()
            steps[which](WARM + done[which])
            end = perf_counter()
            seconds[which, done[which]], late[which, done[which]] = end - start, start - due
            done[which] += 1
    return [Latency(*one) for one in zip(seconds, late, strict=True)]


def step_of(name: str, scenario: Scenario, record: Record) -> Step:
    """Return a step of an observer (one frame in, one prediction out) or controller on a record that repeats.

    Raises ValueError where it has none.
    """
    one = design(name, scenario, sampling=record.sampling, train=record.training)
    n = record.ratio or record.n_steps + 1
    length = record.n_steps // n * n  # so that NGS frames come when they are due, however often the record is repeated
    z, u, y = record.z, record.u, record.y_lgs
    observer = OBSERVERS.get(name)
    slow = record.y_ngs if observer is None else record.z_ngs if "y_ngs" in observer.needs else None
    frames = [slow[k or length - n] if slow is not None and k % n == 0 else None for k in range(length)]
    taken = 0

    def step(k: int) -> object:
        nonlocal taken
        i = taken % length
        ngs = frames[i] if taken else None
        taken += 1
        if observer is None:
            return one.update(y[i], ngs)
        one.update(z[i], ngs, u[i])
        return one.predict(0, observer.targets[-1])

    return step


@dataclass(frozen=True)
class RealTime:
    """Timings of one observer or controller at a rate.

    alone     : its steps back to back
    step      : its steps at the rate
    reference : the reference step in the same run
    """

    name: str
    rate: float
    alone: Latency
    step: Latency
    reference: Latency

    @property
    def late_share(self) -> float:
        """Share of the frames that are not done before the next is due."""
        return float(np.mean(self._completion > 1.0 / self.rate))

    @property
    def highest_rate(self) -> float:
        """Highest of `RATES` [Hz] at which at least `SHARE` of these frames would be done before the next is due; 0 for none."""
        return max((rate for rate in RATES if np.mean(self._completion <= 1.0 / rate) >= SHARE), default=0)

    @property
    def _completion(self) -> np.ndarray:
        return self.step.late + self.step.seconds


def measure_realtime(name: str, scenario: Scenario, rate: float, seconds: float) -> RealTime:
    """Run the steps of an observer or controller for so long [s] at a rate [Hz]. Raises ValueError where it has none."""
    step = step_of(name, scenario, simulate(scenario))
    n = max(round(seconds * rate / 2), 1)
    alone = back_to_back(step, min(n, 5000))
    own, reference = run_paced((step, reference_step()), n, rate)
    return RealTime(name, rate, alone, own, reference)
