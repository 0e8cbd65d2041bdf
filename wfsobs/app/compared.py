"""A run that others are compared with: its scores, its spectra, and its traces as finely as they are ever looked at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wfsobs.app.render import NOTHING, change, number
from wfsobs.app.style import observers_of
from wfsobs.app.views.plots import envelope, envelope_times
from wfsobs.app.work import TRUTH, Key, RunResults, SignalAndError
from wfsobs.evaluation.rows import row_label, target_title
from wfsobs.evaluation.scores import Score
from wfsobs.observers.base import TARGETS
from wfsobs.result import Result
from wfsobs.scenario import Scenario

Array = NDArray[np.float64]

KEPT = 10_000
"""Pairs of extremes kept of a line: every sample of a record of 20 s."""

LETTERS = "ABCDE"
"""As many runs can be compared with the one shown."""


@dataclass(frozen=True)
class DrawnLines:
    """What is drawn of a run. times [s]; signals, errors: (times, modes) [um]."""

    spectra: Mapping[Key, SignalAndError]
    times: Array
    signals: Mapping[Key, NDArray[np.float32]]
    errors: Mapping[Key, NDArray[np.float32]]


@dataclass(frozen=True)
class ComparedRun:
    """A run beside the one shown.

    key   : of its entry in the history;  letter : what it is called in cards, figures and the table
    lines : what is drawn; None while its traces are being made again
    """

    key: str
    letter: str
    name: str
    scenario: Scenario
    scores: tuple[Score, ...]
    lines: DrawnLines | None = None

    def score(self, observer: str, target: str, mode: str) -> Score | None:
        """Find the score of one observer, target and mode; None if there is none."""
        return next((s for s in self.scores if (s.observer, s.target, s.mode) == (observer, target, mode)), None)


def thin_lines(results: RunResults) -> DrawnLines:
    """Select what is drawn of results, thinned."""
    signals: dict[Key, NDArray[np.float32]] = {}
    errors: dict[Key, NDArray[np.float32]] = {}
    for target in TARGETS:
        truth = results.values(TRUTH, target)
        for name in (TRUTH, *observers_of(target)):
            values = results.values(name, target)
            if values is not None:
                signals[name, target] = _thin(values)
                if truth is not None and name != TRUTH:
                    errors[name, target] = _thin(values - truth)
    record = results.result.record
    times = envelope_times(0, record.n_steps, KEPT, record.dt)
    return DrawnLines(dict(results.spectra), times, signals, errors)


def _thin(values: Array) -> NDArray[np.float32]:
    return np.column_stack([envelope(column, KEPT) for column in values.T]).astype(np.float32)


def comparison_of(runs: Sequence[ComparedRun], result: Result) -> dict[str, Any] | None:
    """Return what a report has of compared runs: their names, and a table per target and mode [nm]; None where there are none."""
    if not runs:
        return None
    groups: dict[tuple[str, str], list[list[str]]] = {}
    for now in result.scores:
        before = [run.score(now.observer, now.target, now.mode) for run in runs]
        if any(before):
            cells = [NOTHING if s is None else f"{number(1e3 * s.rms)} ({change(s.rms, now.rms)} %)" for s in before]
            groups.setdefault((now.target, now.mode), []).append([row_label(now.observer), number(1e3 * now.rms), *cells])
    return {
        "runs": [[run.letter, run.name] for run in runs],
        "columns": ["Observer", "shown [nm]", *(f"{run.letter} [nm]" for run in runs)],
        "groups": [[f"{target_title(target)}, {mode}", rows] for (target, mode), rows in groups.items()],
    }
