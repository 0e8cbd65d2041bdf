"""The RMS table, plain HTML."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

from markupsafe import Markup

from wfsobs.app.compared import ComparedRun
from wfsobs.app.display import AT_LIMIT, FROM_RECORD, IN_MOST, OVER_SEEDS, Display, score_columns
from wfsobs.app.glossary import BOUND as TERM_OF_BOUND
from wfsobs.app.glossary import term
from wfsobs.app.idle_work import SeedRuns
from wfsobs.app.jobs import DONE
from wfsobs.app.render import Row, change, hundredths, macro, missing, number, table
from wfsobs.app.service import BackgroundTask
from wfsobs.app.style import follow_html, observers_of, swatch
from wfsobs.app.work import RunResults
from wfsobs.evaluation.evidence import Evidence, marks_of
from wfsobs.evaluation.result import Failure
from wfsobs.evaluation.rows import (
    NOT_OBSERVERS,
    at_bound,
    group_by_knowledge,
    is_non_causal,
    own_interval,
    row_label,
    score_rows,
    scored_interval,
    target_title,
)
from wfsobs.evaluation.scores import BOUNDS, COMMON_BOUNDS, LOOP, PREDICTION, RESIDUAL, SCORED, Score
from wfsobs.observers import OBSERVERS
from wfsobs.prior import TRUE
from wfsobs.priors_from.scenario import is_usual

ABOVE = macro("tag", "above", "worse than zero")


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
        self.run = run
        self.display = display
        self.seeds = seeds
        switches = ["mode", "unit", "dark", "compared_runs"]
        self.pane: Final = follow_html(self.html, (run, ["result", "state"]), (seeds, "evidence"), (display, switches))

    @property
    def _evidence(self) -> Evidence | None:
        return self.seeds.evidence if self.seeds else None

    def html(self) -> str:
        """Write the table."""
        shown = self.run.result
        groups = [group for target in self._targets() for group in self._target(target)]
        left_out = lines_of_failures(shown.result.failures) if shown else []
        return f"{table('RMS errors', self._columns(), groups=groups)}{macro('texts', 'failure', left_out)}"

    def _columns(self) -> dict[str, str]:
        """Heading -> explanation."""
        unit = self.display.unit_label
        compared = {
            f"{run.letter} [{unit}]": f"RMS error in {run.name}, and the change from there to the result shown"
            for run in self.display.compared_runs
        }
        return score_columns(unit, "truth" if self._targets() == SCORED else "z", compared)

    def _targets(self) -> tuple[str, ...]:
        """List what errors are of: without truth, of predictions of the next measurement, and what the recorded loop left."""
        shown = self.run.result
        without = shown is not None and any((s.target, s.mode) == (RESIDUAL, self.display.mode) for s in shown.result.scores)
        return (PREDICTION, RESIDUAL) if without else SCORED

    def _target(self, target: str) -> list[tuple[str, list[Row]]]:
        """List the rows of a target under its title, a group per kind of prior knowledge, the smallest error first."""
        shown = self.run.result
        if target in SCORED:
            names = [
                name
                for name in (*observers_of(target, with_zero=True), *BOUNDS)
                if not shown or name in BOUNDS or is_usual(OBSERVERS[name], shown.result.scenario, shown.result.record)
            ]
        else:
            of_mode = [s for s in shown.result.scores if s.mode == self.display.mode] if shown else []
            names = [s.observer for s in of_mode if s.target == target]
        scores = {name: self._score(name, target) for name in names}
        for name in set(BOUNDS).difference(COMMON_BOUNDS):  # only where stars differ, or modes are coupled
            if not scores.get(name):
                scores.pop(name, None)
        known = [s for s in scores.values() if s]
        leaders = self._evidence.leaders(target, self.display.mode) if self._evidence else ()
        marks = marks_of({s.observer: (s.rms, s.apart) for s in known}, leaders)
        limits = {key[0] for key in at_bound(known)}
        order = sorted(scores, key=lambda name: (it.apart, it.rms) if (it := scores[name]) else (True, math.inf))
        groups = group_by_knowledge(order, shown.result.prior_source if shown else TRUE)
        rows = {
            title: [self._row(name, target, scores[name], marks.get(name), name in limits) for name in of]
            for title, of in groups.items()
        }
        return [(self._title(target, known), []), *rows.items()]

    def _title(self, target: str, scores: Sequence[Score]) -> str:
        """Write the title of a target: what it is, over which stretch, and how large."""
        shown, parts = self.run.result, [target_title(target), self.display.mode]
        if target in (PREDICTION, RESIDUAL):
            title = "one step ahead: the record has no truth" if target == PREDICTION else "what the recorded loop left"
            parts = [{PREDICTION: "Next measurement z", RESIDUAL: "Residual"}[target], self.display.mode, title]
        own = [s for s in scores if not s.apart]
        if shown and own:
            scale = self.display.scale(shown.scenario)
            of = "truth" if target in SCORED else "z"
            parts += [
                scored_interval(score_rows(own, None)),
                f"rms of {of} {number(own[0].truth_rms * scale)} {self.display.unit_label}",
            ]
        return ", ".join(filter(None, parts))

    def _score(self, name: str, target: str) -> Score | None:
        """Find a score, with the mean over the seeds where there are several."""
        score = find(self.run.result, name, target, self.display.mode) if self.run.result else None
        return self._evidence.over_seeds(score) if score and self._evidence else score

    def _interval(self, score: Score, scale: float) -> Markup:
        """Write the interval of a bound or a mean error, to stand before it."""
        if score.interval is None:
            return Markup()
        of = f"{self._evidence.n_seeds} seeds" if self._evidence else FROM_RECORD
        meaning = IN_MOST if score.observer in BOUNDS else f"{OVER_SEEDS}, {of}"
        return macro("interval", *(number(x * scale) for x in score.interval), meaning)

    def _row(self, name: str, target: str, score: Score | None, mark: str | None, at_limit: bool) -> Row:
        shown = self.run.result
        now = find(shown, name, target, self.display.mode) if shown else None
        compared = [self._compared_cell(run, name, target, now) for run in self.display.compared_runs]
        if shown is None or score is None:
            why = "no error: it has no estimate" if shown and self.run.state == DONE else "not computed yet"
            cells = [missing(why), *compared, *[missing(why)] * 5]
        else:
            scale = self.display.scale(shown.scenario)
            cells = [
                # The number last, so that numbers stand below each other.
                self._interval(score, scale) + " " + (macro("tag", mark, mark) if mark else "") + number(score.rms * scale),
                *compared,
                (ABOVE if target in SCORED and (score.normalised_rms or 0.0) > 1.0 else "")
                + _or_why(score.normalised_rms, "z is 0"),
                _or_why(None if score.lag is None else 1e3 * score.lag, _no_lag(score)),
                *_times(score, shown.result.record.dt),
                missing("it predicts no sigma") if score.calibration is None else number(score.calibration.sd * scale),
            ]
        head = self._head(name) + macro("note", "looks ahead" if is_non_causal(name) else "") + _own(score)
        head += macro("note", AT_LIMIT if at_limit else "")
        return Row(head, cells, {"observer": name, "target": target})

    def _head(self, name: str) -> Markup:
        label = row_label(name)
        if name == LOOP:
            return Markup() + label
        return swatch(name, self.display.dark) + (term(TERM_OF_BOUND, label) if name in BOUNDS else label)

    def _compared_cell(self, run: ComparedRun, name: str, target: str, score: Score | None) -> str:
        """Write the error in a compared run, and the change from there."""
        before = run.score(name, target, self.display.mode)
        if before is None:
            return missing(f"{run.name} does not have it")
        scale = self.display.scale(run.scenario)
        return macro("change", change(before.rms, score.rms if score else None)) + number(before.rms * scale)


def _own(score: Score | None) -> Markup:
    """Write the stretch of an observer that was scored on samples of its own, to stand beside its name."""
    return macro("note", own_interval(score_rows([score], None)[0]) if score and score.apart else "")


def _no_lag(score: Score) -> str:
    """Say why an error has no lag."""
    if score.observer in BOUNDS:
        return "a limit has none"
    return "not compared with a truth" if score.target in (PREDICTION, RESIDUAL) else "estimate or truth is constant"


def _or_why(value: float | None, why: str) -> Markup | str:
    return missing(why) if value is None else hundredths(value)


def _times(score: Score, dt: float) -> list[str]:
    """Time per step [us], and over the step of the loop."""
    if score.observer in NOT_OBSERVERS:
        return [missing("nothing is computed")] * 2
    return [hundredths(1e6 * score.seconds_per_step), hundredths(score.seconds_per_step / dt)]
