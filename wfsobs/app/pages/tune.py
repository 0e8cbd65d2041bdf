"""The settings of an observer that are best on a validation record: what is searched, how it goes, before and after."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from html import escape
from time import monotonic
from typing import Any, Final

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, DataRange1d

from wfsobs.app.controls.fields import parse_number
from wfsobs.app.display import NO_ANGLE, UNITS, Display, per_micrometre
from wfsobs.app.downloads import table_csv
from wfsobs.app.jobs import INTERVAL, RUNNING, Tell
from wfsobs.app.pages.parts import (
    LinkedFields,
    Page,
    Starter,
    box,
    boxes,
    example,
    html,
    legend,
    line,
    number_field,
    pane,
    read_number,
    render_part,
    text,
    warning,
)
from wfsobs.app.render import change, number
from wfsobs.app.service import BackgroundTask
from wfsobs.app.share import TUNE, CopiedTask
from wfsobs.app.store import Store
from wfsobs.app.style import look, make_select
from wfsobs.app.views.plots import call, new_figure
from wfsobs.app.work import RunResults
from wfsobs.cost import part_seconds
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import VIBRATION
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import changed_settings
from wfsobs.scenario.names import setting_label, setting_name
from wfsobs.sensors.zernike import TIP_TILT
from wfsobs.tuning import Evaluation, TuningResult, tune
from wfsobs.tuning.records import MEASURES, NEXT, REFERENCE, TRUTH, judged_by
from wfsobs.tuning.tuning import (
    EVALUATIONS,
    LIKELIHOOD,
    OTHER,
    SETTING,
    TEST,
    TOGETHER,
    VALIDATION,
    best_so_far,
    tuning_remarks,
    tuning_rows,
    tuning_toml,
)

MOST = 1000
"""Evaluations."""


def choices() -> dict[str, str]:
    """Label -> observer, of those that have something to tune."""
    return {o.label: o.id for o in OBSERVERS.values() if o.tunable.usual}


def seconds(of: RunResults, scenario: Scenario, observer: str, evaluations: int) -> float:
    """Estimate how long a tuning takes [s].

    The observer is taken to need the time per step that it had in the results shown, on records of the same length, or on at
    most half of a record that was loaded.
    """
    each = max((e.seconds_per_step for e in of.result.estimates if e.observer == observer), default=0.0)
    record, share = of.result.record, 0.5 if of.is_recorded else 1.0
    simulation = 0.0 if of.is_recorded else 3.0 * part_seconds(scenario)["rest"]
    return (evaluations + 2) * each * share * record.n_steps * record.n_modes + simulation


def compute(
    of: RunResults, scenario: Scenario, observer: str, target: str, evaluations: int, watch: Watch, tell: Tell
) -> TuningResult:
    """Tune on simulated records, or on the pieces of a record that was loaded; tells of all evaluations so far.

    Raises SettingError, RecordError, Cancelled.
    """
    history: list[Evaluation] = []
    last = 0.0

    def told(evaluation: Evaluation) -> None:
        nonlocal last
        history.append(evaluation)
        if monotonic() - last >= INTERVAL:
            last = monotonic()
            tell(latest=tuple(history))

    record = of.result.record if of.is_recorded else None
    return tune(scenario, observer, evaluations=evaluations, record=record, target=target, on_evaluation=told, watch=watch)


TITLES = {
    SETTING: "Settings",
    VALIDATION: "{measure} on the validation record, used in the search [{unit}]",
    TEST: "{measure} on the test record, not used in the search [{unit}]",
    OTHER: "The same for the other target, turbulence or vibration [{unit}]",
    LIKELIHOOD: "Log marginal likelihood of the training targets, for information",
}
LEGEND = {"tried": "evaluations", "fitted": "best so far"}

AXES = {MEASURES[TRUTH]: "rms error", MEASURES[NEXT]: "prediction error", MEASURES[REFERENCE]: "rms distance"}
"""What a tuning makes small, short enough for an axis."""


class HistoryFigure:
    """The error, or what takes its place, on the validation record of every evaluation, and the least so far."""

    def __init__(self) -> None:
        self.figure: Final = new_figure(DataRange1d(range_padding=0.02), label="evaluation")
        call(self.figure, "History of the tuning")
        self.source: Final = ColumnDataSource({"x": [], "tried": [], "best": []})
        self._trials = self.figure.scatter("x", "tried", source=self.source, size=6, fill_alpha=0.7)
        self._best = self.figure.step("x", "best", source=self.source, mode="after", line_width=2.0)

    def draw(self, history: Sequence[Evaluation], measure: str, unit: str, diameter: float, dark: bool) -> None:
        """Send the evaluations so far, in the colours of light or dark mode; what failed has no point."""
        scale = per_micrometre(unit, diameter)
        tried, best = (scale * np.array(y, dtype=float) for y in ([e.rms for e in history], best_so_far(history)))
        self.source.data = {
            "x": np.arange(1, len(history) + 1),
            "tried": np.where(np.isfinite(tried), tried, np.nan),
            "best": np.where(np.isfinite(best), best, np.nan),
        }
        self.figure.yaxis.axis_label = f"{AXES[measure]}, validation [{UNITS[unit]}]"
        colour = look("tried").colour(dark)
        self._trials.glyph.update(line_color=colour, fill_color=colour)
        self._best.glyph.update(line_color=look("fitted").colour(dark))


def unit_for(result: TuningResult | None, display: Display) -> str:
    """Choose the unit: the one shown, or nm where it is an angle and the modes have none."""
    modes = (result.before.validation or result.after.validation) if result else None
    angles = modes is None or set(modes.modes) <= {mode.name for mode in TIP_TILT}
    return "nm" if display.unit in NO_ANGLE and not angles else display.unit


def tuning_html(result: TuningResult, display: Display, diameter: float) -> str:
    """Write settings, errors and likelihoods before and after."""
    unit, sections = unit_for(result, display), dict[str, list[tuple[object, ...]]]()
    for section, *row in tuning_rows(result):
        sections.setdefault(section, []).append(tuple(row))
    return render_part(
        "tuning",
        display,
        sections=sections,
        titles=TITLES,
        measure=result.measure,
        unit=UNITS[unit],
        scale=per_micrometre(unit, diameter),
        errors=(VALIDATION, TEST, OTHER),
        setting=SETTING,
        setting_label=partial(setting_label, result.after.scenario),
        together=TOGETHER,
        change=change,
        notes=[f"{line[0].upper()}{line[1:]}." for line in tuning_remarks(result) if "likelihood" not in line],
    )


INTRO = (
    "Searches the settings of one observer for the smallest RMS error on a validation record, which is neither the training nor "
    "the test record, and scores the settings before and after on the test record, which the search never uses. Records are "
    "simulated from the settings; a loaded record is cut into pieces. Without truth, tuning minimises the one-step prediction "
    "error, or the distance to a Butterworth reference. “Use it” takes the tuned settings into the drawer."
)
EARLIER = "The settings in the drawer have changed since this tuning."
START = "gpr-online"
COLUMNS: tuple[str, ...] = ("section", "name", "before", "after")


class TunePage(Page):
    """The page. Nothing is computed before it is asked for."""

    files = {
        "Tuning table as CSV": (
            "wfsobs-tuning.csv",
            lambda tuned: table_csv([dict(zip(COLUMNS, row, strict=True)) for row in tuning_rows(tuned)]),
        ),
        "Tuned settings as TOML": ("wfsobs-tuned.toml", lambda tuned: tuning_toml(tuned).encode()),
    }
    """Errors in [um]; the settings as `wfsobs tune --out` writes them."""

    def __init__(self, store: Store, display: Display):
        super().__init__(store, display, "unit", "dark")
        self.work: Final = BackgroundTask(store.session, title="Tuning")
        self.starter: Final = Starter(
            self.work, self._start, "Start tuning", "Progress of the tuning", self._so_far, {"Use it": self.use}
        )
        self.observer: Final = make_select("Observer", choices(), START, 250)
        self.target: Final = make_select("Error of", [], None, 130)
        self.evaluations: Final = number_field("Evaluations", EVALUATIONS, 110)
        self.figure: Final = HistoryFigure()
        self.measure = MEASURES[TRUTH]
        self.search_space, self.legend, self.table = (html() for _ in range(3))
        self.history: Final = box("History", self.legend, pane(self.figure.figure))
        self.outcome: Final = box("Before and after", self.table)
        self.history.visible = self.outcome.visible = False
        self.stale: Final = warning(EARLIER)
        self.observer.param.watch(self._choose, "value")
        self.work.param.watch(self.redraw, ["latest", "result"])
        store.param.watch(self._compare, "scenario")
        self._choose()
        self.link = LinkedFields({"observer": self.observer, "target": self.target, "evaluations": self.evaluations})

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        row = line(self.observer, self.target, self.evaluations, *self.starter.view())
        tuning = box("Tuning", text(INTRO), row, self.search_space, self.starter.status, self.stale)
        return boxes(tuning, example("tune", self.history), self.history, self.outcome)

    def _start(self) -> None:
        of, observer, target, scenario = self.shown_results(), self.observer.value, self.target.value, self.store.scenario
        evaluations = read_number(self.evaluations, 1, MOST, whole=True)
        cost = seconds(of, scenario, observer, evaluations)
        job = self.store.limits.job("tune", "tuning", partial(compute, of, scenario, observer, target, evaluations), cost)
        self.measure = MEASURES[judged_by(of.result.record, observer, target)[1] if of.is_recorded else TRUTH]
        self.work.start(job)

    def use(self) -> None:
        """Take what was tuned into the settings, and leave the others as they are by now."""
        if (tuned := self.finding) is not None:
            self.store.replace(changed_settings(tuned.scenario, tuned.before.scenario))

    @property
    def task(self) -> CopiedTask:
        """To tune the chosen observer."""
        evaluations = parse_number(str(self.evaluations.value))
        return CopiedTask(TUNE, {"observer": self.observer.value, "target": self.target.value, "evaluations": evaluations})

    @property
    def finding(self) -> TuningResult | None:
        """The last tuning."""
        return self.work.result

    def _choose(self, *_: object) -> None:
        """Offer what the observer estimates, and say what is searched."""
        name = self.observer.value
        targets = list(OBSERVERS[name].targets)
        self.target.param.update(options=targets, value=VIBRATION if VIBRATION in targets else targets[0])
        names = ", ".join(map(setting_name, OBSERVERS[name].tunable.usual))
        self.search_space.html = f'<p class="text">Searched: {escape(names)}.</p>'

    def _history(self) -> tuple[Evaluation, ...]:
        """Of the tuning under way, or of the last one."""
        tuned = None if self.work.state == RUNNING else self.finding
        return tuned.history if tuned else self.work.latest or ()

    def _scale(self) -> tuple[str, float]:
        return unit_for(self.finding, self.display), self.store.scenario.telescope.diameter

    def _so_far(self) -> str:
        """Describe what the search has reached."""
        history = self._history()
        if self.work.state != RUNNING or not history:
            return ""
        unit, diameter = self._scale()
        first, best = (number(per_micrometre(unit, diameter) * x) for x in (history[0].rms, best_so_far(history)[-1]))
        return f" · {len(history)} evaluations, best {best} {UNITS[unit]}, {first} {UNITS[unit]} before"

    def draw(self) -> None:
        """Draw how it went, and what came of it."""
        tuned, (unit, diameter) = self.finding, self._scale()
        self.legend.html = legend(LEGEND, self.display.dark)
        self.figure.draw(self._history(), self.measure, unit, diameter, self.display.dark)
        self.history.visible, self.outcome.visible = bool(self._history()), tuned is not None
        if tuned is not None:
            self.table.html = tuning_html(tuned, self.display, diameter)
        self._compare()

    def _compare(self, *_: Any) -> None:
        """Whether the settings are still those that were tuned, before or after."""
        tuned, now = self.finding, self.store.scenario
        self.stale.visible = tuned is not None and now not in (tuned.before.scenario, tuned.scenario)
