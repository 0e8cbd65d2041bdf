"""The work of one run, done in a thread: what it delivers, and how often.

Nothing here knows of Panel. `compute` runs the core and hands over what is done so far: the quick observers as soon as they are
done, then all but those that learn during the run, then those, in parts where they come in parts.
"""

from __future__ import annotations

import threading
from bisect import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter, sleep

import numpy as np
from threadpoolctl import threadpool_limits

from wfsobs.app.jobs import INTERVAL, Tell
from wfsobs.app.sources import Source
from wfsobs.dependence import Memo, RecordMemo, digest, simulate_once
from wfsobs.evaluation.bound import Bound, joint_observers, record_bounds
from wfsobs.evaluation.exact_errors import spectra
from wfsobs.evaluation.result import NO_ESTIMATE, Failure, Result
from wfsobs.execution import each_estimate
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import SLOW, TARGETS
from wfsobs.pipeline import as_stated, collect, with_gate
from wfsobs.prior import GIVEN, TRUE
from wfsobs.priors_from.scenario import usual_observers
from wfsobs.progress import Watch
from wfsobs.record import Estimate, Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import record_settings
from wfsobs.typing import Array

Key = tuple[str, str]
"""(observer or TRUTH, target)."""

TRUTH = "truth"


@dataclass(frozen=True)
class SignalAndError:
    """Power spectral densities [um^2/Hz], one column per mode, of a signal and of its error; frequency in [Hz]."""

    frequency: Array
    signal: Array
    error: Array


@dataclass(frozen=True)
class RunResults:
    """What a run has given so far.

    partial : values so far, NaN where there are none yet, of observers still at work
    spectra : of the truth and of every finished estimate
    source : what they are of where that is not the simulation of the settings
    bounds : of the record
    ran    : observers that ran for it, None for all; nothing changed that the others depend on, so their estimates were known
    """

    result: Result
    partial: Mapping[Key, Array] = field(default_factory=dict)
    spectra: Mapping[Key, SignalAndError] = field(default_factory=dict)
    seconds: float = 0.0
    source: Source | None = None
    bounds: Sequence[Bound] = ()
    ran: tuple[str, ...] | None = None

    @property
    def is_recorded(self) -> bool:
        """Whether the record stays whatever the settings."""
        return self.source is not None

    @property
    def simulation(self) -> Scenario | None:
        """What the record was simulated from; None where it was loaded."""
        return self.scenario if self.source is None else self.source.simulation

    @property
    def scenario(self) -> Scenario:
        """The settings this was computed from."""
        return self.result.scenario

    def values(self, observer: str, target: str) -> Array | None:
        """(n_steps, n_modes) [um] of the truth, a finished or a growing estimate, or None."""
        if observer == TRUTH:
            return self.result.record.truth(target)
        estimate = self.result.estimate(observer, target)
        return estimate.values if estimate else self.partial.get((observer, target))

    def sd(self, observer: str, target: str) -> Array | None:
        """(n_steps, n_modes) [um], the standard deviation that a finished estimate states, or None."""
        estimate = self.result.estimate(observer, target)
        return estimate.sd if estimate else None


DELIVERY_INTERVAL = 0.4
"""Least time between two deliveries [s], each of which has the page drawn anew."""

DRAWING = 0.15
"""What the page takes to draw a delivery [s]."""


WEIGHTS = (10.0, SLOW)
"""As soon as no observer is at work that is lighter than one of these, what is there is delivered: first what takes a few ms."""


def one_blas_thread() -> None:
    """Let BLAS use one thread: the observers bring their own, and sessions share the processors."""
    threadpool_limits(limits=1, user_api="blas")


class _Bounds(list[Bound]):
    """A list that a memo can hold."""


def compute(scenario: Scenario, watch: Watch, tell: Tell, source: Source | None = None, memo: Memo | None = None) -> RunResults:
    """Run everything on a scenario, or the observers on another record; report results as they come.

    memo : what is known in it by what it depends on does not run

    Raises SettingError, Cancelled.
    """
    return _Work(scenario, watch, tell, source, Memo() if memo is None else memo).run()


class _Work:
    def __init__(self, scenario: Scenario, watch: Watch, tell: Tell, source: Source | None, memo: Memo):
        self.scenario, self.tell, self.source, self.memo = scenario, tell, source, memo
        self.simulation = scenario if source is None else source.simulation
        self.report = watch.progress
        self.watch = Watch(progress=self._progress, is_cancelled=watch.is_cancelled)
        self.estimates: list[Estimate] = []
        self.failures: list[Failure] = []
        self.bounds: _Bounds | None = None
        self.growing: dict[Key, Array] = {}  # written to by the observers' threads
        self.spectra: dict[Key, SignalAndError] = {}
        self.start_time = self.report_time = self.delivery_time = perf_counter()
        self.news = False  # since the last delivery, of observers that run
        self.fraction = 0.0
        self.stage = 0
        self.lock, self.telling = threading.Lock(), threading.Lock()
        self.record: Record | None = None
        self.usual: list[str] = []

    def run(self) -> RunResults:
        self.watch.step(0.0)
        stated = self.scenario
        if self.source is None:
            record = simulate_once(stated, self.memo, self.watch)
        else:
            record = self.source.make(self.watch, self.memo)
            stated = as_stated(record, stated)
            record = with_gate(record, stated) if self.simulation is None else record
            stated.validate()
        self.record, self.known_estimates = record, RecordMemo(self.memo, record)
        self.usual = usual_observers(stated, record)
        simulation, bounds_name = self.simulation, ""
        if simulation is not None:  # bounds depend on it, whatever its seed
            settings = record_settings(simulation)
            del settings["run"]["seed"]
            bounds_name = digest("bounds", settings, record.n_steps, record.n_modes, joint_observers(simulation, self.usual))
        self.bounds = self.memo.get(bounds_name) if bounds_name else _Bounds()
        self._add_truth(record)
        known = self.known_estimates
        for item in each_estimate(record, stated, self.watch, on_partial=self._grow, memo=known):
            with self.lock:
                if isinstance(item, Failure):
                    self.failures.append(item)
                else:
                    self._add(record, item)
                self.news = self.news or item.observer not in known.known_observers
                left = self._left()
                # how many of the weights nothing lighter is left of
                stage = bisect(WEIGHTS, min((OBSERVERS[name].weight for name in left), default=SLOW))
                due = stage > self.stage and (left or self.bounds is None)
                self.stage = stage
                shown = self._deliver(record) if due else None
            if shown is not None:
                self.report(self.fraction)
                self.tell(result=shown)
                self._let_draw()
                if stage == len(WEIGHTS) and self.bounds is None and simulation is not None:
                    self.bounds = self.memo.put(bounds_name, _Bounds(record_bounds(simulation, record, self.usual)))
        return self._so_far(record)

    def _left(self) -> set[str]:
        """List the observers that have not delivered everything."""
        said = {(e.observer, e.target) for e in self.estimates}
        left = {name for name in self.usual if any((name, target) not in said for target in OBSERVERS[name].targets)}
        return left - {f.observer for f in self.failures}

    def _let_draw(self) -> None:
        """Leave the processors to the page and the browser while all but the slow observers are drawn."""
        until = perf_counter() + DRAWING
        while perf_counter() < until:
            self.watch.check()
            sleep(0.01)

    def _deliver(self, record: Record) -> RunResults:
        self.delivery_time, self.news = perf_counter(), False
        return self._so_far(record)

    def _so_far(self, record: Record) -> RunResults:
        least = self.bounds or ()
        told = TRUE if self.source is None else GIVEN
        derive = self.known_estimates.derive
        result = collect(self.scenario, record, self.estimates, self.failures, least=least, source=told, derive=derive)
        partial = {key: values.copy() for key, values in self.growing.items()}
        ran = tuple(name for name in self.usual if name not in self.known_estimates.known_observers)
        return RunResults(result, partial, dict(self.spectra), perf_counter() - self.start_time, self.source, least, ran)

    def _progress(self, fraction: float) -> None:
        """Take the progress of the observers; called from any of their threads."""
        with self.telling:  # one after the other, or a report could arrive before one that it was made after
            with self.lock:
                now = perf_counter()
                if now - self.report_time < INTERVAL or self.record is None:
                    return
                self.report_time = now
                self.fraction = fraction = max(self.fraction, fraction)  # modes at work in parallel overtake each other
                shown = None
                if self.news and now - self.delivery_time >= DELIVERY_INTERVAL:
                    shown = self._deliver(self.record)
            self.report(fraction)
            if shown is not None:
                self.tell(result=shown)

    def _grow(self, observer: str, target: str, values: Array) -> None:
        with self.lock:
            self.growing[observer, target] = values
            self.news = True

    def _add(self, record: Record, estimate: Estimate) -> None:
        key = (estimate.observer, estimate.target)
        self.estimates.append(estimate)
        self.growing.pop(key, None)
        if estimate.observer == NO_ESTIMATE:
            return  # it stands in the table alone
        truth = record.truth(estimate.target)
        make = partial(self._spectrum, record, estimate.target, estimate.values)
        spectrum = self.known_estimates.derive(estimate, f"spectra {self.scenario.run.warm_up}", make)
        if spectrum is not None:
            self.spectra[key] = spectrum if truth is not None else replace(spectrum, error=np.full_like(spectrum.error, np.nan))

    def _add_truth(self, record: Record) -> None:
        for target in TARGETS:
            truth = record.truth(target)
            if truth is None:
                continue
            name = digest("spectra", self.known_estimates.record, target, self.scenario.run.warm_up)
            spectrum = self.memo.keep(name, partial(self._spectrum, record, target, truth))
            if spectrum is not None:
                self.spectra[TRUTH, target] = spectrum

    def _spectrum(self, record: Record, target: str, values: Array) -> SignalAndError | None:
        """Over the samples that count for the scores; None where there are too few."""
        found = spectra(record, target, values, self.scenario.run.warm_up)
        return SignalAndError(*found) if found else None
