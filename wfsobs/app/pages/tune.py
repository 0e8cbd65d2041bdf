"""The settings of an observer that are best on a validation record: what is searched, how it goes, before and after."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from html import escape
from typing import Any

import panel as pn
import panel_material_ui as pmui

from wfsobs.app.controls.fields import parse_number
from wfsobs.app.controls.names import setting_name
from wfsobs.app.copies import TUNE, CopiedTask
from wfsobs.app.display import UNITS, Display, per_micrometre
from wfsobs.app.downloads import Save, table_csv
from wfsobs.app.jobs.job import RUNNING, SWEEP, Job
from wfsobs.app.jobs.task import BackgroundTask
from wfsobs.app.numerals import number
from wfsobs.app.pages.link import LinkedFields
from wfsobs.app.pages.parts import WIDE, PageActions, Starter, box, html, legend, line, text
from wfsobs.app.pages.tune_views import LEGEND, HistoryFigure, tuning_html, unit_for
from wfsobs.app.store import Store
from wfsobs.app.tune_work import MOST, best_so_far, choices, compute, minimised_measure, seconds, tuning_rows
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import VIBRATION
from wfsobs.record import RecordError
from wfsobs.scenario.configfile import changed_settings
from wfsobs.settings.errors import SettingError
from wfsobs.settings.parameters import hint
from wfsobs.tuning import Evaluation, TuningResult
from wfsobs.tuning.records import MEASURES, TRUTH
from wfsobs.tuning.report import tuning_toml
from wfsobs.tuning.tuning import EVALUATIONS

INTRO = (
    "Searches the settings of one observer for the smallest RMS error on a validation record, which is neither the training nor "
    "the test record, and scores the settings before and after on the test record, which the search never uses. Records are "
    "simulated from the settings; a loaded record is cut into pieces. Without truth, tuning minimises the one-step prediction "
    "error, or the distance to a Butterworth reference. “Use it” takes the tuned settings into the drawer."
)
EARLIER = "The settings in the drawer have changed since this tuning."
START = "gpr-online"
COLUMNS: tuple[str, ...] = ("section", "name", "before", "after")


class TunePage(PageActions):
    """The page. Nothing is computed before it is asked for."""

    def __init__(self, store: Store, display: Display):
        self.store, self.run, self.display = store, store.run, display
        self.work = BackgroundTask(store.session, title="Tuning")
        self.starter = Starter(self.work, "Start tuning", "Progress of the tuning", self._so_far)
        self.observer = pmui.Select(label="Observer", options=choices(), value=START, size="small", width=250, margin=0)
        self.target = pmui.Select(label="Error of", options=[], size="small", width=130, margin=0)
        self.evaluations = pmui.TextInput(label="Evaluations", value=str(EVALUATIONS), size="small", width=110, margin=0)
        self.inputs = (self.observer, self.target, self.evaluations)
        self.figure = HistoryFigure()
        self.measure = MEASURES[TRUTH]
        self.search_space, self.legend, self.table = html(), html(), html()
        self.history = box("History", self.legend, pn.pane.Bokeh(self.figure.figure, **WIDE))
        self.outcome = box("Before and after", self.table)
        self.history.visible = self.outcome.visible = False
        self.stale = pmui.Alert(object=EARLIER, severity="warning", visible=False, **WIDE)
        self.visible = False
        self.starter.start.on_click(lambda _event: self.start())
        self.starter.uses[0].on_click(lambda _event: self.use())
        self.observer.param.watch(self._choose, "value")
        self.work.param.watch(self._redraw, ["latest", "result"])
        store.param.watch(self._compare, "scenario")
        display.param.watch(self._redraw, ["unit", "dark"])
        self._choose()
        self.link = LinkedFields(observer=self.observer, target=self.target, evaluations=self.evaluations)

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        row = line(self.observer, self.target, self.evaluations, *self.starter.view())
        return pn.Column(
            box("Tuning", text(INTRO), row, self.search_space, self.starter.status, self.stale),
            self.history,
            self.outcome,
            **WIDE,
            stylesheets=[":host { gap: 10px; }"],
        )

    def show(self, visible: bool) -> None:
        """Draw what has come meanwhile, and go on while visible."""
        self.visible = visible
        self._redraw()

    def start(self) -> None:
        """Tune the chosen observer."""
        of, observer, target, scenario = self.run.result, self.observer.value, self.target.value, self.store.scenario
        if of is None:
            self.work.refuse("There is no record yet.")
            return
        try:
            evaluations = _whole(self.evaluations, MOST)
            cost = seconds(of, scenario, observer, evaluations)
            self.store.limits.check_seconds(cost, "tuning")
            self.measure = minimised_measure(of, observer, target)
        except (SettingError, RecordError) as error:
            self.work.refuse(str(error))
        else:
            work = partial(compute, of, scenario, observer, target, evaluations)
            self.work.start(Job("tune", work, cost=cost, priority=SWEEP, time_limit=self.store.limits.seconds))

    def use(self) -> None:
        """Take what was tuned into the settings, and leave the others as they are by now."""
        tuned = self._tuning_result()
        if tuned is not None:
            try:
                self.store.replace(changed_settings(tuned.scenario, tuned.before.scenario))
            except SettingError as error:
                self.work.refuse(str(error))

    @property
    def task(self) -> CopiedTask:
        """To tune the chosen observer."""
        evaluations = parse_number(str(self.evaluations.value))
        return CopiedTask(TUNE, {"observer": self.observer.value, "target": self.target.value, "evaluations": evaluations})

    def saves(self) -> Mapping[str, Save | None]:
        """Offer the table, errors in [um], and the settings as `wfsobs tune --out` writes them."""
        if (tuned := self._tuning_result()) is None:
            return {"Tuning table as CSV": None, "Tuned settings as TOML": None}
        table = [dict(zip(COLUMNS, row, strict=True)) for row in tuning_rows(tuned)]
        return {
            "Tuning table as CSV": Save("wfsobs-tuning.csv", "text/csv", lambda: table_csv(table)),
            "Tuned settings as TOML": Save("wfsobs-tuned.toml", "application/toml", tuning_toml(tuned).encode),
        }

    def _choose(self, *_: object) -> None:
        """Offer what the observer estimates, and say what is searched."""
        name = self.observer.value
        targets = list(OBSERVERS[name].targets)
        self.target.param.update(options=targets, value=VIBRATION if VIBRATION in targets else targets[0])
        names = ", ".join(map(setting_name, OBSERVERS[name].tunable.usual))
        self.search_space.object = f'<p class="text">Searched: {escape(names)}.</p>'

    def _tuning_result(self) -> TuningResult | None:
        return self.work.result

    def _history(self) -> tuple[Evaluation, ...]:
        """Of the tuning under way, or of the last one."""
        if self.work.state == RUNNING:
            return self.work.latest or ()
        tuned = self._tuning_result()
        return tuned.history if tuned else self.work.latest or ()

    def _scale(self) -> tuple[str, float]:
        return unit_for(self._tuning_result(), self.display), self.store.scenario.telescope.diameter

    def _so_far(self) -> str:
        """Describe what the search has reached."""
        history = self._history()
        if self.work.state != RUNNING or not history:
            return ""
        unit, diameter = self._scale()
        first, best = (number(per_micrometre(unit, diameter) * x) for x in (history[0].rms, best_so_far(history)[-1]))
        return f" · {len(history)} evaluations, best {best} {UNITS[unit]}, {first} {UNITS[unit]} before"

    def _redraw(self, *_: object) -> None:
        if not self.visible:
            return
        tuned, (unit, diameter) = self._tuning_result(), self._scale()
        with pn.io.hold():
            self.legend.object = legend(LEGEND, self.display.dark)
            self.figure.draw(self._history(), self.measure, unit, diameter)
            self.figure.restyle(self.display.dark)
            self.history.visible, self.outcome.visible = bool(self._history()), tuned is not None
            if tuned is not None:
                self.table.object = tuning_html(tuned, self.display, diameter)
        self._compare()

    def _compare(self, *_: Any) -> None:
        """Whether the settings are still those that were tuned, before or after."""
        tuned, now = self._tuning_result(), self.store.scenario
        self.stale.visible = tuned is not None and now not in (tuned.before.scenario, tuned.scenario)


def _whole(field: pmui.TextInput, most: int) -> int:
    """Read a whole number that was typed. Raises SettingError."""
    value = parse_number(str(field.value))
    if not isinstance(value, int) or not 1 <= value <= most:
        raise SettingError(
            f"{field.label} = {str(field.value)[:40]!r}: takes a whole number from 1 to {most}{hint(str(field.value))}"
        )
    return value
