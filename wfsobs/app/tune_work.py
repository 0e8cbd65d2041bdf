"""What the page of the tuning does and shows: the search, how long it takes, and its result as rows."""

from __future__ import annotations

from collections.abc import Sequence
from time import monotonic

from wfsobs.app.jobs.job import INTERVAL, Tell
from wfsobs.app.work import RunResults
from wfsobs.cost import part_seconds
from wfsobs.observers import OBSERVERS
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario
from wfsobs.tuning import Evaluation, Stage, TuningResult, tune
from wfsobs.tuning.judge import Errors
from wfsobs.tuning.records import MEASURES, TRUTH, judged_by
from wfsobs.tuning.report import settings

MOST = 1000
"""Evaluations."""

Rows = list[tuple[str, str, float | str | None, float | str | None]]
"""(section, name, before, after)."""

SETTING, VALIDATION, TEST, OTHER, LIKELIHOOD = "setting", "validation", "test", "other target", "likelihood"


def choices() -> dict[str, str]:
    """Label -> observer, of those that have something to tune."""
    return {o.label: o.id for o in OBSERVERS.values() if o.tunable.usual}


def seconds(of: RunResults, scenario: Scenario, observer: str, evaluations: int) -> float:
    """Estimate how long a tuning takes [s].

    The observer is taken to need the time per step that it had in the results shown, on records of the same length, or on at
    most half of a record that was loaded.
    """
    each = max((e.seconds_per_step for e in of.result.estimates if e.observer == observer), default=0.0)
    record, share = of.result.record, 0.5 if of.is_recorded else 1.0
    simulation = 0.0 if of.is_recorded else 3.0 * part_seconds(scenario)["rest"]
    return (evaluations + 2) * each * share * record.n_steps * record.n_modes + simulation


def minimised_measure(of: RunResults, observer: str, target: str) -> str:
    """Say what a tuning minimises. Raises RecordError where a loaded record has nothing to judge by."""
    return MEASURES[judged_by(of.result.record, observer, target)[1] if of.is_recorded else TRUTH]


def compute(
    of: RunResults, scenario: Scenario, observer: str, target: str, evaluations: int, watch: Watch, tell: Tell
) -> TuningResult:
    """Tune on simulated records, or on the pieces of a record that was loaded; tells of all evaluations so far.

    Raises SettingError, RecordError, Cancelled.
    """
    history: list[Evaluation] = []
    last = 0.0

    def told(evaluation: Evaluation) -> None:
        nonlocal last
        history.append(evaluation)
        if monotonic() - last >= INTERVAL:
            last = monotonic()
            tell(latest=tuple(history))

    record = of.result.record if of.is_recorded else None
    return tune(scenario, observer, evaluations=evaluations, record=record, target=target, on_evaluation=told, watch=watch)


def best_so_far(history: Sequence[Evaluation]) -> list[float]:
    """Compute the least error after every evaluation [um], infinite until one has succeeded."""
    out: list[float] = []
    for evaluation in history:
        out.append(min(evaluation.rms, out[-1] if out else evaluation.rms))
    return out


def tuning_rows(result: TuningResult) -> Rows:
    """List settings as text, errors [um] by mode and together, a GPR's log marginal likelihoods by mode; None for failures."""
    out: Rows = [(SETTING, *row) for row in settings(result)]
    stages = result.before, result.after
    for section, before, after in (
        (VALIDATION, *(s.validation for s in stages)),
        (TEST, *(s.test for s in stages)),
    ):
        out += [(section, name, _error(before, name), _error(after, name)) for name in (*_modes(stages), TOGETHER)]
    if any(s.other for s in stages):
        before, after = stages
        out.append((OTHER, TOGETHER, _error(before.other, TOGETHER), _error(after.other, TOGETHER)))
    if any(s.likelihood for s in stages):
        values = [s.likelihood or (None,) * len(_modes(stages)) for s in stages]
        out += [(LIKELIHOOD, *row) for row in zip(_modes(stages), *values, strict=True)]
    return out


TOGETHER = "rms over modes"


def _error(errors: Errors | None, name: str) -> float | None:
    return None if errors is None else errors.rms if name == TOGETHER else errors.modes[name]


def _modes(stages: Sequence[Stage]) -> tuple[str, ...]:
    return tuple(next(e.modes for s in stages for e in (s.validation, s.test) if e))
