"""Which observers a figure shows before the visitor has chosen: the few that matter."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.jobs import RUNNING
from wfsobs.app.render import number
from wfsobs.app.service import BackgroundTask
from wfsobs.app.style import look, observers_of
from wfsobs.app.work import RunResults
from wfsobs.evaluation.evidence import Evidence, rank_observers
from wfsobs.evaluation.known_lines import NOTHING, PEAKS, prior_knowledge
from wfsobs.evaluation.rows import can_be_best
from wfsobs.evaluation.scores import PREDICTION, Score
from wfsobs.observers.base import TARGETS

if TYPE_CHECKING:
    from wfsobs.app.seeds import SeedRuns

REFERENCES = ("kf-lgs", "gpr-online")
"""The two that the paper compares: always shown."""


def main_observers(scores: Iterable[Score], target: str, mode: str, evidence: Evidence | None = None) -> list[str]:
    """List the observers of a target that matter: those that the verdict names.

    These are the references, the best of all that can be compared, the best without prior knowledge and the best with known
    peak frequencies. evidence : errors over several seeds, whose means count then.

    Without truth the best are those that predict the next measurement best. All, where there is no score at all.
    """
    drawn = observers_of(target)
    rows = [s for s in scores if s.mode == mode and s.observer in drawn and can_be_best(s.observer, s.apart)]
    of_mode = [evidence.over_seeds(s) for s in rows] if evidence else rows
    rivals = [s for s in of_mode if s.target == target] or [s for s in of_mode if s.target == PREDICTION]
    ranked = rank_observers({s.observer: s.rms for s in rivals})
    best = ranked[:1]
    for kind in (NOTHING, PEAKS):
        best += [name for name in ranked if prior_knowledge(name) == kind][:1]
    return [name for name in drawn if name in best or name in REFERENCES] if best else drawn


def effect_line(display: Display, before: RunResults, now: RunResults) -> str:
    """Write the change of the record's error of the best observer without prior knowledge, for the target with the largest.

    Empty where it did not change, or where either run has no such error.
    """
    found: list[tuple[float, str]] = []
    scale = per_micrometre(display.unit, now.scenario.telescope.diameter)
    for target in TARGETS:
        old, new = (
            {
                s.observer: s.rms
                for s in results.result.scores
                if (s.target, s.mode) == (target, display.mode)
                and can_be_best(s.observer, s.apart)
                and prior_knowledge(s.observer) == NOTHING
            }
            for results in (before, now)
        )
        best = next((name for name in rank_observers(new) if name in old and name in observers_of(target)), None)
        if best is not None and new[best] != old[best]:
            errors = f"{number(scale * old[best])} → {number(scale * new[best])} {display.unit_label}"
            line = f"{target.capitalize()}, {look(best).label}: {errors} on this record"
            found.append((abs(np.log(new[best] / old[best])), line))
    return max(found)[1] if found else ""


class MainLines:
    """Keeps the lines that are shown to those that matter, per target, until the visitor chooses others.

    Made before the figures, so that they draw once. While a run goes on its first choice stays.
    """

    def __init__(self, run: BackgroundTask, display: Display, seeds: SeedRuns | None = None):
        self.run = run
        self.display = display
        self.seeds = seeds
        self._chosen_targets: set[str] = set()
        run.param.watch(self._on_results, ["result", "state"])  # the last result may come before the run is over
        display.param.watch(self._follow, "mode")
        if seeds is not None:
            seeds.param.watch(self._follow, "evidence")

    def choose(self, target: str, hidden_names: list[str]) -> None:
        """Hide these lines and no others from now on."""
        self._chosen_targets.add(target)
        self.display.hidden_lines = {**self.display.hidden_lines, target: list(hidden_names)}

    def choices(self) -> dict[str, list[str]]:
        """Return the hidden lines of the targets where the visitor has chosen."""
        return {target: self.display.hidden_lines.get(target, []) for target in TARGETS if target in self._chosen_targets}

    def names(self, target: str) -> list[str]:
        """List the observers of a target that matter (`main_observers`)."""
        results, evidence = self.run.result, self.seeds.evidence if self.seeds else None
        return main_observers(results.result.scores if results else (), target, self.display.mode, evidence)

    def reset(self, target: str) -> None:
        """Show those that matter again."""
        self._chosen_targets.discard(target)
        self._follow()

    def _on_results(self, *_: object) -> None:
        if self.run.state != RUNNING or not self.display.hidden_lines.keys() >= set(TARGETS):  # a link may say it of one
            self._follow()

    def _follow(self, *_: object) -> None:
        results = self.run.result
        if results is None:
            return
        hidden, named = dict(self.display.hidden_lines), {}
        for target in TARGETS:
            named[target] = self.names(target)
            if target not in self._chosen_targets:
                hidden[target] = [name for name in observers_of(target) if name not in named[target]]
        if (hidden, named) != (self.display.hidden_lines, self.display.named_lines):
            self.display.param.update(hidden_lines=hidden, named_lines=named)
