"""Checks of observers from other packages, like scikit-learn's `check_estimator`.

>>> from wfsobs.observers import OBSERVERS
>>> from wfsobs.testing import check_observer
>>> check_observer(OBSERVERS["persistence"], alone=False)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from wfsobs.observers.base import TARGETS, Observer
from wfsobs.prior import Prior
from wfsobs.priors_from.scenario import arguments
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Measurements
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.testing.common import (
    QUICK,
    SAME,
    CheckError,
    Estimates,
    arrays_of,
    changed_after,
    check_numbers,
    check_steps,
    in_a_fresh_process,
    report_errors,
    steps_to_check,
    with_gap,
)


class ObserverRuns(NamedTuple):
    """An observer that is checked, and what is asked before each of its runs whether to stop."""

    observer: Observer
    watch: Watch

    def estimate(self, *arguments: Any) -> Estimates:
        """Return what it estimates, in arrays of the right shape. Raises CheckError."""
        with report_errors(self.observer.id, self.watch):
            found = self.observer.estimate(*arguments)
            _check_shapes(self.observer, found, arguments[0])
        return found

    def compare(self, got: Estimates, base: Estimates, what: str, stop: int | None = None, *, exact: bool = False) -> None:
        """Raise CheckError where two results differ before a step by more than rounding."""
        for target in self.observer.targets:
            bound = 0.0 if exact else SAME * float(np.nanstd(base[target]))
            if not np.allclose(got[target][:stop], base[target][:stop], rtol=0.0, atol=bound, equal_nan=True):
                raise CheckError(f"{self.observer.id}: {what} ({target})")


def check_observer(observer: Observer, scenario: Scenario | None = None, alone: bool = True, *, watch: Watch = QUIET) -> None:
    """Run an observer on a short simulated record and check the rules for all observers.

    It returns every target that it names, as numbers of the shape of the measurements; the same twice; unless it is marked as not
    causal, no later sample of any of its inputs changes an estimate; it does not change its arguments; it works with
    missing samples; where it can run frame by frame, its estimates are then the same; and in a fresh process, which has never had
    the truth, its estimates are the same.

    Parameters
    ----------
    observer : Observer
        The observer.
    scenario : Scenario, optional
        Settings of the simulation; by default 1.5 s of the preset paper.
    alone : bool
        Whether to start the fresh process; a script that does needs the guard `if __name__ == "__main__"`.
    watch : Watch
        Is asked before every run of the observer whether to stop.

    Raises
    ------
    CheckError
        The observer breaks a rule or raises an error; one line naming the observer and the rule.
    ValueError
        The scenario has no prior for the observer.
    Cancelled
        `watch` asks to stop.
    """
    s = scenario or PRESETS["paper"]().replace(QUICK)
    record = simulate(s)
    if missing := observer.missing(record):
        raise CheckError(f"{observer.id}: needs {', '.join(missing)}, which no record has")
    runs = ObserverRuns(observer, watch)
    given = arguments(observer, record, s)
    base = runs.estimate(*given)
    if empty := [target for target in observer.targets if np.isnan(base[target]).all()]:
        raise CheckError(f"{observer.id}: {empty[0]} has no estimate in any step")
    again = arguments(observer, record, s)
    runs.compare(runs.estimate(*again), base, "run twice on the same measurements it gives two results", exact=True)
    _check_untouched(observer, given[0], observer.measurements(record))
    if observer.causal:
        _check_causal(runs, given, base)
    _check_gaps(runs, given)
    check_steps(observer, *given, watch=watch)
    if alone:
        there = in_a_fresh_process(observer.id, watch, _run, observer, *again)
        _check_shapes(observer, there, given[0])
        what = "in a fresh process, with measurements and prior alone, it gives another result: it uses more than it is given"
        runs.compare(there, base, what)


def _check_shapes(observer: Observer, estimates: Estimates, measurements: Measurements) -> None:
    for target in observer.targets:
        if target not in TARGETS:
            raise CheckError(f"{observer.id}: target {target!r} is none of {', '.join(TARGETS)}")
        values = estimates[target]
        check_numbers(observer.id, target, values, measurements.y_lgs.shape)
        if np.isinf(values).any():
            raise CheckError(f"{observer.id}: {target} is infinite; NaN stands for steps without an estimate")


def _check_untouched(observer: Observer, measurements: Measurements, fresh: Measurements) -> None:
    now = arrays_of(measurements)
    for name, was in arrays_of(fresh).items():
        if not np.array_equal(now[name], was, equal_nan=True):
            raise CheckError(f"{observer.id}: changes its measurements ({name})")


def _check_causal(runs: ObserverRuns, arguments: tuple[Measurements, Prior, Any], base: Estimates) -> None:
    """phi_hat[k] may use y[0..k] and u[0..k], see `wfsobs.observers.base`."""
    measured, *rest = arguments
    for k in steps_to_check(measured.n_steps):
        what = f"looks ahead: measurements after step {k} change its estimate of that step or an earlier one"
        runs.compare(runs.estimate(changed_after(measured, k), *rest), base, what, stop=k + 1)


def _check_gaps(runs: ObserverRuns, arguments: tuple[Measurements, Prior, Any]) -> None:
    measured, *rest = arguments
    found = runs.estimate(with_gap(measured), *rest)
    for target in runs.observer.targets:
        if np.isnan(found[target][measured.n_steps // 2 + 1 :]).all():
            raise CheckError(f"{runs.observer.id}: {target} does not recover after missing samples")


def _run(observer: Observer, *arguments: Any) -> Estimates:
    return observer.estimate(*arguments)
