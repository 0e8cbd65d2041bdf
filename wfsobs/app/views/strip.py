"""The strip above a target's figures: a card per observer with its number, which is the legend as well."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import param

from wfsobs.app.component import Component
from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.glossary import RELATIVE, TERMS, sentence_on
from wfsobs.app.jobs import RUNNING, BackgroundTask
from wfsobs.app.render import NOTHING, change, number
from wfsobs.app.seeds import SeedRuns
from wfsobs.app.style import asset, look, observers_of
from wfsobs.app.views.table import find
from wfsobs.app.work import TRUTH, RunResults
from wfsobs.evaluation.rows import NOT_OBSERVERS, own_interval, score_rows
from wfsobs.evaluation.scores import LOOP, PREDICTION, RESIDUAL, Score
from wfsobs.priors_from.selection import usual_observers

MAIN = "Show the main ones"


class Cards(Component):
    """The cards in the browser; a click on one hides or shows its line, a double click shows it alone."""

    items = param.List([], doc="{name, label, colour, dash, about, value, unit, note, range, compared} of every card.")
    hidden_lines = param.List([], doc="Names of the cards whose lines are hidden.")
    last_arrival = param.Integer(0, doc="Number of the last click that has arrived, and all before it.")
    terms = param.Dict({}, doc="Word that stands on the cards -> what it means.")
    main = param.String("", doc="What the button is called that shows the lines that matter; none if empty.")

    _esm = asset("patch.js") + asset("strip.js")
    _stylesheets = [asset("style.css"), asset("strip.css")]

    def __init__(self, **params: Any):
        self.on_main: Callable[[], None] = lambda: None
        super().__init__(self._take, **params)

    def _take(self, data: dict[str, Any]) -> None:
        """Take a click: the names to hide, or the wish for the main lines."""
        if data.get("main"):
            self.on_main()
        elif isinstance(names := data.get("hidden"), list):
            number = data.get("number")
            self.param.update(
                hidden_lines=[name for name in names if isinstance(name, str)],
                last_arrival=number if isinstance(number, int) else self.last_arrival,
            )


class Strip:
    """The cards of one target, in step with the results and the switches."""

    def __init__(self, target: str, run: BackgroundTask, display: Display, seeds: SeedRuns | None = None):
        self.target, self.run, self.display, self.seeds = target, run, display, seeds
        self.cards = Cards(
            items=self.items(), main=MAIN, terms={RELATIVE: TERMS[RELATIVE]}, sizing_mode="stretch_width", margin=0
        )
        run.param.watch(self._refresh, "result")
        run.param.watch(self._say_state, "state")
        if seeds is not None:
            seeds.param.watch(self._refresh, "evidence")
        display.param.watch(self._refresh, ["mode", "unit", "dark", "compared_runs"])
        display.param.watch(self._hide, "hidden_lines")

    def _say_state(self, *_: object) -> None:
        """Whether a run goes on is said on cards without a number alone."""
        if any(card["value"] == NOTHING for card in self.cards.items):
            self._refresh()

    def _refresh(self, *_: object) -> None:
        self.cards.items = self.items()

    def _hide(self, *_: object) -> None:
        self.cards.hidden_lines = self.display.hidden_lines.get(self.target, [])

    def items(self) -> list[dict[str, Any]]:
        """Describe the cards."""
        shown = self.run.result
        runs = usual_observers(shown.scenario, shown.result.record) if shown else observers_of(self.target)
        observers = [self._observer(name, shown) for name in observers_of(self.target) if name in runs]
        cards = [self._truth(shown), *observers]
        return [card | {"compared": self._compared_rows(card["name"], shown)} for card in cards]

    def _compared_rows(self, name: str, results: RunResults | None) -> list[list[str]]:
        """Write letter, value and change from there in per cent of every compared run."""
        scores = results.result.scores if results else ()
        has_truth = any(s.target == self.target for s in scores)
        now = self._rms(scores, name, has_truth)
        rows = []
        for run in self.display.compared_runs:
            before = self._rms(run.scores, name, has_truth)
            scale = per_micrometre(self.display.unit, run.scenario.telescope.diameter)
            value = number(None if before is None else before * scale)
            rows.append([run.letter, value, "" if before is None else f"{change(before, now)} %"])
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
            if results is not None and results.result.estimate(name, self.target) is not None:
                return self._without_truth(name, results)
            waiting = self.run.state == RUNNING
            return self._card(name, None, "computing …" if waiting else "no result")
        evidence = self.seeds.evidence if self.seeds else None
        if evidence is None or score.apart:
            return self._score_fields(name, score, results, "truth")
        mean = evidence.over_seeds(score)
        ends = " – ".join(number(self._in_unit(x, results)) for x in mean.interval or ())
        return self._score_fields(name, mean, results, "truth") | {"range": ends and f"mean {ends}"}

    def _score_fields(self, name: str, score: Score, results: RunResults, base: str) -> dict[str, Any]:
        relative = f"{score.normalised_rms:.2f}" if score.normalised_rms is not None else ""
        if relative:
            relative = f"relative error {relative}" if base == "truth" else f"{relative} × {base}"
        return self._card(name, self._in_unit(score.rms, results), own_interval(score_rows([score], None)[0]) or relative)

    def _without_truth(self, name: str, results: RunResults) -> dict[str, Any]:
        """How well the next measurement is predicted, by whoever says what it will be."""
        score = find(results, name, PREDICTION, self.display.mode)
        return self._score_fields(name, score, results, "z, next z") if score else self._card(name, None, "no truth")

    def _truth(self, results: RunResults | None) -> dict[str, Any]:
        of = (self.target, self.display.mode)
        scores = [s for s in results.result.scores if (s.target, s.mode) == of and not s.apart] if results else []
        if results is None or not scores:
            left = find(results, LOOP, RESIDUAL, self.display.mode) if results else None
            return self._loop(left, results) if results and left else self._card(TRUTH, None, "")
        return self._card(TRUTH, self._in_unit(scores[0].truth_rms, results), "rms")

    def _loop(self, left: Score, results: RunResults) -> dict[str, Any]:
        """Describe the recorded loop's residual, in the place of the truth, which has no line either."""
        return self._score_fields(TRUTH, left, results, "z, residual") | {"label": NOT_OBSERVERS[LOOP], "colour": "transparent"}

    def _in_unit(self, value: float, results: RunResults) -> float:
        return value * per_micrometre(self.display.unit, results.scenario.telescope.diameter)

    def _card(self, name: str, value: float | None, note: str) -> dict[str, Any]:
        it = look(name)
        return {
            "name": name,
            "label": it.label,
            "colour": it.colour(self.display.dark),
            "dash": list(it.dash),
            "about": sentence_on(name),
            "note": note,
            "range": "",
            "value": NOTHING if value is None else number(value),
            "unit": "" if value is None else self.display.unit_label,
        }
