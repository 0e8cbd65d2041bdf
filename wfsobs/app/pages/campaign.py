"""The campaign that the server was started with: how far it is, who is best where, and a way to open a scenario of it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, Final

import numpy as np
import panel as pn
import panel_material_ui as pmui

from wfsobs.app.controls.panel import Status
from wfsobs.app.display import Display
from wfsobs.app.jobs import BATCH, FAILED, RUNNING, Job, Work
from wfsobs.app.pages.parts import WIDE, LinkedFields, Page, box, boxes, html, line, render_part, text
from wfsobs.app.pages.sweep import ErrorLines, SweepMap
from wfsobs.app.pages.sweep_views import DECIDED, LEFT_OUT, OPEN, WAITING, map_square, verdict_text
from wfsobs.app.render import NOTHING, number
from wfsobs.app.service import BackgroundTask
from wfsobs.app.share import CAMPAIGN, CopiedTask
from wfsobs.app.store import Store
from wfsobs.app.style import look, make_select
from wfsobs.campaign.compare import CampaignErrors
from wfsobs.campaign.follow import UNTESTED, CampaignState, progress_text, standings
from wfsobs.campaign.plan import SCENARIO, PlanAxis, condition, plan_axes
from wfsobs.campaign.report import name_label
from wfsobs.evaluation.result import target_title
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.scenario import Scenario
from wfsobs.scenario.names import name_settings, setting_label, value_of
from wfsobs.settings.values import SettingError
from wfsobs.typing import Array


@dataclass(frozen=True)
class CampaignView:
    """What of a campaign is shown: errors of one target and mode, in some of the scenarios."""

    state: CampaignState
    target: str
    mode: str
    errors: CampaignErrors
    cells: Array
    base: Scenario

    def scale(self, display: Display) -> float:
        """Return how many units of the display one nanometre is."""
        return 1e-3 * display.scale(self.base)


def axis_name(axis: PlanAxis, base: Scenario) -> str:
    """Name a condition, with its unit."""
    return "Scenario" if axis.path == SCENARIO else setting_label(base, axis.path)


def value_names(axis: PlanAxis) -> list[str]:
    """Write the values of a condition."""
    if axis.is_binned:
        return [f"{low:.3g} – {high:.3g}" if low < high else f"{low:.3g}" for low, high in axis.values]
    return [NOTHING if value is None else value_of(value) for value in axis.values]


def standings_html(view: CampaignView, display: Display) -> str:
    """Write the table of all observers over the scenarios shown, best first."""
    shown = standings(view.state, view.target, view.mode, view.cells)
    lost = {name for name, n in view.state.failures.items() if n[view.cells].any()} - {s.name for s in shown}
    return render_part(
        "standings",
        display,
        shown=shown,
        lost=[name_label(name) for name in sorted(lost)],
        scale=view.scale(display),
        paired_over="scenarios" if len(view.errors.known_cells(view.cells)) > 1 else "seeds",
        level=view.errors.level,
        untested=UNTESTED,
        isfinite=np.isfinite,
        label=name_label,
    )


def winners_grid(view: CampaignView, x: PlanAxis, y: PlanAxis | None, display: Display) -> dict[str, Any]:
    """Describe the map of winners."""
    columns, rows = value_names(x), value_names(y) if y else [""]
    across, down = axis_name(x, view.base), axis_name(y, view.base) if y else ""  # once: it looks through all settings
    places = list(zip(x.of_cell.tolist(), y.of_cell.tolist() if y else [0] * len(x.of_cell), strict=True))
    of: dict[tuple[int, int], list[int]] = {place: [] for place in places}  # the plan has no scenario of the others
    for cell in view.cells.tolist():
        of[places[cell]].append(cell)
    key: dict[str, str] = {}
    cells = [
        [
            _square(view, of.get((i, j)), f"{across} {columns[i]}" + (f", {down} {rows[j]}" if y else ""), display, key)
            for i in range(len(columns))
        ]
        for j in reversed(range(len(rows)))
    ]
    return {
        "title": f"Best of the campaign, {view.target}, {view.mode}",
        "across": across,
        "down": down,
        "columns": columns,
        "rows": rows[::-1],
        "cells": cells,
        "key": [[colour, name] for name, colour in key.items()],
    }


def _square(view: CampaignView, cells: list[int] | None, where: str, display: Display, key: dict[str, str]) -> dict[str, Any]:
    """Describe one square: the scenario that it opens, its colour and what it says."""
    errors = view.errors
    verdict = None if not cells else errors.winners.get(cells[0]) if len(cells) == 1 else errors.verdict(cells)
    if not cells or verdict is None:
        said = "no such scenario" if cells is None else "no result yet" if cells else "left out by the fields Only …"
        return map_square(cells[0] if cells else -1, WAITING if cells else LEFT_OUT, f"{where}: {said}", "", display.dark)
    best, decided = verdict.best, verdict.is_decided
    margin = verdict.margin if np.isfinite(verdict.margin) else None
    text = number(best.rms * view.scale(display))
    said = f"{where}: {name_label(best.name)} {text} {display.unit_label}"
    said += verdict_text(margin, map(name_label, verdict.ties), decided or margin is None, "results")
    several = f"{len(cells)} scenarios, opens the first" if len(cells) > 1 else f"{int(errors.count[cells[0]].max())} seeds"
    key[name_label(best.name)] = look(best.name).colour(display.dark)
    return map_square(cells[0], DECIDED if decided else OPEN, f"{said}; {several}", text, display.dark, best.name, margin)


def slice_part(view: CampaignView, axis: PlanAxis, names: Sequence[str], display: Display) -> dict[str, Any]:
    """Describe the errors over one condition as `SweepLines` draws them: over several scenarios of a value the geometric mean."""
    x, bins, errors = axis.positions, axis.of_cell[view.cells], {}
    for name in names:
        if name not in view.errors.names:
            continue
        values = view.errors.rms[view.cells, view.errors.names.index(name)]
        good = np.isfinite(values) & (values > 0)
        count, total = (np.bincount(bins[good], of, minlength=len(x)) for of in (None, np.log(values[good])))
        known = count > 0
        y = np.full(len(x), np.nan)
        y[known] = view.scale(display) * np.exp(total[known] / count[known])
        errors[name] = y, np.full(len(x), np.nan), np.full(len(x), np.nan)
    across = axis_name(axis, view.base)
    return {
        "title": f"Error over {across}, {view.target}, {view.mode}",
        "across": across,
        "up": f"rms error, {view.mode} [{display.unit_label}]",
        "values": x,
        "texts": None if axis.is_numeric else value_names(axis),
        "errors": errors,
    }


PERIOD = 5.0
"""Time between two looks at a campaign that is not finished [s]."""
NONE = ALL = ""
FIRST_LINES = 5
"""Observers, and controllers, whose lines are shown first: the best ones of every error."""
SHADES = (
    "A full colour: the next is at least 30 % worse. Striped: another does not differ significantly, by a paired t-test over the "
    "seeds of a scenario, or over the scenarios where a square has several, or there are too few results to test. "
    "Click a square to open its scenario in Explore."
)


class CampaignPage(Page):
    """The page. It reads; only the command line of the server names the folder."""

    def __init__(self, store: Store, display: Display, explore: Callable[[], None]):
        """Make the page. explore : turns to the page that shows a scenario."""
        super().__init__(store, display)
        folder = store.session.service.campaign
        assert folder is not None  # else there is no such page
        self.folder: Final = folder
        self._explore = explore
        self.work: Final = BackgroundTask(store.session)
        self.status: Final = Status(label="Progress of the campaign", sizing_mode="stretch_width", margin=(4, 0))
        self.failure: Final = html()
        self.room: Final = boxes()
        self.table: Final = html()
        self.map: Final = SweepMap(self.load, **WIDE)
        self.slice: Final = ErrorLines()
        self.axes: dict[str, PlanAxis] = {}
        self.filters: dict[str, Any] = {}
        self.link = self._fields = LinkedFields(None)
        self._targets = list[str]()
        self.work.param.watch(self._take, ["state", "result"])
        self.work.param.watch(self._say, ["state", "progress", "place", "message"])
        self.repeat(self.tick, PERIOD)

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        return boxes(box("Campaign", self.status, self.failure), self.room)

    def show(self, visible: bool) -> None:
        """Look at the folder, and again and again while the page is shown and the campaign goes on."""
        super().show(visible)
        if visible:
            self.tick()
        self.pace()

    @property
    def task(self) -> CopiedTask:
        """To print the table as it is shown; its folder is named as a loaded record is: without where it lies."""
        state, name = self.state, self.folder.folder.resolve().name
        target, mode = ([self.target.value], [self._mode(state)]) if state is not None and self._targets else ([], [])
        only = [condition(self.axes[path], i) for path, i in self._choices().items()]
        return CopiedTask(CAMPAIGN, {"folder": name, "target": target, "mode": mode, "only": only})

    def tick(self) -> None:
        """Read what is new, unless that is under way."""
        if self.work.state != RUNNING:
            work: Work = lambda watch, _tell: self.folder.read(watch)  # noqa: E731
            self.work.start(Job("campaign", work, priority=BATCH, refusal=SettingError, quiet=True))

    @property
    def state(self) -> CampaignState | None:
        """What is known by the last look: the same object while nothing is new."""
        return self.work.result

    @property
    def goes_on(self) -> bool:
        """Whether there may be something new to see."""
        state = self.state
        return self.visible and (state is None or state.n_done < state.plan.n_runs)

    def load(self, cell: int) -> None:
        """Open the scenario of a cell in Explore, with the first seed of the campaign."""
        state = self.state
        if state is not None and 0 <= cell < len(state.plan.cells):
            seed = {"run.seed": state.plan.seeds.start}
            if self.work.attempt(lambda: self.store.run_on(None, state.plan.cells[cell].scenario().replace(seed))):
                self._explore()

    def _take(self, *_: object) -> None:
        if self.work.state == FAILED:
            elsewhere = f"{self.folder.folder.parent}{os.sep}"  # no business of a visitor
            self._refuse(name_settings(self.work.message.replace(elsewhere, "")))
        state = self.state
        if state is not None:
            self._make(state)
            self.redraw()
            self.pace()

    def _refuse(self, why: str) -> None:
        self.failure.html = f'<p class="failure" role="status">{escape(why)}</p>'

    def _say(self, *_: object) -> None:
        """Describe how far the campaign is."""
        state, work = self.state, self.work
        if state is None:
            self.status.param.update(text=work.line("Reading"), progress=work.progress)
        else:
            self.status.param.update(text=progress_text(state), progress=state.n_done / state.plan.n_runs)

    def _make(self, state: CampaignState) -> None:
        """Make the fields when the first results are there, and anew where there are errors of something else."""
        targets = list(dict.fromkeys(target for target, _ in state.errors))
        if targets == self._targets:
            return
        self._targets = targets
        self.base: Scenario = state.plan.cells[0].scenario()
        self.axes = {axis.path: axis for axis in plan_axes(state.plan)}
        names = {axis_name(axis, self.base): path for path, axis in self.axes.items()}
        first, second, *_ = [*self.axes, None, None]
        self.target = make_select("Errors of", {target_title(t): t for t in targets}, targets[0], 300)
        self.across = make_select("Across", names, first, 300)
        self.down = make_select("Down", {"no second condition": NONE, **names}, second or NONE, 300)
        self.filters = {
            path: make_select(f"Only {name}", {"all": ALL} | {of: of for of in value_names(self.axes[path])}, ALL, 300)
            for name, path in names.items()
        }
        known = [*state.plan.observers, *state.plan.controllers]
        ranked = ([s.name for s in errors.standings(range(len(state.plan.cells)))] for errors in state.errors.values())
        best = dict.fromkeys(name for of in ranked for name in [name for name in of if name in known][:FIRST_LINES])
        bounds = [name for name in BOUNDS if any(name in errors.names for errors in state.errors.values())]
        self.lines = pmui.MultiChoice(
            label="Lines", options={name_label(name): name for name in (*known, *bounds)}, value=[*best, *bounds], **WIDE
        )
        linked = {"target": self.target, "across": self.across, "down": self.down}
        linked |= {f"only.{path}": field for path, field in self.filters.items()} | {"lines": self.lines}
        if refused := self._fields.make(linked):
            self._refuse(f"Not used from the link: {', '.join(refused)}")
        for field in linked.values():
            field.param.watch(self.redraw, "value")
        fields = [line(self.target, self.across, self.down), line(*self.filters.values())] if self.axes else [line(self.target)]
        self.room[:] = [box("Conditions", *fields), box("Observers", self.table)]
        if self.axes:
            self.room.append(box("Best observers", self.map, text(SHADES)))
            self.room.append(box("Errors over one condition", self.lines, self.slice.view))

    def view_of(self, state: CampaignState) -> CampaignView | None:
        """Return what is shown by the fields and the mode of the page; None where there is nothing."""
        cells = np.arange(len(state.plan.cells))
        for path, i in self._choices().items():
            cells = cells[self.axes[path].of_cell[cells] == i]
        target, mode = self.target.value, self._mode(state)
        return CampaignView(state, target, mode, state.errors[target, mode], cells, self.base) if len(cells) else None

    def _choices(self) -> dict[str, int]:
        """Return the conditions that the fields leave one value of: path -> position of the value."""
        chosen = {path: field.value for path, field in self.filters.items() if field.value != ALL}
        return {path: value_names(self.axes[path]).index(value) for path, value in chosen.items()}

    def _mode(self, state: CampaignState) -> str:
        """Return the mode of the page, or where there is none of it the first."""
        modes = [mode for target, mode in state.errors if target == self.target.value]
        return self.display.mode if self.display.mode in modes else modes[0]

    def draw(self) -> None:
        """Send the picture; only aggregates leave the server."""
        state = self.state
        if state is None or not self._targets:
            return
        view = self.view_of(state)
        for part in self.room.objects[2:]:
            part.visible = view is not None
        if view is None:  # the fields stay, to choose something else
            self.table.html = "<p>No scenario has all of these values.</p>"
            return
        self.table.html = standings_html(view, self.display)
        if not self.axes:
            return
        x = self.axes[self.across.value]
        y = self.axes[self.down.value] if self.down.value not in (NONE, self.across.value) else None
        self.map.draw(winners_grid(view, x, y, self.display))
        self.slice.draw(slice_part(view, x, self.lines.value, self.display), self.display.dark, name_label)
