"""Errors over one setting, or a map over two with the best observer of each cell, over several seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from html import escape
from time import monotonic
from typing import Any

import panel as pn
import panel_material_ui as pmui

from wfsobs.app.controls.fields import parse_number
from wfsobs.app.copies import SWEEP, CopiedTask
from wfsobs.app.display import Display
from wfsobs.app.downloads import Save, table_csv
from wfsobs.app.jobs.job import RUNNING
from wfsobs.app.pages.link import LinkedFields
from wfsobs.app.pages.parts import TALL, WIDE, PageActions, Starter, box, html, legend, line, text
from wfsobs.app.pages.sweep_axis import NONE, AxisFields
from wfsobs.app.pages.sweep_settings import line_of, read_axis, sweep_settings
from wfsobs.app.pages.sweep_views import SweepMap, legend_of_shades, line_part, map_grid
from wfsobs.app.store import Store
from wfsobs.app.style import look
from wfsobs.app.sweep_work import SweepTask
from wfsobs.app.views.sweep_lines import SweepLines
from wfsobs.campaign.sweep import MOST_SEEDS, Sweep, plan_sweep
from wfsobs.campaign.sweep_results import SweepResults
from wfsobs.evaluation.rows import target_title
from wfsobs.evaluation.scores import SCORED
from wfsobs.priors_from.selection import quick_observers
from wfsobs.settings.errors import SettingError

INTRO = (
    "Runs the scenario in the drawer over the values of one setting, or every combination of two, with several seeds of each. "
    "Values are low:high:number, low:high:number:log, or a list with commas. A single setting gives the error of every observer "
    "over it, with the interval of its mean; two give a map of the best observer."
)
EARLIER = "The settings in the drawer have changed since this sweep."
FIRST = (("turbulence.wind_speed", "5:25:5"), ("sensors.exposure_ratio", "2,5,10,20"))
SEEDS = 4
QUICK, EVERY = "quick", "every"
OBSERVERS_OF = {"Fast observers only (no GPR)": QUICK, "All": EVERY}
REDRAW = 0.3
"""Least time between two pictures while runs come in [s]."""


class SweepPage(PageActions):
    """The page. Nothing is run before it is asked for."""

    def __init__(self, store: Store, display: Display, explore: Callable[[], None]):
        """Make the page. explore : turns to the page that shows a scenario."""
        self.store, self.display, self._explore = store, display, explore
        self.work = SweepTask(store.session)
        self.starter = Starter(self.work, "Run the sweep", "Progress of the sweep", self._so_far, uses=())
        names = sweep_settings(store.scenario)
        (first, values), (second, more) = FIRST
        self.axes = (
            AxisFields(store, ("Error over", "Values"), names, first, values),
            AxisFields(store, ("and over", "Values of the second"), {"no second setting": NONE, **names}, second, more),
        )
        self.settings, self.values = [axis.select for axis in self.axes], [axis.values for axis in self.axes]
        self.seeds = pmui.TextInput(label="Seeds of each", value=str(SEEDS), size="small", width=120, margin=0)
        self.observers = pmui.Select(label="Observers", options=OBSERVERS_OF, value=QUICK, size="small", width=290, margin=0)
        self.inputs = (*self.settings, *self.values, self.seeds, self.observers)
        (over, second), (values, more) = self.settings, self.values
        self.link = LinkedFields(
            over=over, values=values, second=second, second_values=more, seeds=self.seeds, observers=self.observers
        )
        self.estimate = html()
        self.maps = {target: SweepMap(self.load, grid={}, **WIDE) for target in SCORED}
        self.lines: dict[str, SweepLines] = {}
        self.panes = {target: pn.Column(**WIDE) for target in SCORED}
        self.legends = {target: html() for target in SCORED}
        self.stale = pmui.Alert(object=EARLIER, severity="warning", visible=False, **WIDE)
        self.boxes = [box(target_title(target), self.legends[target], self.panes[target], self.maps[target]) for target in SCORED]
        self.shades = text(f"{legend_of_shades()} Click a cell to load its scenario in Explore.")
        self.visible, self._draw_time = False, 0.0
        for part in (*self.boxes, self.shades):
            part.visible = False
        self._watch()

    def _watch(self) -> None:
        self.starter.start.on_click(lambda _event: self.start())
        for field in self.inputs:
            field.param.watch(self._estimate, "value")
        self.work.param.watch(self._take, ["state", "result"])
        self.store.param.watch(self._follow, ["scenario", "source"])
        self.display.param.watch(self._redraw, ["mode", "unit", "dark"])

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        row = line(*(field for pair in zip(self.settings, self.values, strict=True) for field in pair))
        more = line(self.seeds, self.observers, *self.starter.view())
        return pn.Column(
            box("Sweep", text(INTRO), row, more, self.estimate, self.starter.status, self.stale),
            *self.boxes,
            self.shades,
            **WIDE,
            stylesheets=[":host { gap: 10px; }"],
        )

    def show(self, visible: bool) -> None:
        """Draw what has come meanwhile, and go on while visible."""
        self.visible = visible
        self._estimate()
        self._redraw()

    def choose(self, path: str) -> None:
        """Prepare the error over one setting, by its path."""
        first, second = self.axes
        if first.offer(path):
            with pn.io.hold():  # what is typed then is typed after it
                second.choose(NONE)
                first.choose(path)

    def open_link(self, fields: Mapping[str, str]) -> list[str]:
        """Fill in what an address has; a setting of a list is not among the choices until it is asked for."""
        for axis, name in zip(self.axes, ("over", "second"), strict=True):
            axis.offer(fields.get(name, NONE))
        return super().open_link(fields)

    def plan(self) -> Sweep:
        """Return the sweep that the fields describe. Raises SettingError."""
        if self.store.source is not None:
            raise SettingError("A sweep simulates the settings: go back to the simulation first")
        axes = [read_axis(path, values) for path, values in self._axes()]
        seeds = parse_number(str(self.seeds.value))
        if not isinstance(seeds, int):
            raise SettingError(f"Seeds of each = {str(seeds)[:40]!r}: takes a whole number from 1 to {MOST_SEEDS}")
        sweep = plan_sweep(self.store.scenario, axes, seeds, self._observers())
        for cell in sweep.edge:
            self.store.limits.check(sweep.scenario(cell))
        self.store.limits.check_sweep(sweep.seconds, sweep.n_runs)
        return sweep

    def _axes(self) -> list[tuple[str, str]]:
        """Return the settings that are chosen, and their values as they were typed."""
        return [(axis.path, axis.values.value) for axis in self.axes if axis.path != NONE]

    def _observers(self) -> list[str] | None:
        """Return the ids of the observers, those whose own settings are swept among them; None for all."""
        groups = {path.partition(".")[0] for path, _ in self._axes()}
        return quick_observers(self.store.scenario, groups) if self.observers.value == QUICK else None

    def start(self) -> None:
        """Run the sweep that the fields describe, or say in one line why not."""
        try:
            sweep = self.plan()
        except SettingError as error:
            self.work.refuse(line_of(error))
        else:
            self.lines = {}
            self.work.begin(sweep)

    def load(self, cell: int) -> None:
        """Take the scenario of a cell into the drawer, and show it."""
        results = self.results
        if results is None or not 0 <= cell < len(results.sweep.cells):
            return
        try:
            self.store.run_on(None, results.sweep.scenario(cell))
        except SettingError as error:
            self.work.refuse(line_of(error))
        else:
            self._explore()

    @property
    def results(self) -> SweepResults | None:
        """What is known of the last sweep."""
        return self.work.result

    @property
    def task(self) -> CopiedTask:
        """To run the sweep."""
        over = [f"{path}={values}" for path, values in self._axes()]
        return CopiedTask(SWEEP, {"over": over, "seeds": self.seeds.value, "observer": self._observers() or []})

    def saves(self) -> Mapping[str, Save | None]:
        """Offer the errors of all cells, as `wfsobs sweep --csv` writes them."""
        known = self.results and self.results.rows()
        return {"Sweep as CSV": Save("wfsobs-sweep.csv", "text/csv", lambda: table_csv(known)) if known else None}

    def _follow(self, *_: object) -> None:
        self._compare()
        self._estimate()

    def _estimate(self, *_: object) -> None:
        """Say what would be run, or why it cannot be."""
        if not self.visible:
            return
        try:
            sweep = self.plan()
        except SettingError as error:
            said, kind = line_of(error), "failure"
        else:
            counts = " × ".join(str(len(axis.values)) for axis in sweep.axes)
            seeds = f"{sweep.seeds} seed{'s' * (sweep.seeds > 1)}"
            said = f"{counts} scenarios × {seeds} = {sweep.n_runs} runs, about {max(sweep.seconds, 1.0):.0f} s"
            kind = "text"
        self.starter.start.disabled = kind == "failure"
        self.estimate.object = f'<p class="{kind}" role="status">{escape(said)}</p>'

    def _so_far(self) -> str:
        results = self.results
        if results is None:
            return ""
        left = self.work.seconds_left
        said = f" · {results.n_done} of {results.sweep.n_runs} runs"
        return f"{said}, about {left:.0f} s left" if left and self.work.state == RUNNING else said

    def _take(self, *_: object) -> None:
        """Draw what has come, not too often."""
        if self.work.state != RUNNING or monotonic() - self._draw_time >= REDRAW:
            self._redraw()

    def _redraw(self, *_: object) -> None:
        results = self.results
        if not self.visible or results is None:
            return
        self._draw_time = monotonic()
        single = len(results.sweep.axes) == 1
        with pn.io.hold():
            for target in SCORED:
                self.maps[target].grid = map_grid(results, target, self.display)
                if single:
                    self._draw_lines(results, target)
                self.panes[target].visible = self.legends[target].visible = single
            for part in (*self.boxes, self.shades):
                part.visible = True
            self._compare()

    def _draw_lines(self, results: SweepResults, target: str) -> None:
        part = line_part(results, target, self.display)
        if target not in self.lines:
            self.lines[target] = SweepLines(part)
            self.lines[target].figure.sizing_mode = "stretch_both"
            self.panes[target][:] = [
                pn.Column(pn.pane.Bokeh(self.lines[target].figure, sizing_mode="stretch_both", margin=0), **TALL)
            ]
        lines = self.lines[target]
        lines.draw(part, self.display.dark)
        self.legends[target].object = legend({name: look(name).label for name in lines.sources}, self.display.dark)

    def _compare(self, *_: Any) -> None:
        """Whether all other settings are still those of the sweep."""
        if self.visible and (results := self.results) is not None:
            self.stale.visible = not results.sweep.has_base(self.store.scenario)
