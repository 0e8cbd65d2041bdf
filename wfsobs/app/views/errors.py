"""What is said of a target: the verdict above its figures, a row per observer, which is the legend as well, and the RMS table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from math import inf, sqrt
from typing import Any, Final

import numpy as np
from markupsafe import Markup
from param.parameterized import batch_call_watchers

from wfsobs.app.compared import ComparedRun, find_score
from wfsobs.app.display import AT_LIMIT, IN_MOST, Display, over, score_columns
from wfsobs.app.glossary import BOUND, RELATIVE, TERMS, explain_first, term
from wfsobs.app.idle_work import Budgets, SeedRuns
from wfsobs.app.jobs import DONE, RUNNING
from wfsobs.app.render import Row, change, hundredths, macro, missing, number, table, with_decimals_of
from wfsobs.app.service import IDLE
from wfsobs.app.style import TERM_COLOURS, follow_html, look, observers_of, swatch, watch
from wfsobs.app.views.cards import Cards, card_of, error_fields
from wfsobs.app.views.switches import LineChoice
from wfsobs.app.work import TRUTH, RunResults
from wfsobs.evaluation.bound import NO_BOUND
from wfsobs.evaluation.budget import TERMS as BUDGET_TERMS
from wfsobs.evaluation.evidence import Evidence, gather_evidence, marks_of, rank_observers
from wfsobs.evaluation.result import NOTHING as NO_KNOWLEDGE
from wfsobs.evaluation.result import (
    PEAKS,
    TIME,
    Result,
    above_bound,
    can_be_best,
    group_by_knowledge,
    is_non_causal,
    is_unknown,
    own_bound,
    own_interval,
    prior_knowledge,
    row_label,
    score_rows,
    scored_interval,
    target_title,
)
from wfsobs.evaluation.result import Row as ScoreRow
from wfsobs.evaluation.scores import BOUNDS, COMMON_BOUNDS, LOOP, OF_STAR, PREDICTION, RESIDUAL, SCORED, Score
from wfsobs.evaluation.verdict import verdict
from wfsobs.observers.base import TARGETS
from wfsobs.prior import TRUE, PriorSource

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
    for kind in (NO_KNOWLEDGE, PEAKS):
        best += [name for name in ranked if prior_knowledge(name) == kind][:1]
    return [name for name in drawn if name in best or name in REFERENCES] if best else drawn


def effect_line(display: Display, before: RunResults, now: RunResults) -> str:
    """Write the change of the record's error of the best observer without prior knowledge, for the target with the largest.

    It names mode and unit, since it stays when others are shown. Empty where it did not change, or where a run has no such error.
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
                and prior_knowledge(s.observer) == NO_KNOWLEDGE
            }
            for results in (before, now)
        )
        best = next((name for name in rank_observers(new) if name in old and name in observers_of(target)), None)
        if best is not None and new[best] != old[best]:
            errors = f"{number(scale * old[best])} → {number(scale * new[best])} {display.unit_label}"
            line = f"{errors}: {target}, {display.mode_label}, {look(best).label}"
            found.append((abs(np.log(new[best] / old[best])), line))
    return max(found)[1] if found else ""


class MainLines:
    """Keeps the lines that are shown to those that matter, per target, until the visitor chooses others.

    Made before the figures, so that they draw once. While a run goes on its first choice stays.
    """

    def __init__(self, display: Display, seeds: SeedRuns):
        self.run: Final = seeds.run
        self.display = display
        self.seeds: Final = seeds
        self.choices: Final = {target: LineChoice(f"hide.{target}", (TRUTH, *observers_of(target))) for target in TARGETS}
        for choice in self.choices.values():
            choice.watch(self._show)
        self.run.param.watch(self._on_results, ["result", "state"])  # the last result may come before the run is over
        watch(self._follow, (display, "mode"), (seeds, "evidence"))

    def names(self, target: str) -> list[str]:
        """List the observers of a target that matter (`main_observers`)."""
        results, evidence = self.run.result, self.seeds.evidence
        return main_observers(results.result.scores if results else (), target, self.display.mode, evidence)

    def _on_results(self, *_: object) -> None:
        if self.run.state != RUNNING or any(choice.minor is None for choice in self.choices.values()):
            self._follow()

    def _follow(self, *_: object) -> None:
        if self.run.result is not None:
            with batch_call_watchers(self.display):
                self.display.named_lines = {target: self.names(target) for target in TARGETS}
                for target, choice in self.choices.items():
                    choice.offer((TRUTH, *self.display.named_lines[target]))

    def _show(self, *_: object) -> None:
        self.display.hidden_lines = {target: choice.hidden_lines for target, choice in self.choices.items()}


NO_TRUTH = f"The record has no truth: figures show estimates, and errors are those of predicting the next measurement, {OF_STAR}."


class VerdictLine:
    """The verdict on one target in the mode and unit shown, once all observers are done."""

    def __init__(self, target: str, display: Display, budgets: Budgets):
        self.target = target
        self.run = run = budgets.run
        self.display = display
        self.budgets = budgets
        self._text: tuple[tuple[str, str], tuple[str, str]] = ("", ""), ("", "")
        sources = (run, ["result", "state"]), (budgets.seeds, "evidence"), (budgets, "by_observer"), (display, ["mode", "unit"])
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
            evidence=self.budgets.seeds.evidence,
            budgets=[budget for of in self.budgets.by_observer.values() for budget in of],
            source=it.prior_source,
        )
        if found is None:
            return title, "" if has_truth else NO_TRUTH
        scale = self.display.scale(results.scenario)
        lead, *others = found.sentences(scale, self.display.unit_label)
        head, _, first = lead.partition(". ")
        lines = [explain_first(first, "theoretical limit", BOUND), escape(" ".join(others)), "" if has_truth else NO_TRUTH]
        return head, "<br>".join(filter(None, lines)).replace(" %", "&nbsp;%")


ABOVE = macro("tag", "above", "worse than zero")

NO_SIMULATION = "no bound: the spectra of a loaded record are not known"


def reasons_of(result: Result) -> dict[str, str]:
    """Return why observers have no estimate."""
    return {it.observer: it.reason.removeprefix(f"{it.observer} left out: ") for it in result.failures}


def lines_of_failures(result: Result) -> list[str]:
    """Say which observers have no estimate, a line for each reason."""
    names: dict[str, list[str]] = {}
    for name, reason in reasons_of(result).items():
        names.setdefault(reason, []).append(row_label(name))
    return [f"{', '.join(of)} left out: {reason}" for reason, of in names.items()]


WITHOUT_TRUTH = {
    PREDICTION: (target_title(PREDICTION), OF_STAR),
    RESIDUAL: ("Residual", "what the recorded loop left"),
}
"""Target of a record without truth -> what stands before the mode in its title, and behind it."""


@dataclass(frozen=True)
class ScoreWriter:
    """Writes the rows of a table of errors, on the page and in a report.

    length, unit : writes a length [um], and its unit
    head    : writes how the row of an observer begins
    dt      : step of the loop [s]
    n_seeds : that errors are means over
    source  : where the prior of the observers comes from
    """

    length: Callable[[float], str]
    unit: str
    head: Callable[[str], str]
    dt: float
    n_seeds: int = 1
    source: PriorSource = TRUE

    def groups(
        self,
        target: str,
        words: Iterable[str],
        rows: Mapping[str, ScoreRow | None],
        leaders: Sequence[str],
        why: Mapping[str, str] = {},
        cells_beside: Callable[[str], list[str]] = lambda _name: [],
    ) -> list[tuple[str, list[Row]]]:
        """Return the rows of a target in one mode, a group per kind of prior knowledge, the smallest error first.

        words : of the title, a group without rows;  rows : observer -> its row, None where there is none;  why : observer -> why
        cells_beside : returns those that go beside the error
        """
        known = {name: row for name, row in rows.items() if row}
        marks = marks_of({name: (row["rms_um"], row["apart"]) for name, row in known.items()}, leaders)

        def make_row(name: str) -> Row:
            row, bound = rows[name], known.get(own_bound(name) or "")
            error, *others = self._cells(row, target, marks.get(name)) if row else [missing(why.get(name, ""))] * 6
            notes = ["looks ahead" if is_non_causal(name) else "", own_interval(row) if row else ""]
            if row and bound and above_bound(row["rms_um"], row["interval_um"], bound["rms_um"]) == 0.0:
                notes.append(AT_LIMIT)
            head = Markup().join([self.head(name), *(macro("note", note) for note in notes)])
            return Row(head, [error, *cells_beside(name), *others], {"observer": name, "target": target})

        order = sorted(rows, key=lambda name: (it["apart"], it["rms_um"]) if (it := rows[name]) else (True, inf))
        own = [row for row in known.values() if not row["apart"]]
        sizes = [Markup("rms of {} {} {}").format(_base(target), self.length(row["truth_rms_um"]), self.unit) for row in own[:1]]
        title = Markup(", ").join(filter(None, [*words, scored_interval(own), *sizes]))
        groups = group_by_knowledge(order, self.source)
        return [(title, []), *((title, [make_row(name) for name in of]) for title, of in groups.items())]

    def _cells(self, row: ScoreRow, target: str, mark: str | None) -> list[str]:
        interval, time, lag, sd = row["interval_um"], row[TIME], row["lag_s"], row["sd_um"]
        is_bound, is_worse = row["observer"] in BOUNDS, target in SCORED and (row["normalised_rms"] or 0.0) > 1.0
        no_lag = "estimate or truth is constant" if target in SCORED else "not compared with a truth"
        error = self.length(row["rms_um"])  # last, so that numbers stand below each other
        if mark:
            error = macro("tag", mark, mark) + error
        if interval is not None:
            known = macro("interval", *map(self.length, interval), IN_MOST if is_bound else over(self.n_seeds))
            error = (macro("note", "interval unknown") if is_unknown(row["rms_um"], interval) else known) + " " + error
        return [
            error,
            (ABOVE if is_worse else "") + _or_why(row["normalised_rms"], f"{_base(target)} is 0"),
            _or_why(None if lag is None else 1e3 * lag, "a limit has none" if is_bound else no_lag),
            _or_why(time, "nothing is computed"),
            _or_why(None if time is None else 1e-6 * time / self.dt, "nothing is computed"),
            missing("it predicts no sigma of this error") if sd is None else self.length(sd),
        ]


def _base(target: str) -> str:
    """Return what an error is divided by."""
    return "truth" if target in SCORED else "z"


def _or_why(value: float | None, why: str) -> str:
    return missing(why) if value is None else hundredths(value)


class Table:
    """Every score of the mode shown, one row per observer and target."""

    def __init__(self, display: Display, seeds: SeedRuns):
        self.run: Final = seeds.run
        self.display = display
        self.seeds: Final = seeds
        switches = ["mode", "unit", "dark", "compared_runs"]
        self.pane: Final = follow_html(
            self.html, (self.run, ["result", "state"]), (seeds, "evidence"), (display, switches), (seeds.store, "waiting")
        )

    def html(self) -> str:
        """Write the table."""
        shown = self.run.result
        groups = [group for target in self._targets() for group in self._target(target)]
        left_out = lines_of_failures(shown.result) if shown else []
        return f"{table('RMS errors', self._columns(), groups=groups)}{macro('texts', 'failure', left_out)}"

    def _columns(self) -> dict[str, str]:
        """Heading -> explanation."""
        unit = self.display.unit_label
        compared = {
            f"{run.letter} [{unit}]": f"RMS error in {run.name}, and the change from there, over the seeds that both have"
            for run in self.display.compared_runs
        }
        return score_columns(unit, _base(self._targets()[0]), compared)

    def _targets(self) -> Sequence[str]:
        """List what errors are of: without truth, of predictions of the next measurement, and what the recorded loop left."""
        shown = self.run.result
        without = shown is not None and any((s.target, s.mode) == (RESIDUAL, self.display.mode) for s in shown.result.scores)
        return [*WITHOUT_TRUTH] if without else SCORED

    def _target(self, target: str) -> list[tuple[str, list[Row]]]:
        """List the rows of a target under its title; those whose errors are not known yet too."""
        shown, display, seeds = self.run.result, self.display, self.seeds
        rows: dict[str, ScoreRow | None] = {}
        if target in SCORED:
            usual = seeds.usual
            rows = dict.fromkeys([*(name for name in observers_of(target, with_zero=True) if name in usual), *COMMON_BOUNDS])
        scores = {s.observer: s for s in shown.result.scores if (s.target, s.mode) == (target, display.mode)} if shown else {}
        for name, score in scores.items():
            (rows[name],) = score_rows([seeds.over_seeds(score)], None)
        writer = ScoreWriter(
            lambda um: number(um * display.scale(shown.scenario)),
            display.unit_label,
            self._head,
            shown.result.record.dt if shown else 0.0,
            seeds.n_seeds,
            shown.result.prior_source if shown else TRUE,
        )
        first, *more = WITHOUT_TRUTH.get(target, [target_title(target)])
        leaders = seeds.evidence.leaders(target, display.mode) if seeds.evidence else ()
        why = dict.fromkeys(rows, "not computed yet")
        if shown and self.run.state == DONE:
            none = "it has no estimate" if scores else "nothing is scored, all may be warm-up"
            why = dict.fromkeys(rows, f"no error: {none}")
            if scores:
                why |= dict.fromkeys(BOUNDS, NO_BOUND if shown.simulation else NO_SIMULATION) | reasons_of(shown.result)

        def compared(name: str) -> list[str]:
            return [self._compared_cell(run, name, target, scores.get(name)) for run in display.compared_runs]

        return writer.groups(target, [first, display.mode, *more], rows, leaders, why, compared)

    def _head(self, name: str) -> str:
        label = row_label(name)
        if name == LOOP:
            return label
        return swatch(name, self.display.dark) + (term(BOUND, label) if name in BOUNDS else label)

    def _compared_cell(self, run: ComparedRun, name: str, target: str, score: Score | None) -> str:
        """Write the error in a compared run, and the change from there."""
        key = name, target, self.display.mode
        before, now = run.beside([score] if score else [], self.seeds.evidence, key)
        if before is None:
            return missing(f"{run.name} does not have it")
        return macro("change", change(before, now)) + number(before * self.display.scale(run.scenario))


HEADS = {"note": RELATIVE, "bar": "Error budget"}
"""Headings beside that of the errors."""

LEAST = 0.01
"""Share of an error from which on the legend has a cause."""

LIMIT = "limit"


class Strip:
    """The rows of one target, in step with the results and the switches.

    lines   : which of them are the main ones
    budgets : what the errors are made of
    """

    def __init__(self, target: str, display: Display, lines: MainLines, budgets: Budgets):
        self.target = target
        self.seeds = seeds = budgets.seeds
        self.run = run = seeds.run
        self.display = display
        self.budgets = budgets
        self.lines = lines
        # results, and the errors of all their seeds that have been known
        self._now: tuple[RunResults | None, Evidence] = None, gather_evidence([])
        self._before = self._now
        self.cards: Final = Cards()
        lines.choices[target].tie(self.cards)
        self._refresh()
        watch(self._follow, (run, ["result", "state"]), (seeds, "evidence"))
        watch(
            self._refresh,
            (budgets, "by_observer"),
            (seeds.store, "waiting"),
            (display, ["mode", "unit", "dark", "compared_runs"]),
        )

    def _follow(self, *_: object) -> None:
        """Keep what was shown before, so that the change from there can be shown."""
        if (results := self.run.result) is not None and self.run.state == DONE:
            known = self.seeds.evidence or gather_evidence([results.result.scores])
            of, errors = self._now
            if results is not of:
                self._before = self._now
            elif known.n_seeds < errors.n_seeds:  # gone with the settings, which have changed
                known = errors
            self._now = results, known
        self._refresh()

    def _refresh(self, *_: object) -> None:
        items = self.items()
        unit, shown = self.display.unit_label, self.run.result
        error = "RMS error" if shown is None or shown.values(TRUTH, self.target) is not None else "Prediction error"
        terms = {part[3] for item in items for part in item["parts"] if part[1] >= LEAST}
        heads = HEADS | {"value": f"{error} [{unit}]", "change": f"Change [{unit}]"}
        heads["change"] *= any(item["change"] for item in items)
        heads["bar"] *= bool(terms)
        limit = [("currentColor", LIMIT)] * any(item["limit"] for item in items)
        legend = [(TERM_COLOURS[name], label) for name, label in BUDGET_TERMS.items() if name in terms]
        self.cards.show(items, heads, legend + limit)

    def items(self) -> list[dict[str, Any]]:
        """Describe the cards."""
        shown = self.run.result
        usual = self.seeds.usual
        names = [name for name in observers_of(self.target) if name in usual]
        main = (TRUTH, *(self.lines.names(self.target) if shown and shown.result.scores else REFERENCES))
        if shown is None:
            cards = [self._card(TRUTH, ""), *map(self._card_without, names)]
        else:
            cards = [*self._truth(shown), *(self._observer(name, shown) for name in names)]
        return [card | {"compared": self._compared_rows(card["name"], shown), "main": card["name"] in main} for card in cards]

    def _compared_rows(self, name: str, results: RunResults | None) -> list[list[str]]:
        """Write letter, value and change from there in per cent of every compared run."""
        scores = results.result.scores if results else ()
        has_truth = any(s.target == self.target for s in scores)
        rows = []
        for run in self.display.compared_runs:
            before, now = run.beside(scores, self.seeds.evidence, *self._compared_number(scores, name, has_truth))
            known = before is not None
            value = number(before * self.display.scale(run.scenario) if known else None)
            rows.append([run.letter, value, f"{change(before, now)} %" if known else ""])
        return rows

    def _compared_number(self, scores: Sequence[Score], name: str, has_truth: bool) -> tuple[tuple[str, str, str], str]:
        """Return what of which score is compared: the error of an observer, or the rms of the truth.

        has_truth : otherwise the error of the next measurement
        """
        mode = self.display.mode
        if name == TRUTH and has_truth:
            return (next((s.observer for s in self._comparable(scores)), ""), self.target, mode), "truth_rms"
        return (name, self.target if has_truth else PREDICTION, mode), "rms"

    def _comparable(self, scores: Iterable[Score]) -> list[Score]:
        return [s for s in scores if (s.target, s.mode) == (self.target, self.display.mode) and not s.apart]

    def _truth(self, results: RunResults) -> list[dict[str, Any]]:
        if results.values(TRUTH, self.target) is None:
            return []
        for score in self._comparable(results.result.scores):
            size = self.seeds.over_seeds(score).truth_rms * self.display.scale(results.scenario)
            return [self._card(TRUTH, "rms", value=number(size))]
        return [self._card(TRUTH, "")]

    def _observer(self, name: str, results: RunResults) -> dict[str, Any]:
        scores, mode = results.result.scores, self.display.mode
        if (score := find_score(scores, name, self.target, mode)) is not None:
            return self._error_card(name, score, results) | self._budget_fields(score, results)
        if results.result.estimate(name, self.target) is None:
            return self._card_without(name)
        score = find_score(scores, name, PREDICTION, mode)  # by how it predicts, if it does
        return self._error_card(name, score, results) if score else self._card(name, "no truth")

    def _card(self, name: str, note: str, **fields: Any) -> dict[str, Any]:
        return card_of(name, self.display.dark, note, **fields)

    def _card_without(self, name: str) -> dict[str, Any]:
        if self.run.state == RUNNING:
            return self._card(name, "computing …")
        reason = reasons_of(self.run.result.result).get(name) if self.run.result else None
        return self._card(name, "left out", about=f"Left out: {reason}.") if reason else self._card(name, "no result")

    def _error_card(self, name: str, score: Score, results: RunResults) -> dict[str, Any]:
        mean, scale = self.seeds.over_seeds(score), self.display.scale(results.scenario)
        note = own_interval(score_rows([score], None)[0]) or number(mean.normalised_rms, 2)
        fields = error_fields(mean.rms, mean.interval, scale, self.seeds.n_seeds)
        change = self._change(score)
        said = "" if change is None else with_decimals_of(fields["value"], change * scale, "+")
        return self._card(name, note, **fields, change=said)

    def _budget_fields(self, score: Score, results: RunResults) -> dict[str, Any]:
        """Describe the bar: as long as the error, in pieces by their shares of its square; and the limit."""
        it = self.budgets.budget(score.observer, self.target, self.display.mode)
        if it is None or not it.terms:
            return {}
        whole, scale = sum(max(part, 0.0) for part in it.terms.values()) or 1.0, self.display.scale(results.scenario)
        percent = {name: f"{round(100.0 * share)} %".replace("-", "−") for name, share in it.shares.items()}
        return {
            "parts": [
                [TERM_COLOURS[name], max(part, 0.0) / whole, f"{BUDGET_TERMS[name]} {percent[name]}", name]
                for name, part in it.terms.items()
            ],
            "size": self.seeds.over_seeds(score).rms * scale,
            "limit": sqrt(it.bound or 0.0) * scale,
        }

    def _change(self, score: Score) -> float | None:
        """Return the change of the error from the result before [um], over the seeds that both have."""
        before, now = (errors.errors.get((score.observer, score.target, score.mode)) for _, errors in (self._before, self._now))
        if before is None or now is None or self.run.result is not self._now[0]:
            return None
        n = min(before.size, now.size)
        return float((now[:n] - before[:n]).mean())
