"""One or two sentences above the figures of a target: who is best, and who does harm and why."""

from __future__ import annotations

from html import escape

import panel as pn

from wfsobs.app.causes import Causes
from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.glossary import BOUND, explain_first
from wfsobs.app.jobs.job import DONE, RUNNING
from wfsobs.app.jobs.task import IDLE, BackgroundTask
from wfsobs.app.seeds import SeedRuns
from wfsobs.app.style import asset
from wfsobs.app.work import TRUTH
from wfsobs.evaluation.verdict import verdict

NO_TRUTH = (
    "The record has no truth: the figures show the estimates instead of their errors, and the RMS errors are those of predicting "
    "the next measurement."
)


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
        if shown.values(TRUTH, self.target) is None:
            return _paragraph(NO_TRUTH, "verdict")
        found = verdict(
            it.scenario,
            it.record,
            it.estimates,
            it.scores,
            self.target,
            self.display.mode,
            simulation=shown.simulation,
            evidence=self.seeds.evidence if self.seeds else None,
            budgets=self.causes.budgets if self.causes else (),
        )
        if found is None:
            return ""
        scale = per_micrometre(self.display.unit, shown.scenario.telescope.diameter)
        first, *others = found.sentences(scale, self.display.unit_label)
        more = "".join(f"<br>{escape(sentence)}" for sentence in others)
        text = f"<strong>{explain_first(first, 'theoretical limit', BOUND)}</strong>{more}".replace(" %", "&nbsp;%")
        self._sentence = of, text
        return _paragraph(text, "verdict")


def _paragraph(text: str, kind: str) -> str:
    """Write what has its room before it comes, so that the figures below do not move."""
    return f'<p class="{kind}">{text}</p>'
