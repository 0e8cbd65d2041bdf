"""The verdict above the figures of a target: the best by prior knowledge, the limit, and what does harm and why."""

from __future__ import annotations

from html import escape

import panel as pn

from wfsobs.app.causes import Causes
from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.glossary import BOUND, explain_first
from wfsobs.app.jobs import DONE, IDLE, RUNNING, BackgroundTask
from wfsobs.app.seeds import SeedRuns
from wfsobs.app.style import asset
from wfsobs.app.work import TRUTH
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
        causes: Causes | None = None,
    ):
        self.target, self.run, self.display, self.seeds, self.causes = target, run, display, seeds, causes
        self._sentence: tuple[tuple[str, str], str] = ("", ""), ""
        self.pane = pn.pane.HTML(self.html(), sizing_mode="stretch_width", margin=0, stylesheets=[asset("style.css")])
        run.param.watch(self._refresh, ["result", "state"])
        if seeds is not None:
            seeds.param.watch(self._refresh, "evidence")
        if causes is not None:
            causes.param.watch(self._refresh, "budgets")
        display.param.watch(self._refresh, ["mode", "unit"])

    def _refresh(self, *_: object) -> None:
        self.pane.object = self.html()

    def html(self) -> str:
        """Return the sentences; while observers are at work those before, dimmed; without a truth what there is instead."""
        shown, of = self.run.result, (self.display.mode, self.display.unit)
        if self.run.state in (IDLE, RUNNING):
            before, text = self._sentence
            return _paragraph(text if before == of else "", "verdict before")
        if shown is None or self.run.state != DONE:
            return ""
        it = shown.result
        has_truth = shown.values(TRUTH, self.target) is not None
        if not has_truth and self.target != TARGETS[0]:
            return _paragraph(NO_TRUTH, "verdict")
        found = verdict(
            it.scenario,
            it.record,
            it.estimates,
            it.scores,
            self.target if has_truth else PREDICTION,
            self.display.mode,
            simulation=shown.simulation,
            evidence=self.seeds.evidence if self.seeds else None,
            budgets=self.causes.budgets if self.causes else (),
        )
        if found is None:
            return "" if has_truth else _paragraph(NO_TRUTH, "verdict")
        scale = per_micrometre(self.display.unit, shown.scenario.telescope.diameter)
        lead, *others = found.sentences(scale, self.display.unit_label)
        head, _, first = lead.partition(". ")
        lines = [f"<strong>{escape(head)}.</strong> {explain_first(first, 'theoretical limit', BOUND)}", escape(" ".join(others))]
        if not has_truth:
            lines.append(NO_TRUTH)
        text = "<br>".join(filter(None, lines)).replace(" %", "&nbsp;%")
        self._sentence = of, text
        return _paragraph(text, "verdict")


def _paragraph(text: str, kind: str) -> str:
    """Write what has its room before it comes, so that the figures below do not move."""
    return f'<p class="{kind}">{text}</p>'
