"""The RMS table, plain HTML."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import panel as pn
from markupsafe import Markup

from wfsobs.app.compared import ComparedRun
from wfsobs.app.display import AT_LIMIT, IN_MOST, OVER_SEEDS, Display, per_micrometre, score_columns
from wfsobs.app.glossary import BOUND as TERM_OF_BOUND
from wfsobs.app.glossary import term
from wfsobs.app.jobs import BackgroundTask
from wfsobs.app.render import NOTHING, Row, change, macro, number, table
from wfsobs.app.seeds import SeedRuns
from wfsobs.app.style import asset, observers_of, swatch
from wfsobs.app.work import RunResults
from wfsobs.evaluation.evidence import rank_observers
from wfsobs.evaluation.rows import (
    NOT_OBSERVERS,
    at_bound,
    can_be_best,
    is_non_causal,
    own_interval,
    row_label,
    row_needs,
    score_rows,
    scored_interval,
    target_title,
)
from wfsobs.evaluation.scores import BOUNDS, COMMON_BOUNDS, LOOP, RESIDUAL, SCORED, Score
from wfsobs.observers import OBSERVERS
from wfsobs.priors_from.selection import is_usual
from wfsobs.result import Failure

BEST, TIED, ABOVE = macro("tag", "best", "best"), macro("tag", "tied", "tied"), macro("tag", "above", "worse than zero")
SMALLEST = macro("tag", "smallest", "smallest")
"""Error of one record, which does not tell who is best."""


def find(results: RunResults, observer: str, target: str, mode: str) -> Score | None:
    """Find the score of one observer, target and mode; None if there is none."""
    return next((s for s in results.result.scores if (s.observer, s.target, s.mode) == (observer, target, mode)), None)


def lines_of_failures(failures: Iterable[Failure]) -> list[str]:
    """Say which observers have no estimate, a line for each reason."""
    names: dict[str, list[str]] = {}
    for failure in failures:
        names.setdefault(failure.reason.removeprefix(f"{failure.observer} left out: "), []).append(row_label(failure.observer))
    return [f"{', '.join(of)} left out: {reason}" for reason, of in names.items()]


class Table:
    """Every score of the mode shown, one row per observer and target."""

    def __init__(self, run: BackgroundTask, display: Display, seeds: SeedRuns | None = None):
        self.run, self.display, self.seeds = run, display, seeds
        self.pane = pn.pane.HTML(self.html(), sizing_mode="stretch_width", margin=0, stylesheets=[asset("style.css")])
        run.param.watch(self._refresh, "result")
        if seeds is not None:
            seeds.param.watch(self._refresh, "evidence")
        display.param.watch(self._refresh, ["mode", "unit", "dark", "best_first", "compared_runs"])

    def _refresh(self, *_: object) -> None:
        self.pane.object = self.html()

    def html(self) -> str:
        """Write the table."""
        groups = self._truthless() or [self._target(target) for target in SCORED]
        shown = self.run.result
        left_out = lines_of_failures(shown.result.failures) if shown else []
        return f"{table('RMS errors', self._columns(), groups)}{macro('texts', 'failure', left_out)}"

    def _columns(self) -> dict[str, str]:
        """Heading -> explanation."""
        unit = self.display.unit_label
        compared = {
            f"{run.letter} [{unit}]": f"RMS error in {run.name}, and the change from there to the result shown"
            for run in self.display.compared_runs
        }
        return score_columns(unit, "z" if self._without_truth() else "truth", compared)

    def _without_truth(self) -> list[Score]:
        """Select the scores of a record without truth, of the mode shown."""
        shown = self.run.result
        scores = [s for s in shown.result.scores if s.mode == self.display.mode] if shown else []
        return scores if any(s.target == RESIDUAL for s in scores) else []

    def _truthless(self) -> list[tuple[str, list[Row]]]:
        """List the rows of a record without truth: predictions of the next measurement, and what the recorded loop left."""
        scores, shown = self._without_truth(), self.run.result
        if not scores or shown is None:
            return []
        if self.display.best_first:
            scores.sort(key=lambda s: (s.target == RESIDUAL, s.apart, s.rms))
        best = min((s.rms for s in scores if can_be_best(s.observer, s.apart)), default=None)
        scale = per_micrometre(self.display.unit, shown.scenario.telescope.diameter)
        found = []
        for score in scores:
            is_best = score.rms == best and can_be_best(score.observer, score.apart)
            cells = [
                (SMALLEST if is_best else "") + number(score.rms * scale),
                *self._compared_cells(score.observer, score.target, score),
                number(score.truth_rms * scale),
                number(score.normalised_rms),
                row_needs(score.observer, source=shown.result.prior_source),
                NOTHING,
                *_times(score, shown.result.record.dt),
                _own_sd(score, scale),
            ]
            head = "Recorded loop, residual" if score.observer == LOOP else self._head(score.observer) + _own(score)
            found.append(Row(head, cells, {"observer": score.observer, "target": score.target}))
        return [(f"Next measurement z, {self.display.mode}{_stretch(scores)}, one step ahead: the record has no truth", found)]

    def _target(self, target: str) -> tuple[str, list[Row]]:
        """List the rows of a target, best first if asked for, those without a score last."""
        shown = self.run.result
        scores = {
            name: self._score(name, target)
            for name in (*observers_of(target, with_zero=True), *BOUNDS)
            if not shown or name in BOUNDS or is_usual(OBSERVERS[name], shown.result.scenario, shown.result.record)
        }
        for name in set(BOUNDS).difference(COMMON_BOUNDS):  # only where stars differ, or modes are coupled
            if not scores[name]:
                del scores[name]
        marks, limits = self._marks(target, scores), {key[0] for key in at_bound(filter(None, scores.values()))}
        order = list(scores.items())
        if self.display.best_first:
            order.sort(key=lambda item: (item[1].apart, item[1].rms) if item[1] else (True, math.inf))
        title = f"{target_title(target)}, {self.display.mode}{_stretch([s for s in scores.values() if s])}"
        return title, [self._row(name, target, score, marks.get(name, Markup()), name in limits) for name, score in order]

    def _score(self, name: str, target: str) -> Score | None:
        """Find a score, with the mean over the seeds where there are several."""
        score = find(self.run.result, name, target, self.display.mode) if self.run.result else None
        return self.seeds.evidence.over_seeds(score) if score and self.seeds and self.seeds.evidence else score

    def _marks(self, target: str, scores: Mapping[str, Score | None]) -> dict[str, Markup]:
        """Mark the best, which differs significantly from all others over seeds, or those tied; of one record the smallest."""
        evidence = self.seeds.evidence if self.seeds else None
        if evidence and (leaders := evidence.leaders(target, self.display.mode)):
            return dict.fromkeys(leaders, TIED if len(leaders) > 1 else BEST)
        rivals = {n: s.rms for n, s in scores.items() if s and can_be_best(n, s.apart)}
        return dict.fromkeys(rank_observers(rivals)[:1], SMALLEST)

    def _interval(self, score: Score, scale: float) -> Markup:
        """Write the interval of a bound, or of the mean error over several seeds, to stand before it."""
        evidence = self.seeds.evidence if self.seeds else None
        if score.interval is None or not (evidence or score.observer in BOUNDS):
            return Markup()
        meaning = IN_MOST if score.observer in BOUNDS or not evidence else f"{OVER_SEEDS}, {evidence.n_seeds} seeds"
        return macro("interval", *(number(x * scale) for x in score.interval), meaning)

    def _row(self, name: str, target: str, score: Score | None, mark: Markup, at_limit: bool) -> Row:
        shown = self.run.result
        compared = self._compared_cells(name, target, find(shown, name, target, self.display.mode) if shown else None)
        needs = row_needs(name, source=shown.result.prior_source) if shown else row_needs(name)
        cells = [NOTHING, *compared, *[NOTHING] * 2, needs, *[NOTHING] * 4]
        if shown and score:
            scale = per_micrometre(self.display.unit, shown.scenario.telescope.diameter)
            cells = [
                # The number last, so that numbers stand below each other.
                self._interval(score, scale) + " " + mark + number(score.rms * scale),
                *compared,
                number(score.truth_rms * scale),
                (ABOVE if (score.normalised_rms or 0.0) > 1.0 else "") + number(score.normalised_rms),
                needs,
                NOTHING if score.lag is None else f"{1e3 * score.lag:z.2f}".replace("-", "−"),
                *_times(score, shown.result.record.dt),
                _own_sd(score, scale),
            ]
        head = self._head(name) + macro("note", "looks ahead" if is_non_causal(name) else "") + _own(score)
        head += macro("note", AT_LIMIT if at_limit else "")
        return Row(head, cells, {"observer": name, "target": target})

    def _head(self, name: str) -> Markup:
        label = row_label(name)
        return swatch(name, self.display.dark) + (term(TERM_OF_BOUND, label) if name in BOUNDS else label)

    def _compared_cells(self, name: str, target: str, score: Score | None) -> list[str]:
        """Write the error in every compared run, and the change from there."""
        return [self._compared_cell(run, name, target, score) for run in self.display.compared_runs]

    def _compared_cell(self, run: ComparedRun, name: str, target: str, score: Score | None) -> str:
        before = run.score(name, target, self.display.mode)
        if before is None:
            return NOTHING
        scale = per_micrometre(self.display.unit, run.scenario.telescope.diameter)
        return macro("change", change(before.rms, score.rms if score else None)) + number(before.rms * scale)


def _stretch(scores: list[Score]) -> str:
    """Write the stretch over which comparable rows were scored, for the end of a heading."""
    stretch = scored_interval(score_rows(scores, None))
    return f", {stretch}" if stretch else ""


def _own(score: Score | None) -> Markup:
    """Write the stretch of an observer that was scored on samples of its own, to stand beside its name."""
    return macro("note", own_interval(score_rows([score], None)[0]) if score and score.apart else "")


def _own_sd(score: Score, scale: float) -> str:
    """Write the standard deviation that an observer states, where it states one."""
    return NOTHING if score.calibration is None else number(score.calibration.sd * scale)


def _times(score: Score, dt: float) -> list[str]:
    """Time per step [us], and over the step of the loop."""
    if score.observer in NOT_OBSERVERS:
        return [NOTHING] * 2
    return [number(1e6 * score.seconds_per_step), number(score.seconds_per_step / dt, 2)]
