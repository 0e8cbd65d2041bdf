"""The table above a target's figures: a row per observer with its error and what that is made of, which is the legend as well."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import sqrt
from typing import Any, Final

import param

from wfsobs.app.display import FROM_RECORD, OVER_SEEDS, Display
from wfsobs.app.glossary import RELATIVE, TERMS, sentence_on
from wfsobs.app.idle_work import Budgets, SeedRuns
from wfsobs.app.jobs import DONE, RUNNING
from wfsobs.app.render import NOTHING, change, number, render, with_decimals_of
from wfsobs.app.service import BackgroundTask
from wfsobs.app.style import TERM_COLOURS, WIDE, HtmlComponent, look, observers_of, script, sheets, watch
from wfsobs.app.views.table import find
from wfsobs.app.views.verdict import REFERENCES, MainLines
from wfsobs.app.work import TRUTH, RunResults
from wfsobs.evaluation.budget import TERMS as BUDGET_TERMS
from wfsobs.evaluation.evidence import Evidence, gather_evidence
from wfsobs.evaluation.rows import NOT_OBSERVERS, own_interval, score_rows, uncertainty_text
from wfsobs.evaluation.scores import LOOP, PREDICTION, RESIDUAL, Score
from wfsobs.priors_from.scenario import usual_observers

HEADS = {"note": RELATIVE, "change": "Change", "bar": "Error budget"}
"""Headings beside that of the errors."""

LEAST = 0.01
"""Share of an error from which on the legend has a cause."""

LIMIT = "limit"


@dataclass(frozen=True)
class RunErrors:
    """Results, and the errors of all their seeds that have been known."""

    results: RunResults | None = None
    errors: Evidence = field(default_factory=lambda: gather_evidence([]))


class Cards(HtmlComponent):
    """A row per line in the browser; a click on one hides or shows its line, a double click shows it alone."""

    hidden_lines = param.List([], doc="Names of the rows whose lines are hidden.")
    last_arrival = param.Integer(0, doc="Number of the last click that has arrived, and all before it.")

    _esm = script("patch", "strip")
    _stylesheets = sheets("style", "strip", "bare")

    def __init__(self, kind: str = "observers"):
        """Make the table. kind : what the rows are of."""
        self.kind = kind
        self.on_main: Callable[[], None] = lambda: None
        self.on_all: Callable[[], None] = lambda: None
        super().__init__(self._take, **WIDE)
        self.show([])

    def show(
        self, items: list[dict[str, Any]], heads: Mapping[str, str] | None = None, legend: Sequence[tuple[str, str]] = ()
    ) -> None:
        """Show rows, as `Strip` makes them.

        heads : headings of the columns value, note, change and bar; legend : (colour, label) of the pieces of bars
        """
        self.items, self.heads, self.legend = items, heads or {}, legend
        values = {"kind": self.kind, "terms": TERMS, "truth": TRUTH, "nothing": NOTHING}
        self.html = render("strip.html", items=items, heads=self.heads, legend=legend, **values)

    def _take(self, data: dict[str, Any]) -> None:
        """Take a click: the names to hide, or the wish for the main rows or all."""
        if data.get("main"):
            self.on_main()
        elif data.get("all"):
            self.on_all()
        elif isinstance(names := data.get("hidden"), list):
            number = data.get("number")
            self.param.update(
                hidden_lines=[name for name in names if isinstance(name, str)],
                last_arrival=number if isinstance(number, int) else self.last_arrival,
            )


def card_of(name: str, dark: bool, note: str, value: str = NOTHING, **fields: Any) -> dict[str, Any]:
    """Describe the row of an observer or a controller that has no bar, nor anything it is compared with, but for other fields."""
    it = look(name)
    known = {"name": name, "label": it.label, "colour": it.colour(dark), "dash": it.dash, "about": sentence_on(name)}
    empty = {"unit": "", "half": "", "change": "", "parts": (), "size": 0.0, "limit": 0.0, "compared": ()}
    return {**known, "note": note, "value": value, **empty, **fields}


def error_fields(rms: float, interval: Sequence[float] | None, scale: float, of: str = FROM_RECORD) -> dict[str, str]:
    """Format an error [um] and its interval; scale : from micrometres to the unit shown;  of : what the interval is from."""
    value = number(rms * scale)
    half = uncertainty_text(rms, interval, lambda x: with_decimals_of(value, x * scale)) if interval else ""
    return {"value": value, "half": half, "meaning": f"{OVER_SEEDS}, {of}"}


class Strip:
    """The rows of one target, in step with the results and the switches.

    lines   : which of them are the main ones
    budgets : what the errors are made of
    """

    def __init__(
        self,
        target: str,
        run: BackgroundTask,
        display: Display,
        seeds: SeedRuns | None = None,
        lines: MainLines | None = None,
        budgets: Budgets | None = None,
    ):
        self.target = target
        self.run = run
        self.display = display
        self.seeds = seeds
        self.budgets = budgets
        self.lines: Final = lines or MainLines(run, display, seeds)
        self._now = self._before = RunErrors()
        self.cards: Final = Cards()
        self._refresh()
        watch(self._follow, (run, ["result", "state"]), (seeds, "evidence"))
        watch(self._refresh, (budgets, "by_observer"), (display, ["mode", "unit", "dark", "compared_runs"]))
        display.param.watch(self._hide, "hidden_lines")

    def _follow(self, *_: object) -> None:
        """Keep what was shown before, so that the change from there can be shown."""
        if (results := self.run.result) is not None and self.run.state == DONE:
            known = self._evidence or gather_evidence([results.result.scores])
            if results is not self._now.results:
                self._before = self._now
            elif known.n_seeds < self._now.errors.n_seeds:  # gone with the settings, which have changed
                known = self._now.errors
            self._now = RunErrors(results, known)
        self._refresh()

    def _refresh(self, *_: object) -> None:
        items = self.items()
        unit, shown = self.display.unit_label, self.run.result
        error = "RMS error" if shown is None or shown.values(TRUTH, self.target) is not None else "Prediction error"
        terms = {part[3] for item in items if item["main"] for part in item["parts"] if part[1] >= LEAST}
        heads = HEADS | {"value": f"{error} [{unit}]"}
        heads["change"] *= any(item["change"] for item in items)
        heads["bar"] *= bool(terms)
        limit = [("currentColor", LIMIT)] * any(item["limit"] for item in items)
        legend = [(TERM_COLOURS[name], label) for name, label in BUDGET_TERMS.items() if name in terms]
        self.cards.show(items, heads, legend + limit)

    def _hide(self, *_: object) -> None:
        self.cards.hidden_lines = self.display.hidden_lines.get(self.target, [])

    def items(self) -> list[dict[str, Any]]:
        """Describe the cards."""
        shown = self.run.result
        runs = usual_observers(shown.scenario, shown.result.record) if shown else observers_of(self.target)
        observers = [self._observer(name, shown) for name in observers_of(self.target) if name in runs]
        main = (TRUTH, *(self.lines.names(self.target) if shown and shown.result.scores else REFERENCES))
        return [
            card | {"compared": self._compared_rows(card["name"], shown), "main": card["name"] in main}
            for card in (self._truth(shown), *observers)
        ]

    def _compared_rows(self, name: str, results: RunResults | None) -> list[list[str]]:
        """Write letter, value and change from there in per cent of every compared run."""
        scores = results.result.scores if results else ()
        has_truth = any(s.target == self.target for s in scores)
        now = self._rms(scores, name, has_truth)
        rows = []
        for run in self.display.compared_runs:
            before = self._rms(run.scores, name, has_truth)
            known = before is not None
            value = number(before * self.display.scale(run.scenario) if known else None)
            rows.append([run.letter, value, f"{change(before, now)} %" if known else ""])
        return rows

    def _rms(self, scores: Sequence[Score], name: str, has_truth: bool) -> float | None:
        """Find the error of an observer, or the rms of the truth [um]; None if there is none.

        has_truth : otherwise the error of the next measurement, and the residual of the recorded loop
        """
        target = self.target if has_truth else RESIDUAL if name == TRUTH else PREDICTION
        of = [s for s in scores if (s.target, s.mode) == (target, self.display.mode)]
        if name == TRUTH and has_truth:
            return next((s.truth_rms for s in of if not s.apart), None)
        return next((s.rms for s in of if name in (s.observer, TRUTH)), None)

    def _observer(self, name: str, results: RunResults | None) -> dict[str, Any]:
        score = find(results, name, self.target, self.display.mode) if results else None
        if results is None or score is None:
            if results is not None and results.result.estimate(name, self.target) is not None:  # by how it predicts, if it does
                score = find(results, name, PREDICTION, self.display.mode)
                return self._score_fields(name, score, results) if score else self._card(name, None, "no truth")
            return self._card(name, None, "computing …" if self.run.state == RUNNING else "no result")
        return self._score_fields(name, score, results) | self._budget_fields(score, results)

    @property
    def _evidence(self) -> Evidence | None:
        return self.seeds.evidence if self.seeds else None

    def _mean(self, score: Score) -> Score:
        """Return a score with its mean over the seeds, where there are several."""
        return self._evidence.over_seeds(score) if self._evidence else score

    def _score_fields(self, name: str, score: Score, results: RunResults) -> dict[str, Any]:
        mean, own = self._mean(score), own_interval(score_rows([score], None)[0])
        of = f"{self._evidence.n_seeds} seeds" if self._evidence else FROM_RECORD
        fields = self._card(name, None, own or number(mean.normalised_rms, 2))
        fields |= error_fields(mean.rms, mean.interval, self._in_unit(1.0, results), of)
        change = self._change(score)
        return fields | {
            "change": "" if change is None else with_decimals_of(fields["value"], self._in_unit(change, results), "+")
        }

    def _budget_fields(self, score: Score, results: RunResults) -> dict[str, Any]:
        """Describe the bar: as long as the error, in pieces by their shares of its square; and the limit."""
        it = self.budgets.budget(score.observer, self.target, self.display.mode) if self.budgets else None
        if it is None or not it.terms:
            return {}
        whole = sum(max(part, 0.0) for part in it.terms.values())
        percent = {name: f"{round(100.0 * part / it.total)} %".replace("-", "−") for name, part in it.terms.items()}
        return {
            "parts": [
                [TERM_COLOURS[name], max(part, 0.0) / whole, f"{BUDGET_TERMS[name]} {percent[name]}", name]
                for name, part in it.terms.items()
            ],
            "size": self._in_unit(self._mean(score).rms, results),
            "limit": self._in_unit(sqrt(it.bound or 0.0), results),
        }

    def _change(self, score: Score) -> float | None:
        """Return the change of the error from the result before [um], over the seeds that both have."""
        key = score.observer, score.target, score.mode
        before, now = (of.errors.errors.get(key) for of in (self._before, self._now))
        if before is None or now is None or self.run.result is not self._now.results:
            return None
        n = min(before.size, now.size)
        return float((now[:n] - before[:n]).mean())

    def _truth(self, results: RunResults | None) -> dict[str, Any]:
        of = (self.target, self.display.mode)
        scores = [s for s in results.result.scores if (s.target, s.mode) == of and not s.apart] if results else []
        if results is None or not scores:
            left = find(results, LOOP, RESIDUAL, self.display.mode) if results else None
            if results is None or left is None:
                return self._card(TRUTH, None, "")
            # the recorded loop's residual, in the place of the truth, which has no line either
            return self._score_fields(TRUTH, left, results) | {"label": NOT_OBSERVERS[LOOP], "colour": "transparent"}
        return self._card(TRUTH, self._in_unit(self._mean(scores[0]).truth_rms, results), "rms")

    def _in_unit(self, value: float, results: RunResults) -> float:
        return value * self.display.scale(results.scenario)

    def _card(self, name: str, value: float | None, note: str) -> dict[str, Any]:
        return card_of(name, self.display.dark, note, NOTHING if value is None else number(value))
