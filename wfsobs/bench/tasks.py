"""All tasks, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import NamedTuple

from threadpoolctl import threadpool_limits

from wfsobs.bench import external
from wfsobs.bench.filters import adaptive_record, kalman_record, multirate_record
from wfsobs.bench.gpr import offline, online_record, online_stream
from wfsobs.bench.measure import OURS, Row, measure_time, peak_memory_mb, row, with_ratios
from wfsobs.bench.sizes import Sizes
from wfsobs.bench.steps import set_aside, steps
from wfsobs.bench.turbulence import frozen
from wfsobs.execution import run_observer
from wfsobs.observers import OBSERVERS
from wfsobs.pipeline import run
from wfsobs.priors_from.selection import usual_observers
from wfsobs.simulation.loop import simulate


class Task(NamedTuple):
    """A task, and its share of the time; it yields rows without their ratios."""

    run: Callable[[Sizes, Collection[str]], Iterator[Row]]
    weight: float


def longest_run(sizes: Sizes, _libraries: Collection[str]) -> Iterator[Row]:
    """Time a long run; the first task, so that the memory is its own."""
    if sizes.longest_duration is not None:
        scenario = sizes.scenario(sizes.longest_duration)
        seconds, _ = measure_time(lambda: run(scenario), 1)
        size = _length(sizes.longest_duration)
        yield row("whole-run", size, OURS, seconds, scenario.n_steps, peak_memory_mb=peak_memory_mb())


def whole_run(sizes: Sizes, _libraries: Collection[str]) -> Iterator[Row]:
    """Time simulation, every observer on two modes, and scores."""
    scenario, size = sizes.scenario(sizes.duration), _length(sizes.duration)
    seconds, _ = measure_time(lambda: run(scenario), sizes.repeats)
    yield row("whole-run", size, OURS, seconds, scenario.n_steps)
    learning = tuple(name for name, observer in OBSERVERS.items() if observer.slow)
    for variant, left_out in (("without-online-gpr", ("gpr-online",)), ("without-learning", learning)):
        quick = [name for name in usual_observers(scenario) if name not in left_out]
        seconds, _ = measure_time(lambda quick=quick: run(scenario, observers=quick), sizes.repeats)
        yield row("whole-run", size, variant, seconds, scenario.n_steps)


def each_observer(sizes: Sizes, _libraries: Collection[str]) -> Iterator[Row]:
    """Every observer of the registry on the same record of two modes; one that has no estimate of it is left out."""
    scenario, size = sizes.scenario(sizes.duration), _length(sizes.duration)
    record = simulate(scenario)
    for name in OBSERVERS:
        try:
            seconds, _ = measure_time(lambda name=name: run_observer(name, record, scenario), sizes.repeats)
        except ValueError:
            continue
        yield row("observer", f"{name}, {size}", OURS, seconds, record.n_steps)


def _length(duration: float) -> str:
    return f"{duration:g} s, 2 modes"


TASKS = (
    Task(longest_run, 1.0),
    Task(online_record, 5.0),
    Task(online_stream, 4.0),
    Task(offline, 3.0),
    Task(kalman_record, 2.0),
    Task(multirate_record, 2.0),
    Task(adaptive_record, 2.0),
    Task(each_observer, 2.0),
    Task(steps, 20.0),
    Task(frozen, 20.0),
    Task(whole_run, 3.0),
)
"""In the order of the table, but for the longest run."""


def measure_all(
    sizes: Sizes, progress: Callable[[float], None] | None = None, libraries: Sequence[str] | None = None
) -> list[Row]:
    """Every row. progress: told the fraction done; libraries: to compare with, by default those that are installed."""
    libraries = external.is_installed() if libraries is None else libraries
    total, done = sum(task.weight for task in TASKS), 0.0
    found: list[list[Row]] = []
    with threadpool_limits(1, user_api="blas"), set_aside():
        for task in TASKS:
            found.append(with_ratios(list(task.run(sizes, libraries))))
            done += task.weight
            if progress:
                progress(done / total)
    return [r for rows in [*found[1:], found[0]] for r in rows]
