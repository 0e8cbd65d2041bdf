"""Checks of observers from other packages, like scikit-learn's `check_estimator`.

>>> from wfsobs.observers import OBSERVERS
>>> from wfsobs.testing import check_observer
>>> check_observer(OBSERVERS["persistence"], alone=False)
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from wfsobs.observers.base import TARGETS, Observer
from wfsobs.prior import Prior
from wfsobs.priors_from.scenario import arguments
from wfsobs.record import Measurements
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.testing.common import QUICK, SAME, CheckError, change_from, in_a_fresh_process
from wfsobs.testing.steps import Estimates, check_steps


def check_observer(observer: Observer, scenario: Scenario | None = None, alone: bool = True) -> None:
    """Run an observer on a short simulated record and check the rules for all observers.

    It returns every target that it names, as numbers of the shape of the measurements; the same twice; unless it is marked as not
    causal, no later sample changes an estimate; it does not change its arguments; it works with
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

    Raises
    ------
    CheckError
        The observer breaks a rule; one line naming the observer and the rule.
    ValueError
        The observer has no estimate for the scenario.
    """
    s = scenario or PRESETS["paper"]().replace(QUICK)
    record = simulate(s)
    if missing := observer.missing(record):
        raise CheckError(f"{observer.id}: needs {', '.join(missing)}, which no record has")
    given = arguments(observer, record, s)
    base = observer.estimate(*given)
    _check_shapes(observer, base, given[0])
    again = arguments(observer, record, s)
    _compare(observer, observer.estimate(*again), base, "run twice on the same measurements it gives two results", exact=True)
    _check_untouched(observer, given[0], observer.measurements(record))
    if observer.causal:
        _check_causal(observer, given, base)
    _check_gaps(observer, given)
    check_steps(observer, *given)
    if alone:
        _compare(
            observer,
            in_a_fresh_process(observer.id, _run, observer, *again),
            base,
            "in a fresh process, with measurements and prior alone, it gives another result: it uses more than it is given",
        )


def _check_shapes(observer: Observer, base: Estimates, measurements: Measurements) -> None:
    for target in observer.targets:
        if target not in TARGETS:
            raise CheckError(f"{observer.id}: target {target!r} is none of {', '.join(TARGETS)}")
        values = base.get(target)
        if values is None:
            raise CheckError(f"{observer.id}: returns no {target}")
        if not isinstance(values, np.ndarray) or values.dtype != float or values.shape != measurements.y_lgs.shape:
            raise CheckError(f"{observer.id}: {target} takes numbers of shape {measurements.y_lgs.shape}, (n_steps, n_modes)")
        if np.isnan(values).all() or np.isinf(values).any():
            raise CheckError(f"{observer.id}: {target} has no estimate or is infinite; NaN stands for steps without one")


def _check_untouched(observer: Observer, measurements: Measurements, fresh: Measurements) -> None:
    for name in ("y_lgs", "u", "y_ngs", "open_loop_y", "y_stars"):
        was = getattr(fresh, name)
        if was is not None and not np.array_equal(getattr(measurements, name), was, equal_nan=True):
            raise CheckError(f"{observer.id}: changes its measurements ({name})")


def _check_causal(observer: Observer, arguments: tuple[Measurements, Prior, Any], base: Estimates) -> None:
    """phi_hat[k] may use y[0..k] and u[0..k], see `wfsobs.observers.base`."""
    measured, n = arguments[0], arguments[0].n_steps
    for k in (n // 2, n // 2 + 3, n - 5):
        rng = np.random.default_rng(k)
        later = replace(
            measured,
            y_lgs=change_from(measured.y_lgs, k + 1, rng),
            u=change_from(measured.u, k + 1, rng),
            y_ngs=None if measured.y_ngs is None else change_from(measured.y_ngs, k + 1, rng),
            y_stars=None if measured.y_stars is None else change_from(measured.y_stars, k + 1, rng),
        )
        _compare(
            observer,
            observer.estimate(later, *arguments[1:]),
            base,
            f"looks ahead: measurements after step {k} change its estimate of earlier steps",
            stop=k + 1,
        )


def _check_gaps(observer: Observer, arguments: tuple[Measurements, Prior, Any]) -> None:
    measured = arguments[0]
    y, start = measured.y_lgs.copy(), measured.n_steps // 2
    y[start : start + 7] = np.nan
    for target, values in observer.estimate(replace(measured, y_lgs=y), *arguments[1:]).items():
        if target in observer.targets and np.isnan(values[start + 1 :]).all():
            raise CheckError(f"{observer.id}: {target} does not recover after missing samples")


def _compare(
    observer: Observer, got: Estimates, base: Estimates, what: str, stop: int | None = None, exact: bool = False
) -> None:
    for target in observer.targets:
        a, b = got[target][:stop], base[target][:stop]
        bound = 0.0 if exact else SAME * float(np.nanstd(base[target]))
        if not np.allclose(a, b, rtol=0.0, atol=bound, equal_nan=True):
            raise CheckError(f"{observer.id}: {what} ({target})")


def _run(observer: Observer, *arguments: Any) -> Estimates:
    return observer.estimate(*arguments)
