"""The verdict above the figures of a target, what does harm and why; and the lines shown at first: those that it names."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import TYPE_CHECKING, Final

import numpy as np
from markupsafe import Markup

from wfsobs.app.display import Display
from wfsobs.app.glossary import BOUND, TERMS, explain_first
from wfsobs.app.idle_work import Budgets, SeedRuns
from wfsobs.app.jobs import DONE, RUNNING
from wfsobs.app.render import macro, number
from wfsobs.app.service import IDLE, BackgroundTask
from wfsobs.app.style import follow_html, look, observers_of, watch
from wfsobs.app.work import TRUTH, RunResults
from wfsobs.evaluation.evidence import Evidence, rank_observers
from wfsobs.evaluation.rows import NOTHING, PEAKS, can_be_best, prior_knowledge, target_title
from wfsobs.evaluation.scores import PREDICTION, Score
from wfsobs.evaluation.verdict import verdict
from wfsobs.observers.base import TARGETS

if TYPE_CHECKING:
    from wfsobs.app.idle_work import SeedRuns

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
    scale = display.scale(now.scenario)
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
        watch(self._follow, (display, "mode"), (seeds, "evidence"))

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


NO_TRUTH = "The record has no truth: figures show estimates, and RMS errors are those of predicting the next measurement."


class VerdictLine:
    """The verdict on one target in the mode and unit shown, once all observers are done."""

    def __init__(
        self,
        target: str,
        run: BackgroundTask,
        display: Display,
        seeds: SeedRuns | None = None,
        budgets: Budgets | None = None,
    ):
        self.target = target
        self.run = run
        self.display = display
        self.seeds = seeds
        self.budgets = budgets
        self._text: tuple[tuple[str, str], tuple[str, str]] = ("", ""), ("", "")
        sources = (run, ["result", "state"]), (seeds, "evidence"), (budgets, "by_observer"), (display, ["mode", "unit"])
        self.pane: Final = follow_html(self.html, *sources)

    def html(self) -> str:
        """Return the title and the sentences; while observers are at work those before, dimmed; without a truth what there is."""
        title, text, kind = f"{target_title(self.target)}, {self.display.mode}", "", "verdict"
        of = (self.display.mode, self.display.unit)
        if self.run.state in (IDLE, RUNNING):
            before, known = self._text
            (title, text), kind = (known, "verdict before") if before == of else ((title, ""), kind)
        elif self.run.result is not None and self.run.state == DONE:
            title, text = self._sentences(self.run.result, title)
            self._text = of, (title, text)
        return str(macro("verdict", title, TERMS[target_title(self.target)], Markup(text), kind))

    def _sentences(self, results: RunResults, title: str) -> tuple[str, str]:
        """Return the title and what stands below it as HTML."""
        has_truth = results.values(TRUTH, self.target) is not None
        if not has_truth and self.target != TARGETS[0]:
            return title, NO_TRUTH
        it = results.result
        found = verdict(
            it.scenario,
            it.record,
            it.estimates,
            it.scores,
            self.target if has_truth else PREDICTION,
            self.display.mode,
            simulation=results.simulation,
            evidence=self.seeds.evidence if self.seeds else None,
            budgets=[budget for of in self.budgets.by_observer.values() for budget in of] if self.budgets else (),
        )
        if found is None:
            return title, "" if has_truth else NO_TRUTH
        scale = self.display.scale(results.scenario)
        lead, *others = found.sentences(scale, self.display.unit_label)
        head, _, first = lead.partition(". ")
        lines = [explain_first(first, "theoretical limit", BOUND), escape(" ".join(others)), "" if has_truth else NO_TRUTH]
        return head, "<br>".join(filter(None, lines)).replace(" %", "&nbsp;%")
