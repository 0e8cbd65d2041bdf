"""How good settings are on a record: the rms error of one observer, mode by mode."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import numpy as np

from wfsobs.evaluation.result import Failure
from wfsobs.evaluation.scores import PREDICTION, supervised_scores, unsupervised_scores
from wfsobs.execution import each_estimate
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS, VIBRATION
from wfsobs.observers.estimates import Estimate
from wfsobs.progress import Watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError


@dataclass(frozen=True)
class Errors:
    """Mode -> rms error [um]."""

    modes: dict[str, float]

    @property
    def rms(self) -> float:
        """Root of the mean square over the modes [um]."""
        return float(np.sqrt(np.mean(np.square([*self.modes.values()]))))


@dataclass(frozen=True)
class Judge:
    """The errors of one observer in one target: "turbulence", "vibration", or PREDICTION where there is no truth."""

    observer: str
    target: str

    def estimates(self, record: Record, scenario: Scenario, watch: Watch) -> list[Estimate]:
        """Run the observer on a record. Raises ValueError in one line where it cannot, Cancelled."""
        scenario.validate()
        out = []
        for item in each_estimate(record, scenario, watch, [self.observer]):
            if isinstance(item, Failure):
                raise RecordError(item.reason)
            out.append(item)
        return out

    def errors(self, record: Record, scenario: Scenario, estimates: list[Estimate], warm_up: float) -> Errors:
        """Over the steps after the warm-up [s] that have an estimate. Raises RecordError where there is none."""
        names = [m.name for m in scenario.modes][: record.n_modes]
        if self.target == PREDICTION:
            scores = [s for s in unsupervised_scores(record, estimates, warm_up, names) if s.observer == self.observer]
        else:
            scores = supervised_scores(record, [e for e in estimates if e.target == self.target], warm_up, names)
        modes = {s.mode: s.rms for s in scores}
        if len(modes) < len(names) or not all(map(isfinite, modes.values())):
            raise RecordError(f"{self.observer} has no estimate after the warm-up, {warm_up:g} s")
        return Errors(modes)

    def begins(self, estimates: list[Estimate]) -> int:
        """Return the first step with estimates."""
        silent = np.logical_or.reduce([np.isnan(e.values).any(axis=1) for e in estimates])[:-1]  # a reference lacks the last
        return int(silent.size - np.argmax(silent[::-1])) if silent.any() else 0


def target_of(observer: str, target: str | None) -> str:
    """Return the given target, by default vibration where the observer estimates it. Raises SettingError."""
    known = OBSERVERS[observer].targets
    if target is None:
        return VIBRATION if VIBRATION in known else known[0]
    if target not in TARGETS:
        raise SettingError(f"target {target!r}: takes one of {', '.join(TARGETS)}")
    if target not in known:
        raise SettingError(f"target {target!r}: {observer} estimates {' and '.join(known)}")
    return target
