"""The verdict above the figures of a target: the best by prior knowledge, the limit, and what does harm and why."""

from __future__ import annotations

from html import escape
from typing import Final

from markupsafe import Markup

from wfsobs.app.budgets import Budgets
from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.glossary import BOUND, TERMS, explain_first
from wfsobs.app.jobs import DONE, RUNNING
from wfsobs.app.render import macro
from wfsobs.app.seeds import SeedRuns
from wfsobs.app.service import IDLE, BackgroundTask
from wfsobs.app.style import bare
from wfsobs.app.work import TRUTH, RunResults
from wfsobs.evaluation.rows import target_title
from wfsobs.evaluation.scores import PREDICTION
from wfsobs.evaluation.verdict import verdict
from wfsobs.observers.base import TARGETS

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
        self.pane: Final = bare(self.html())
        run.param.watch(self._refresh, ["result", "state"])
        if seeds is not None:
            seeds.param.watch(self._refresh, "evidence")
        if budgets is not None:
            budgets.param.watch(self._refresh, "by_observer")
        display.param.watch(self._refresh, ["mode", "unit"])

    def _refresh(self, *_: object) -> None:
        self.pane.html = self.html()

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
        scale = per_micrometre(self.display.unit, results.scenario.telescope.diameter)
        lead, *others = found.sentences(scale, self.display.unit_label)
        head, _, first = lead.partition(". ")
        lines = [explain_first(first, "theoretical limit", BOUND), escape(" ".join(others)), "" if has_truth else NO_TRUTH]
        return head, "<br>".join(filter(None, lines)).replace(" %", "&nbsp;%")
