"""The error budget of the mode shown: a stacked bar per observer, computed and drawn once it is opened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from math import sqrt
from typing import Any

import panel as pn
import panel_material_ui as pmui
from bokeh.models import ColumnDataSource, FactorRange, HoverTool, Span
from bokeh.plotting import figure

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.jobs import DONE, FAILED, RUNNING, BackgroundTask, Job
from wfsobs.app.pages.parts import WIDE, html
from wfsobs.app.store import Store
from wfsobs.app.style import BOUND_MARKS, TERM_COLOURS
from wfsobs.app.views.learners_budget import LearnersBudget
from wfsobs.app.views.plots import call
from wfsobs.app.work import RunResults
from wfsobs.cost import run_seconds
from wfsobs.evaluation.budget import ONLY_NAMED, TERMS, Budget, error_budget
from wfsobs.evaluation.rows import row_label
from wfsobs.observers.base import TARGETS

COLUMNS = ("observer", "left", "right", "colour", "term", "part", "share", "rms")

ROW, FRAME = 26, 70
"""Height of a bar with its gap, and of the axis and margins [px]."""


class BudgetView:
    """A button that opens the figures, and the figures."""

    def __init__(self, store: Store, display: Display):
        self.store, self.run, self.display = store, store.run, display
        self.task = BackgroundTask(store.session)
        self.open = pmui.Checkbox(label="Show error budget", value=False, size="small", margin=(0, 0, 4, 0))
        self.line, self.room = html(), pn.Column(**WIDE)
        self.learners = LearnersBudget(store, self._draw)
        self.bars: dict[str, Bars] = {}
        self._of: tuple[RunResults, str] | None = None
        self.open.param.watch(self._follow, "value")
        self.run.param.watch(self._follow, ["state", "result"])
        display.param.watch(self._follow, "mode")
        display.param.watch(self._draw, "unit")
        self.task.param.watch(self._draw, "result")
        self.task.param.watch(self._say, ["state", "message"])

    def view(self) -> list[Any]:
        """Return the contents of the box."""
        return [self.open, self.line, self.learners.view(), self.room]

    def _follow(self, *_: object) -> None:
        """Compute the budget of what is shown, while it is to be seen and complete."""
        results = self.run.result
        self.room.visible = self.open.value
        if not self.open.value or results is None or self.run.state != DONE:
            self.task.close()
            self._of = None
        elif results.is_recorded:
            self._of = None
            self.task.refuse("Only for simulations of the settings: of other records neither noise nor truth is known.")
        elif self._of is None or self._of[0] is not results or self._of[1] != self.display.mode:
            self._of = results, self.display.mode
            self.task.start(budget_job(results, self.display.mode))
        self._say()

    def _say(self, *_: object) -> None:
        task = self.task
        busy = task.state == RUNNING and self._of is not None
        said = "Computing …" if busy else task.message if task.state == FAILED else ""
        if self.open.value and not busy and self.run.state == RUNNING:
            said = "After the run …"
        if self._of is not None and task.state == DONE:
            self.learners.offer(*self._of, unseen(task.result or ()))
        else:
            self.learners.rest()
        self.line.object = f'<p class="text">{escape(said)}</p>' if said and self.open.value else ""

    def _draw(self, *_: object) -> None:
        if self.task.result is None or self._of is None:
            return
        results, mode = self._of
        found = [*self.task.result, *self.learners.budgets(results, mode)]
        with pn.io.hold():
            if not self.bars:
                self.bars = {target: Bars(target) for target in TARGETS}
                self.room[:] = [term_legend(), *(pn.pane.Bokeh(bars.figure, **WIDE) for bars in self.bars.values())]
            for target, bars in self.bars.items():
                scale = per_micrometre(self.display.unit, results.scenario.telescope.diameter)
                of = [s for s in results.result.scores if s.target == target and s.mode == mode]
                bounds = {s.observer: s.rms**2 for s in of if s.observer in BOUND_MARKS}
                shown = [b for b in found if b.target == target and b.terms]
                bars.draw(shown, bounds, mode, scale, self.display.unit_label)


def budget_job(results: RunResults, mode: str) -> Job:
    """Make the job that computes the budgets of one mode."""
    return Job(
        "budget",
        lambda watch, _tell: error_budget(results.result, mode=mode, watch=watch),
        cost=4.0 * run_seconds(results.scenario),
    )


def term_legend() -> pn.pane.HTML:
    """Say which colour is which term."""
    marks = "".join(
        f'<span class="mark" style="padding-left:6px; border-left:10px solid {TERM_COLOURS[name]}">{escape(label)}</span>'
        for name, label in TERMS.items()
    )
    bounds = "".join(
        f'<span class="mark" style="padding-left:6px; border-left:2px {dash} {colour}">{label}</span>'
        for colour, dash, label in BOUND_MARKS.values()
    )
    return html(f'<div class="caption legend">{marks}{bounds}</div>')


class Bars:
    """The bars of one target: positive terms to the right of zero, one after the other, negative ones to the left."""

    def __init__(self, target: str):
        self.target = target
        self.observers = FactorRange()
        self.source = ColumnDataSource(
            {name: [] for name in ("observer", "left", "right", "colour", "term", "part", "share", "rms")}
        )
        self.figure: figure = figure(
            y_range=self.observers, height=200, sizing_mode="stretch_width", min_width=240, tools="", toolbar_location=None
        )
        self.figure.hbar(y="observer", left="left", right="right", height=0.7, color="colour", source=self.source)
        tips = [("", "@observer"), ("", "@term"), ("", "@part"), ("", "@share of the mean square error"), ("", "@rms")]
        self.figure.add_tools(HoverTool(tooltips=tips))
        self.bounds = {
            name: Span(dimension="height", line_color=colour, line_dash=dash, line_width=2, visible=False)
            for name, (colour, dash, _) in BOUND_MARKS.items()
        }
        for mark in self.bounds.values():
            self.figure.add_layout(mark)
        self.figure.ygrid.visible = False
        self.figure.outline_line_color = None

    def draw(self, budgets: Sequence[Budget], bounds: Mapping[str, float], mode: str, scale: float, unit: str) -> None:
        """Draw the budgets, the smallest error on top; bounds: mean squares [um^2]; scale: from um to the unit."""
        ranked = sorted(budgets, key=lambda b: b.total)
        name = f"{self.target.capitalize()}, {mode}: mean square error [{unit}²]"
        call(self.figure, f"Error budget, {self.target}")
        self.figure.xaxis.axis_label = name
        self.observers.factors = [bar_label(b, scale, unit) for b in reversed(ranked)]
        self.figure.height = FRAME + ROW * max(len(ranked), 1)
        self.source.data = bar_data(ranked, scale, unit)  # type: ignore[assignment]
        for name, mark in self.bounds.items():
            mark.update(location=bounds.get(name, 0.0) * scale**2, visible=name in bounds)


def unseen(budgets: Sequence[Budget]) -> list[str]:
    """Return the observers that have no budget unless they are named."""
    return [*dict.fromkeys(b.observer for b in budgets if b.reason.endswith(ONLY_NAMED))]


def bar_label(budget: Budget, scale: float, unit: str) -> str:
    """Write an observer with its error."""
    return f"{row_label(budget.observer)}, {sqrt(budget.total) * scale:.3g} {unit}"


def bar_data(budgets: Sequence[Budget], scale: float, unit: str) -> dict[str, list[Any]]:
    """Return the pieces of the bars as columns."""
    rows: list[tuple[Any, ...]] = []
    for it in budgets:
        ends = {True: 0.0, False: 0.0}
        for name in TERMS:
            part = it.terms[name] * scale**2
            start = ends[part >= 0]
            ends[part >= 0] = start + part
            rms = f"rms {sqrt(part):.3g} {unit}" if part >= 0 else "less than none: the others are correlated with it"
            share = f"{100.0 * it.terms[name] / it.total:.0f} %"
            rows.append(
                (
                    bar_label(it, scale, unit),
                    start,
                    start + part,
                    TERM_COLOURS[name],
                    TERMS[name],
                    f"{part:.3g} {unit}²",
                    share,
                    rms,
                )
            )
    return {name: [row[i] for row in rows] for i, name in enumerate(COLUMNS)}
