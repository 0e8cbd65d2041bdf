"""Timing, and what a measurement looks like as a row."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

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
    *,
    per_step_us: float | None = None,
    p99_us: float | None = None,
    p999_us: float | None = None,
    max_us: float | None = None,
    ready_us: float | None = None,
    error: float | None = None,
    peak_memory_mb: float | None = None,
) -> Row:
    """Return a measurement, without its ratio."""
    if per_step_us is None and steps is not None:
        per_step_us = seconds / steps * 1e6
    return {
        "task": task,
        "size": size,
        "variant": variant,
        "steps": steps,
        "median_s": seconds,
        "per_step_us": per_step_us,
        "p99_us": p99_us,
        "p999_us": p999_us,
        "max_us": max_us,
        "ready_us": ready_us,
        "ratio_to_ours": None,
        "max_error_over_std": error,
        "peak_memory_mb": peak_memory_mb,
    }


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
