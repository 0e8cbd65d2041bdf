"""Error budget: the mean square error of an observer, cause by cause.

The measurements are a sum of sources (`sources`), and so are the estimates of a linear observer and its errors,

    e = e_noise + e_cone + e_lines + e_lag + e_mismatch.

The term of a cause is the mean of e_cause e. The terms add up to the mean of e^2, whatever the record and without an order of the
causes; between independent sources it is the mean of e_cause^2 but for chance. The response to the signal is compared with
that of the filter of the right model (`reference_filter`): what this lacks is lag, the difference of the two mismatch.

An observer that is not linear runs on every combination of sources, and e_cause is the mean over all orders of switching
them on (Shapley, Contributions to the Theory of Games II, 1953): those that learn from measurements learn anew each time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from wfsobs.evaluation.known_lines import given_lines
from wfsobs.evaluation.reference_filter import follow_signal
from wfsobs.evaluation.responses import observer_responses
from wfsobs.evaluation.rows import NO_ESTIMATE, own_bound
from wfsobs.evaluation.scores import Score
from wfsobs.evaluation.sources import CONE, LINES, NOISE, SIGNAL, Source, split_record
from wfsobs.evaluation.totals import with_total
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Observer
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.disturbance import vibration_lines
from wfsobs.simulation.sensing import OpenLoop
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.evaluation.result import Result

LAG, MISMATCH = "lag", "mismatch"

TERMS = {
    NOISE: "Noise",
    LAG: "Lag",
    LINES: "Unmodelled peaks",
    MISMATCH: "Model mismatch",
    CONE: "Cone effect and aliasing",
}
"""Terms of a budget, and their labels."""

LINEAR, AVERAGED = "linear", "averaged over orders"
"""How the terms were found."""

ONLY_NAMED = "only if named"
"""End of the reason why an observer has no budget that can have one."""


@dataclass(frozen=True)
class Budget:
    """Error budget of one observer, target and mode.

    Attributes
    ----------
    observer, target, mode : str
        Of what.
    total : float
        Mean square error, as scored [um^2].
    terms : dict of str to float
        Term -> its part of the total, in the order of TERMS [um^2]; empty where there is no budget.
    bound : float or None
        Minimum mean square error of any causal observer of the same measurements [um^2], a mark beside the terms; None where
        it is not known.
    method : str
        LINEAR or AVERAGED.
    reason : str
        Why there is no budget.
    """

    observer: str
    target: str
    mode: str
    total: float
    terms: dict[str, float] = field(default_factory=dict)
    bound: float | None = None
    method: str = LINEAR
    reason: str = ""


def error_budget(
    result: Result, *, observers: Sequence[str] | None = None, mode: str | None = None, watch: Watch = QUIET
) -> list[Budget]:
    """Split the mean square error of every observer of a run into its causes.

    Parameters
    ----------
    result : Result
        What `run` returned.
    observers : sequence of str, optional
        Ids of the observers; by default all that gave an estimate. Those that are not linear have a budget only if they are
        named: it takes 16 runs of the observer.
    mode : str, optional
        Name of a mode; by default all.
    watch : Watch, optional
        Receives the progress, and is asked between observers whether to stop.

    Returns
    -------
    list of Budget
        One per score, without the bounds and the observer that gives zero.

    Raises
    ------
    ValueError
        The record was not simulated from the scenario, or its vibration names no lines.
    Cancelled
        `watch` asks to stop.

    See Also
    --------
    run : Simulates a record and runs the observers.

    Examples
    --------
    >>> import wfsobs
    >>> result = wfsobs.run(wfsobs.PRESETS["paper"]().replace({"run.duration": 2.0}), observers=["kf-lgs"])
    >>> budget = wfsobs.error_budget(result)[0]
    >>> abs(sum(budget.terms.values()) / budget.total - 1.0) < 1e-9
    True
    """
    scenario, record = result.scenario, result.record
    _check_simulated(scenario, record)
    chosen = [name for name in dict.fromkeys(e.observer for e in result.estimates) if observers is None or name in observers]
    out: list[Budget] = []
    for i, name in enumerate(chosen):
        watch.step(i / len(chosen))
        own = [s for s in result.scores if s.observer == name and mode in (None, s.mode)]
        if name != NO_ESTIMATE and own:
            values = with_total({e.target: e.values for e in result.estimates if e.observer == name})
            bounds = {(s.target, s.mode): s.rms**2 for s in result.scores if s.observer == own_bound(name)}
            if reason := _without_budget(OBSERVERS[name], observers is not None):
                found = [Budget(s.observer, s.target, s.mode, s.rms**2, reason=reason) for s in own]
            else:
                found = _of_observer(OBSERVERS[name], scenario, record, values, own, watch)
            out += [replace(it, bound=bounds.get((it.target, it.mode))) for it in found]
    return out


def _check_simulated(scenario: Scenario, record: Record) -> None:
    """Raise ValueError where the sources of a record are not known."""
    if record.turbulence is None or record.vibration is None or record.n_steps != scenario.n_steps:
        raise ValueError("error budget: takes a record that was simulated from its scenario")
    if scenario.vibration.source == "psd":
        raise ValueError("error budget: vibration.source = psd is a table, not lines that a model could have")


def _without_budget(observer: Observer, by_name: bool) -> str:
    """Return why an observer has no budget, empty if it has."""
    if not observer.causal:
        return "looks ahead"
    if "y_stars" in observer.needs:
        return "takes every LGS by itself"
    return "" if observer.linear or by_name else f"not linear, takes 16 runs: {ONLY_NAMED}"


def _of_observer(
    observer: Observer, scenario: Scenario, record: Record, values: dict[str, Array], scores: Iterable[Score], watch: Watch
) -> list[Budget]:
    before = scenario.before_events
    lines = [[line[0] for line in vibration_lines(scenario, i)] for i in range(record.n_modes)]
    given = [_lines_of(observer, before, i, of) for i, of in enumerate(lines)]
    sources = split_record(scenario, record, lines, given)
    split, rest = observer_responses(observer, scenario, record, sources, watch)
    responses, rest = {name: with_total(of) for name, of in split.items()}, with_total(rest)
    truths = {name: with_total(part.truth) for name, part in sources.items()}
    columns = {mode.name: i for i, mode in enumerate(scenario.modes)}
    complete = {name: Source(_fill(part.measurement), part.truth) for name, part in sources.items()}
    reference: dict[int, dict[str, Array]] = {}
    out = []
    for s in scores:
        i = columns[s.mode]
        if i not in reference:
            watch.check()
            sensors = observer.sensors
            ratio = scenario.sensors.exposure_ratio
            reference[i] = with_total(follow_signal(before, i, given[i], sensors, complete[SIGNAL].measurement, ratio))
        truth = {name: of[s.target][:, i] for name, of in truths.items()}
        parts = {name: responses[name][s.target][:, i] - truth[name] for name in sources}
        lag = reference[i][s.target] - truth[SIGNAL]
        parts |= {LAG: lag, MISMATCH: parts.pop(SIGNAL) - lag + rest[s.target][:, i]}
        error = values[s.target][:, i] - sum(truth.values())
        out.append(Budget(s.observer, s.target, s.mode, s.rms**2, _terms(parts, error, s, record.dt), method=_method(observer)))
    return out


def _terms(parts: dict[str, Array], error: Array, score: Score, dt: float) -> dict[str, float]:
    """Return the mean of part times error over the scored samples, term by term."""
    assert score.start is not None and score.stop is not None
    scored = slice(round(score.start / dt), round(score.stop / dt))
    known = ~np.isnan(error[scored])
    return {name: float(np.mean(parts[name][scored][known] * error[scored][known])) for name in TERMS}


def _lines_of(observer: Observer, scenario: Scenario, column: int, lines: Sequence[float]) -> Sequence[float]:
    """Return the lines that an observer models; one that is given none and learns from the measurements can find them all."""
    return lines if not observer.prior and not observer.linear else given_lines(scenario, observer.id, column)


def _method(observer: Observer) -> str:
    return LINEAR if observer.linear else AVERAGED


def _fill(open_loop: OpenLoop) -> OpenLoop:
    return OpenLoop(np.nan_to_num(open_loop.lgs), np.nan_to_num(open_loop.ngs))


def budget_row(budget: Budget) -> dict[str, Any]:
    """Return a budget as a plain dictionary: what `wfsobs run --budget --json` adds to a row."""
    return {
        "total_um2": budget.total,
        "terms_um2": budget.terms or None,
        "bound_um2": budget.bound,
        "method": budget.method if budget.terms else None,
        "reason": budget.reason or None,
    }
