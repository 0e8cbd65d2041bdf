"""Latency of observers and controllers called frame by frame, back to back and at a paced rate, beside a fixed numpy step.

A step back to back has its numbers in the cache; one every millisecond, as in a loop, finds them gone and the processor asleep.
What such a step costs on a machine is seen from the reference: six small calls on 84 numbers. The two take turns, so that both
see the same machine. Garbage collection is off while they run, BLAS has one thread.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter, sleep
from typing import NamedTuple

import numpy as np

from wfsobs.bench.measure import ENOUGH_FOR_P999
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.observers import OBSERVERS
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate
from wfsobs.stepping import design
from wfsobs.typing import Array

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
    slow = record.y_ngs if name in CONTROLLERS else record.z_ngs if record.y_ngs is not None else None
    frames = [slow[k or length - n] if slow is not None and k % n == 0 else None for k in range(length)]
    taken = 0
    if name in CONTROLLERS:

        def control(k: int) -> object:
            nonlocal taken
            taken += 1
            i = (taken - 1) % length
            return one.update(y[i], frames[i] if taken > 1 else None)

        return control
    target = OBSERVERS[name].targets[-1]
    needs_ngs = "y_ngs" in OBSERVERS[name].needs

    def observe(k: int) -> object:
        nonlocal taken
        taken += 1
        i = (taken - 1) % length
        one.update(z[i], frames[i] if needs_ngs and taken > 1 else None, u[i])
        return one.predict(0, target)

    return observe


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
