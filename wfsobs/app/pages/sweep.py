"""Errors over one setting, or a map over two with the best observer of each cell, over several seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from html import escape
from time import monotonic
from typing import Any, Final

import numpy as np
import panel as pn
import panel_material_ui as pmui
import param

from wfsobs.app.cache import key_of
from wfsobs.app.controls.panel import drawer_settings, topic_of
from wfsobs.app.display import Display
from wfsobs.app.downloads import table_csv
from wfsobs.app.idle_work import SeedScores
from wfsobs.app.jobs import BATCH, CANCELLED, DONE, FAILED, RUNNING, Job, Tell
from wfsobs.app.limits import Limits
from wfsobs.app.pages.parts import (
    TALL,
    WIDE,
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
    text,
    warning,
)
from wfsobs.app.pages.sweep_views import (
    SweepLines,
    legend_of_shades,
    line_part,
    map_grid,
    verdict_of_sweep,
)
from wfsobs.app.render import render
from wfsobs.app.service import BackgroundTask, Session
from wfsobs.app.share import SWEEP, CopiedTask
from wfsobs.app.store import Store
from wfsobs.app.style import HtmlComponent, look, make_select, script, sheets
from wfsobs.campaign.sweep import MOST_SEEDS, SEED, Sweep, SweepResults, parse_axis, plan_sweep, run_cell
from wfsobs.campaign.usual_values import usual_values
from wfsobs.evaluation.result import target_title
from wfsobs.evaluation.scores import SCORED
from wfsobs.priors_from.scenario import quick_observers
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import Variation
from wfsobs.scenario.names import name_settings, setting_label
from wfsobs.settings.values import SettingError


def compute(sweep: Sweep, cell: int, number: int, limits: Limits, watch: Watch, _tell: Tell) -> SeedScores:
    """Run a cell with one seed. Raises SettingError, Cancelled."""
    limits.check(sweep.scenario(cell, number))
    scores = run_cell(sweep, cell, number, watch)
    return SeedScores(scores, np.array([s.rms for s in scores]))


class SweepTask(BackgroundTask):
    """All runs of a sweep as one task; its result grows with every run.

    A run that was done before, by anybody, comes from what the server keeps: to stop and start again goes on.
    """

    def __init__(self, session: Session):
        super().__init__(session, title="Sweep")
        self._one = BackgroundTask(session)
        self._cell, self._base_key, self._start = 0, "", 0.0
        self._one.param.watch(self._take, ["state", "place"])

    def begin(self, sweep: Sweep) -> None:
        """Run a sweep, in place of the one before."""
        self.close()
        self._base_key, self._start = key_of(sweep.base), monotonic()
        self.param.update(state=RUNNING, progress=0.0, place=0, message="", result=SweepResults(sweep))
        self._go_on()

    def close(self) -> None:
        """Leave the run under way, and hear no more of it."""
        super().close()
        self._one.close()

    @property
    def seconds_left(self) -> float:
        """Time that the rest takes at the rate so far [s]; 0 where nothing is known of it."""
        return (monotonic() - self._start) * (1.0 / self.progress - 1.0) if self.progress else 0.0

    def _go_on(self) -> None:
        results: SweepResults = self.result
        following = results.next_run()
        if following is None:
            self.param.update(state=DONE, progress=1.0)
            return
        self._cell, number = following
        sweep, limits = results.sweep, self.session.service.limits
        self._one.start(
            Job(
                "sweep",
                partial(compute, sweep, self._cell, number, limits),
                key=f"{number} of {sorted(sweep.cells[self._cell].items())} by {sweep.observers} of {self._base_key}",
                cost=sweep.seconds / sweep.n_runs,
                priority=BATCH,
                time_limit=limits.seconds,
                refusal=SettingError,
            )
        )

    def _take(self, *_: object) -> None:
        """Take what a run has given, and have the next one done."""
        one, results = self._one, self.result
        if self.state != RUNNING:
            return
        if one.state == RUNNING:
            self.place = one.place
        elif one.state == CANCELLED:  # the server stops
            self.cancel()
        elif one.state in (DONE, FAILED):
            done = one.state == DONE
            results = results.add(self._cell, one.result.scores) if done else results.add_failure(self._cell, one.message)
            self.param.update(result=results, progress=results.n_done / results.sweep.n_runs)
            self._go_on()


def read_axis(path: str, values: str) -> Variation:
    """Read the values of a setting as they were typed. Raises SettingError."""
    if not values.strip():
        raise SettingError(f"{path}: takes values, such as 5:20:4 or 5,10,20; for a list [5],[5,10]")
    return parse_axis(f"{path}={values.replace('−', '-').strip()}")


def sweep_settings(scenario: Scenario) -> dict[str, str]:
    """Name -> path of every setting that a sweep can be over; those of lists, and those with one choice, are left out."""
    kinds = (param.Number, param.Selector, param.Boolean)
    topics = Scenario.settings()
    out = {}
    for path, p in drawer_settings(scenario).items():
        several = not isinstance(p, param.Selector) or len(p.objects) > 1
        if path != SEED and isinstance(p, kinds) and several:
            topic, name = str(topics[topic_of(path)].label), setting_label(scenario, path)
            out[name if name.startswith(f"{topic}:") else f"{topic}: {name}"] = path
    return out


NONE = ""
"""No setting."""

LONG: Mapping[str, Any] = {"sizing_mode": "stretch_width", "max_width": 440, "margin": 0}
"""As wide as the longest words, or as a phone."""


class AxisFields:
    """The fields; a setting that is chosen brings its usual values."""

    def __init__(self, store: Store, labels: tuple[str, str], options: dict[str, str], path: str, values: str):
        """Make the fields. labels : of the setting and of its values; options : name -> path of those to choose from."""
        self.store = store
        self.select: Final = make_select(labels[0], options, path, None, searchable=True, **LONG)
        self.values: Final = pmui.TextInput(label=labels[1], value=values, size="small", width=150, margin=0)
        self.select.param.watch(self._suggest, "value")

    @property
    def path(self) -> str:
        """The setting that is chosen; NONE for none."""
        return self.select.value

    def offer(self, path: str) -> None:
        """Have a setting among those to choose from, if there is one of that path."""
        scenario = self.store.scenario
        if path not in self.select.options.values() and scenario.parameter(path) is not None:
            self.select.options = {**self.select.options, setting_label(scenario, path): path}

    def _suggest(self, event: Any) -> None:
        if event.new != NONE:
            self.values.value = usual_values(self.store.scenario, event.new)
        self.values.disabled = event.new == NONE


INTRO = (
    "Runs the scenario in the drawer over the values of one setting, or every combination of two, with several seeds of each. "
    "Values are low:high:number, low:high:number:log, or a list with commas. A single setting gives the error of every observer "
    "over it, with the interval of its mean; two give a map of the best observer."
)
EARLIER = "The settings in the drawer have changed since this sweep."
FIRST = (("turbulence.wind_speed", "5:25:5"), ("sensors.exposure_ratio", "2,5,10,20"))
SEEDS = 4
QUICK, EVERY = "quick", "every"
OBSERVERS_OF = {"Without observers that learn during the run": QUICK, "All": EVERY}
REDRAW = 0.3
"""Least time between two pictures while runs come in [s]."""


class SweepMap(HtmlComponent):
    """The map in the browser; a click on a cell asks for its scenario."""

    _esm = script("markup", "buttons")
    _stylesheets = sheets("base", "sweep")

    def __init__(self, load: Callable[[int], None], **params: Any):
        """Make the map. load : takes the number of a cell."""
        self._load, self.grid = load, dict[str, Any]()
        super().__init__(self._take, **params)

    def draw(self, grid: dict[str, Any]) -> None:
        """Show a map: title, names of the axes and their values, cells row by row, and the key of the colours."""
        self.grid, self.html = grid, render("map.html", **grid)

    def _take(self, data: dict[str, Any]) -> None:
        if data.get("action") == "load" and (cell := str(data.get("key"))).isdecimal():
            self._load(int(cell))


class ErrorLines:
    """The figure of errors over one setting under its legend; made anew for other values or names."""

    def __init__(self) -> None:
        self.view: Final = pn.Column(**WIDE)
        self.legend: Final = html()
        self.lines: SweepLines | None = None
        self._of: tuple[object, ...] = ()

    def draw(self, part: Mapping[str, Any], dark: bool, label: Callable[[str], str]) -> None:
        """Send a part as `SweepLines` takes it. label : writes the name of a line."""
        of = (part["across"], *part["values"], *part["errors"])
        if self.lines is None or of != self._of:
            self.lines, self._of = SweepLines(part), of
            self.lines.figure.sizing_mode = "stretch_both"
            self.view[:] = [self.legend, pn.Column(pane(self.lines.figure), **TALL)]
        self.lines.draw(part, dark)
        self.legend.html = legend({name: label(name) for name in part["errors"]}, dark)


class SweepPage(Page):
    """The page. Nothing is run before it is asked for."""

    files = {"Sweep as CSV": ("wfsobs-sweep.csv", table_csv)}

    def __init__(self, store: Store, display: Display, explore: Callable[[], None]):
        """Make the page. explore : turns to the page that shows a scenario."""
        super().__init__(store, display)
        self._explore = explore
        self.work: Final = SweepTask(store.session)
        self.starter: Final = Starter(self.work, self._start, "Run the sweep", "Progress of the sweep", self._so_far)
        names = sweep_settings(store.scenario)
        several = {"no second setting": NONE, **names}
        self.axes: Final = (
            AxisFields(store, ("Error over", "Values"), names, *FIRST[0]),
            AxisFields(store, ("and over", "Values of the second"), several, *FIRST[1]),
        )
        self.seeds: Final = number_field("Seeds of each", SEEDS, 120)
        self.observers: Final = make_select("Observers", OBSERVERS_OF, QUICK, 340)
        first, second = self.axes
        linked = {"over": first.select, "values": first.values, "second": second.select, "second_values": second.values}
        linked |= {"seeds": self.seeds, "observers": self.observers}
        # a setting of a list is not among the choices until it is asked for
        self.link = LinkedFields(linked, {"over": first.offer, "second": second.offer})
        self.estimate: Final = html()
        self.maps: Final = {target: SweepMap(self.load, **WIDE) for target in SCORED}
        self.lines: Final = {target: ErrorLines() for target in SCORED}
        self.stale: Final = warning(EARLIER)
        self.verdicts: Final = {target: html() for target in SCORED}
        self.boxes: Final = [
            box(target_title(target), self.verdicts[target], self.lines[target].view, self.maps[target]) for target in SCORED
        ]
        self.shades: Final = text(f"{legend_of_shades()} Click a cell to load its scenario in Explore.")
        self._draw_time = 0.0
        for part in (*self.boxes, self.shades):
            part.visible = False
        self.link.watch(self.follow)
        self.work.param.watch(self._take, ["state", "result"])
        for act in (self._compare, self.follow):
            store.param.watch(act, ["scenario", "source"])

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        rows = [line(axis.select, axis.values) for axis in self.axes]
        more = line(self.seeds, self.observers, *self.starter.view())
        sweep = box("Sweep", text(INTRO), *rows, more, self.estimate, self.starter.status, self.stale)
        return boxes(sweep, example("sweep", self.boxes[0]), *self.boxes, self.shades)

    def plan(self) -> Sweep:
        """Return the sweep that the fields describe. Raises SettingError."""
        if self.store.source is not None:
            raise SettingError("A sweep simulates the settings: go back to the simulation first")
        axes = [read_axis(path, values) for path, values in self._axes()]
        seeds = read_number(self.seeds, 1, MOST_SEEDS, whole=True)
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

    def _start(self) -> None:
        self.work.begin(self.plan())

    def load(self, cell: int) -> None:
        """Take the scenario of a cell into the drawer, and show it."""
        results = self.results
        if results is not None and 0 <= cell < len(results.sweep.cells):
            if self.work.attempt(lambda: self.store.run_on(None, results.sweep.scenario(cell))):
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

    @property
    def finding(self) -> list[dict[str, Any]] | None:
        """The errors of all cells, as `wfsobs sweep --csv` writes them."""
        return (self.results and self.results.rows()) or None

    def follow(self, *_: object) -> None:
        """Say what would be run, or why it cannot be."""
        if not self.visible:
            return
        kind = "text"
        try:
            sweep = self.plan()
        except SettingError as error:
            said, kind = name_settings(str(error).removeprefix("--over ").partition("\n")[0]), "failure"
        else:
            counts = " × ".join(str(len(axis.values)) for axis in sweep.axes)
            seeds = f"{sweep.seeds} seed{'s' * (sweep.seeds > 1)}"
            said = f"{counts} scenarios × {seeds} = {sweep.n_runs} runs, about {max(sweep.seconds, 1.0):.0f} s"
        self.starter.start.disabled = kind == "failure"
        self.estimate.html = f'<p class="{kind}" role="status">{escape(said)}</p>'

    def _so_far(self) -> str:
        if (results := self.results) is None:
            return ""
        left = self.work.seconds_left if self.work.state == RUNNING else 0.0
        return f" · {results.n_done} of {results.sweep.n_runs} runs" + (f", about {left:.0f} s left" if left else "")

    def _take(self, *_: object) -> None:
        """Draw what has come, not too often."""
        if self.work.state != RUNNING or monotonic() - self._draw_time >= REDRAW:
            self.redraw()

    def draw(self) -> None:
        """Draw the map, and the errors over one setting."""
        if (results := self.results) is None:
            return
        self._draw_time = monotonic()
        single = len(results.sweep.axes) == 1
        for target in SCORED:
            self.maps[target].draw(map_grid(results, target, self.display))
            self.verdicts[target].html = f'<p class="text">{escape(verdict_of_sweep(results, target, self.display))}</p>'
            if single:
                part = line_part(results, target, self.display)
                self.lines[target].draw(part, self.display.dark, lambda name: look(name).label)
            self.lines[target].view.visible = single
        for part in (*self.boxes, self.shades):
            part.visible = True
        self._compare()

    def _compare(self, *_: Any) -> None:
        """Whether all other settings are still those of the sweep."""
        if self.visible and (results := self.results) is not None:
            self.stale.visible = not results.sweep.has_base(self.store.scenario)
