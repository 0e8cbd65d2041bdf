"""The campaign that the server was started with: how far it is, who is best where, and a way to open a scenario of it."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Any

import numpy as np
import panel as pn
import panel_material_ui as pmui
import param

from wfsobs.app.campaign_work import CampaignTask
from wfsobs.app.controls.status import Status
from wfsobs.app.copies import CAMPAIGN, EXPLORED, CopiedTask
from wfsobs.app.display import Display
from wfsobs.app.jobs.job import FAILED
from wfsobs.app.pages.campaign_views import (
    CampaignView,
    Slice,
    axis_name,
    progress_text,
    standings_html,
    value_names,
    winners_grid,
)
from wfsobs.app.pages.link import LinkedFields, LinkedLater
from wfsobs.app.pages.parts import WIDE, PageActions, box, html, legend, line, text
from wfsobs.app.pages.sweep_settings import line_of
from wfsobs.app.pages.sweep_views import SweepMap
from wfsobs.app.store import Store
from wfsobs.campaign.axes import PlanAxis, plan_axes
from wfsobs.campaign.follow import CampaignState
from wfsobs.campaign.report import name_label
from wfsobs.campaign.selection import condition
from wfsobs.evaluation.rows import target_title
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError

PERIOD = 5000
"""Time between two looks at a campaign that is not finished [ms]."""
NONE = ALL = ""
FIRST_LINES = 5
"""Observers whose lines are shown first: the best ones."""
SHADES = (
    "A full colour: the next is at least 30 % worse. Striped: another does not differ significantly, by a paired t-test over the "
    "seeds of a scenario, or over the scenarios where a square has several, or there are too few results to test. "
    "Click a square to open its scenario in Explore."
)


class CopiedInput(param.Parameterized):
    """What the copies of the page are made of, for those who watch its fields: it has them only once there are results."""

    value = param.Parameter(EXPLORED)


class CampaignPage(PageActions):
    """The page. It reads; only the command line of the server names the folder."""

    def __init__(self, store: Store, display: Display, explore: Callable[[], None]):
        """Make the page. explore : turns to the page that shows a scenario."""
        self.store, self.display, self._explore = store, display, explore
        self.work = CampaignTask(store.session)
        self.status = Status(label="Progress of the campaign", sizing_mode="stretch_width", margin=(4, 0))
        self.failure = html()
        self.room = pn.Column(**WIDE, stylesheets=[":host { gap: 10px; }"])
        self.table, self.legend = html(), html()
        self.map = SweepMap(self.load, grid={}, **WIDE)
        self.pane = pn.Column(**WIDE)
        self.slice: Slice | None = None
        self.axes: dict[str, PlanAxis] = {}
        self.filters: dict[str, Any] = {}
        self.link = self._fields = LinkedLater()
        self.copy_input = CopiedInput()
        self.inputs = [self.copy_input]
        self.visible, self._targets = False, list[str]()
        self.work.param.watch(self._take, ["state", "result"])
        self.work.param.watch(self._say, ["state", "progress", "place", "message"])
        display.param.watch(lambda _: self.draw(), ["mode", "unit", "dark"])
        self._callback = pn.state.add_periodic_callback(self.tick, PERIOD, start=False) if pn.state.curdoc else None

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        return pn.Column(box("Campaign", self.status, self.failure), self.room, **WIDE, stylesheets=[":host { gap: 10px; }"])

    def show(self, visible: bool) -> None:
        """Look at the folder, and again and again while the page is shown and the campaign goes on."""
        self.visible = visible
        if visible:
            self.work.look()
            self.draw()
        self._pace()

    @property
    def task(self) -> CopiedTask:
        """To print the table as it is shown; its folder is named as a loaded record is: without where it lies."""
        folder, state = self.work.folder, self.work.campaign
        if folder is None:
            return EXPLORED
        target = [self.target.value] if state is not None and self._targets else []
        mode = [self._mode(state, *target)] if state is not None and target else []
        only = [condition(self.axes[path], i) for path, i in self._choices().items()]
        return CopiedTask(CAMPAIGN, {"folder": folder.folder.resolve().name, "target": target, "mode": mode, "only": only})

    def tick(self) -> None:
        """Look whether there is something new."""
        self.work.look()

    def _pace(self) -> None:
        if self._callback is not None:
            self.store.session.post(self._set_pace)  # once the page stands: what comes before that does not reach it

    def _set_pace(self) -> None:
        state = self.work.campaign
        wanted = self.visible and (state is None or state.n_done < state.plan.n_runs)
        if self._callback is not None and wanted != self._callback.running:
            (self._callback.start if wanted else self._callback.stop)()

    def load(self, cell: int) -> None:
        """Open the scenario of a cell in Explore, with the first seed of the campaign."""
        state = self.work.campaign
        if state is None or not 0 <= cell < len(state.plan.cells):
            return
        try:
            self.store.run_on(None, state.plan.cells[cell].scenario().replace({"run.seed": state.plan.seeds.start}))
        except SettingError as error:
            self._refuse(line_of(error))
        else:
            self._explore()

    def _take(self, *_: object) -> None:
        if self.work.state == FAILED:
            self._refuse(line_of(SettingError(self.work.message)))
        state = self.work.campaign
        if state is not None:
            self._make(state)
            self.draw()
            self._pace()

    def _refuse(self, why: str) -> None:
        self.failure.object = f'<p class="failure" role="status">{escape(why)}</p>'

    def _say(self, *_: object) -> None:
        """Describe how far the campaign is."""
        state = self.work.campaign
        if state is None:
            self.status.param.update(text=self.work.line("Reading"), progress=self.work.progress)
            return
        self.status.param.update(text=progress_text(state), progress=state.n_done / state.plan.n_runs)

    def _make(self, state: CampaignState) -> None:
        """Make the fields when the first results are there, and anew where there are errors of something else."""
        targets = list(dict.fromkeys(target for target, _ in state.errors))
        if targets == self._targets:
            return
        self._targets = targets
        base = state.plan.cells[0].scenario()
        self.base: Scenario = base
        self.axes = {axis.path: axis for axis in plan_axes(state.plan)}
        names = {axis_name(axis, base): path for path, axis in self.axes.items()}
        style = {"size": "small", "margin": 0, "width": 300}
        paths = [*self.axes]
        self.target = pmui.Select(label="Errors of", options={target_title(t): t for t in targets}, value=targets[0], **style)
        self.across = pmui.Select(label="Across", options=names, value=paths[0] if paths else None, **style)
        self.down = pmui.Select(
            label="Down", options={"no second condition": NONE, **names}, value=paths[1] if len(paths) > 1 else NONE, **style
        )
        self.filters = {
            path: pmui.Select(
                label=f"Only {axis_name(axis, base)}",
                options={"all": ALL, **{name: name for name in value_names(axis)}},
                value=ALL,
                **style,
            )
            for path, axis in self.axes.items()
        }
        ranked = [s.name for s in next(iter(state.errors.values())).standings(range(len(state.plan.cells)))]
        known = [*state.plan.observers, *state.plan.controllers]
        best = [name for name in ranked if name in known][:FIRST_LINES]
        bounds = [name for name in BOUNDS if any(name in errors.names for errors in state.errors.values())]
        self.lines = pmui.MultiChoice(
            label="Lines", options={name_label(name): name for name in (*known, *bounds)}, value=[*best, *bounds], **WIDE
        )
        only = {f"only.{path}": field for path, field in self.filters.items()}
        linked = {"target": self.target, "across": self.across, "down": self.down, **only, "lines": self.lines}
        if refused := self._fields.make(LinkedFields(**linked)):
            self._refuse(f"Not used from the link: {', '.join(refused)}")
        for field in linked.values():
            field.param.watch(lambda _: self.draw(), "value")
        fields = [line(self.target, self.across, self.down), line(*self.filters.values())] if self.axes else [line(self.target)]
        self.room[:] = [box("Conditions", *fields), box("Observers", self.table)]
        if self.axes:
            self.room.extend(
                [
                    box("Best observers", self.map, text(SHADES)),
                    box("Errors over one condition", self.lines, self.legend, self.pane),
                ]
            )

    def view_of(self, state: CampaignState) -> CampaignView | None:
        """Return what is shown by the fields and the mode of the page; None where there is nothing."""
        target = self.target.value
        cells = np.arange(len(state.plan.cells))
        for path, i in self._choices().items():
            cells = cells[self.axes[path].of_cell[cells] == i]
        if not len(cells):
            return None
        mode = self._mode(state, target)
        return CampaignView(state, target, mode, state.errors[target, mode], cells, self.base)

    def _choices(self) -> dict[str, int]:
        """Return the conditions that the fields leave one value of: path -> position of the value."""
        chosen = {path: field.value for path, field in self.filters.items() if field.value != ALL}
        return {path: value_names(self.axes[path]).index(value) for path, value in chosen.items()}

    def _mode(self, state: CampaignState, target: str) -> str:
        """Return the mode of the page, or where there is none of it the first."""
        modes = [mode for known, mode in state.errors if known == target]
        return self.display.mode if self.display.mode in modes else modes[0]

    def draw(self) -> None:
        """Send the picture; only aggregates leave the server."""
        state = self.work.campaign
        if not self.visible or state is None or not self._targets:
            return
        with pn.io.hold():
            view, self.copy_input.value = self.view_of(state), self.task
            for part in self.room.objects[2:]:
                part.visible = view is not None
            if view is None:  # the fields stay, to choose something else
                self.table.object = "<p>No scenario has all of these values.</p>"
                return
            self.table.object = standings_html(view, self.display)
            if not self.axes:
                return
            x = self.axes[self.across.value]
            y = self.axes[self.down.value] if self.down.value not in (NONE, self.across.value) else None
            self.map.grid = winners_grid(view, x, y, self.display)
            self._draw_slice(view, x)

    def _draw_slice(self, view: CampaignView, x: PlanAxis) -> None:
        if self.slice is None or self.slice.axis is not x:
            self.slice = Slice(x, self.base)
            self.pane[:] = [pn.pane.Bokeh(self.slice.figure, **WIDE)]
        self.slice.draw(view, self.lines.value, self.display)
        drawn = [name for name in self.lines.value if name in view.errors.names]
        self.legend.object = legend({name: name_label(name) for name in drawn}, self.display.dark)
