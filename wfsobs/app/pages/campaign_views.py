"""A campaign in a table of its observers, a map of winners over two conditions, and the errors over one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, FixedTicker, Range1d
from bokeh.plotting import figure

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.numerals import NOTHING, number
from wfsobs.app.pages.sweep_views import DECIDED, FULL_MARGIN, GROUNDS, LEFT_OUT, OPEN, WAITING, axis_title, ink_on, mix
from wfsobs.app.render import Row, table
from wfsobs.app.report.text import value_of
from wfsobs.app.style import look, swatch
from wfsobs.app.views.plots import add_line, call, new_figure
from wfsobs.campaign.axes import SCENARIO, PlanAxis
from wfsobs.campaign.errors import CampaignErrors
from wfsobs.campaign.follow import CampaignState
from wfsobs.campaign.report import name_label
from wfsobs.campaign.standings import UNTESTED, TogetherRow, standings
from wfsobs.scenario import Scenario
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
        return 1e-3 * per_micrometre(display.unit, self.base.telescope.diameter)


def progress_text(state: CampaignState) -> str:
    """Say how far a campaign is, and when it will be done or that nothing comes any more."""
    plan, silence, left = state.plan, state.silence, state.seconds_left
    said = f"{plan.name}: {state.n_done} of {plan.n_runs} runs, {len(plan.cells)} scenarios, {state.n_rows} rows"
    if state.n_done == plan.n_runs:
        return f"{said}, finished"
    if silence:
        ended = "ended, stopped" if plan.stop else "stopped"  # it may need no more seeds
        return f"{said}; no new batch for {_span(silence)}: {ended}, or slower than before"
    return f"{said}, about {_span(left)} left" if np.isfinite(left) else said


def _span(seconds: float) -> str:
    """Write a time for people.

    >>> _span(40), _span(600), _span(9000), _span(1e6)
    ('40 s', '10 min', '2.5 h', '12 days')
    """
    if seconds < 5400:
        return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 48 * 3600 else f"{seconds / 86400:.0f} days"


def axis_name(axis: PlanAxis, base: Scenario) -> str:
    """Name a condition, with its unit."""
    return "Scenario" if axis.path == SCENARIO else axis_title(base, axis.path)


def value_names(axis: PlanAxis) -> list[str]:
    """Write the values of a condition."""
    if axis.is_binned:
        return [f"{low:.3g} – {high:.3g}" if low < high else f"{low:.3g}" for low, high in axis.values]
    return [NOTHING if value is None else value_of(value) for value in axis.values]


def standings_html(view: CampaignView, display: Display) -> str:
    """Write the table of all observers over the scenarios shown, best first."""
    scale, several = view.scale(display), len(view.errors.known_cells(view.cells)) > 1
    columns = {
        "Observer": "",
        f"Error [{display.unit_label}]": "rms over the seeds; over scenarios the geometric mean",
        "error / bound": "geometric mean over the scenarios; the smallest bound of each",
        "95 %": "of error / bound, over the scenarios",
        "Above the best [%]": f"paired over the {'scenarios' if several else 'seeds'}, with its interval of 95 %",
        "Rank": f"best: all others differ significantly; tied: no significant difference from the best; {NOTHING}: not tested",
        "Wins": "scenarios with the smallest error, and how many of them are significant",
        "Records": "",
        "Failed": "runs without an estimate",
    }
    rows = []
    for s in standings(view.state, view.target, view.mode, view.cells):
        cells_of = [
            number(scale * s.rms_nm),
            _number(s.over_bound),
            _interval(s.over_bound_low, s.over_bound_high),
            _above(s),
            NOTHING if s.rank == UNTESTED else s.rank,
            NOTHING if s.wins is None else f"{s.wins} ({s.decided_wins})",
            str(s.records),
            NOTHING if s.failures is None else str(s.failures),
        ]
        rows.append(Row(swatch(s.name, display.dark) + name_label(s.name), cells_of, {"name": s.name}))
    return str(table("Observers of the campaign", columns, [("", rows)]))


def _number(x: float) -> str:
    return number(float(x)) if np.isfinite(x) else NOTHING


def _interval(low: float, high: float) -> str:
    return f"{number(float(low))} – {number(float(high))}" if np.isfinite(low) and np.isfinite(high) else NOTHING


def _above(s: TogetherRow) -> str:
    if np.isnan(s.above):
        return NOTHING
    around = "" if np.isnan(s.above_low) else f" ({number(100 * s.above_low, 2)} to {number(100 * s.above_high, 2)})"
    return number(100 * s.above, 2) + around


def winners_grid(view: CampaignView, x: PlanAxis, y: PlanAxis | None, display: Display) -> dict[str, Any]:
    """Describe the map of winners."""
    columns, rows = value_names(x), value_names(y) if y else [""]
    across, down = axis_name(x, view.base), axis_name(y, view.base) if y else ""  # once: it looks through all settings
    of = np.full((len(columns), len(rows)), None, dtype=object)  # None: the plan has no such scenario
    shown = np.isin(np.arange(len(x.of_cell)), view.cells)
    for cell in range(len(x.of_cell)):
        i, j = int(x.of_cell[cell]), int(y.of_cell[cell]) if y else 0
        of[i, j] = of[i, j] or []
        if shown[cell]:
            of[i, j].append(cell)
    key: dict[str, str] = {}
    cells = [
        [
            _square(view, of[i, j], f"{across} {columns[i]}" + (f", {down} {rows[j]}" if y else ""), display, key)
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
    ground = GROUNDS[display.dark]
    errors = view.errors
    verdict = None if not cells else errors.winners.get(cells[0]) if len(cells) == 1 else errors.verdict(cells)
    if not cells or verdict is None:
        said = "no such scenario" if cells is None else "no result yet" if cells else "left out by the fields Only …"
        square = {
            "index": cells[0] if cells else -1,
            "state": WAITING if cells else LEFT_OUT,
            "text": "",
            "title": f"{where}: {said}",
        }
        return {**square, "ground": ground, "stripe": ground, "ink": ""}
    best, decided = verdict.best, verdict.is_decided
    text = number(best.rms * view.scale(display))
    said = f"{where}: {name_label(best.name)} {text} {display.unit_label}"
    if np.isfinite(verdict.margin):
        said += f", {number(100 * verdict.margin, 2)} % before the next"
    if verdict.ties:
        said += f"; tied with {', '.join(map(name_label, verdict.ties))}"
    elif not decided and np.isfinite(verdict.margin):
        said += "; too few results to tell"
    if len(cells) > 1:
        said += f"; {len(cells)} scenarios, opens the first"
    else:
        said += f"; {int(errors.count[cells[0]].max())} seeds"
    colour = look(best.name).colour(display.dark)
    key[name_label(best.name)] = colour
    margin = verdict.margin if np.isfinite(verdict.margin) else 0.0
    fill = mix(colour, ground, 0.35 + 0.65 * min(1.0, max(0.0, margin) / FULL_MARGIN) if decided else 0.12)
    return {
        "index": cells[0],
        "state": DECIDED if decided else OPEN,
        "text": text,
        "title": said,
        "ground": fill,
        "stripe": mix(colour, ground, 0.28),
        "ink": ink_on(fill),
    }


class Slice:
    """Errors over one condition: a line per observer and bound; made for a condition."""

    def __init__(self, axis: PlanAxis, base: Scenario):
        self.axis, x = axis, axis.positions
        room = 0.03 * float(np.ptp(x))
        self.figure: figure = new_figure(
            x_range=Range1d(start=float(x.min()) - room, end=float(x.max()) + room), y_range=Range1d(start=0.0, end=1.0)
        )
        self.figure.xaxis.axis_label = axis_name(axis, base)
        if not axis.is_numeric:
            self.figure.xaxis.ticker = FixedTicker(ticks=x.tolist())
            self.figure.xaxis.major_label_overrides = dict(zip(x.tolist(), value_names(axis), strict=True))
        self.sources: dict[str, ColumnDataSource] = {}
        self._glyphs: dict[str, Any] = {}

    def draw(self, view: CampaignView, names: Sequence[str], display: Display) -> None:
        """Send the errors of some names: over several scenarios of a value the geometric mean."""
        rms, x = view.errors.rms, self.axis.positions
        bins = self.axis.of_cell[view.cells]
        highest = [0.0]
        call(self.figure, f"Error over {axis_name(self.axis, view.base)}, {view.target}, {view.mode}")
        for name in {*self.sources, *names}:
            y = np.full(len(x), np.nan)
            if name in names and name in view.errors.names:
                values = rms[view.cells, view.errors.names.index(name)]
                good = np.isfinite(values) & (values > 0)
                count = np.bincount(bins[good], minlength=len(x))
                total = np.bincount(bins[good], np.log(values[good]), minlength=len(x))
                y[count > 0] = view.scale(display) * np.exp(total[count > 0] / count[count > 0])
                highest.append(float(np.nanmax(y, initial=0.0)))
            self._line(name).data = {"x": x, "y": y}
        top = 1.08 * max(highest) or 1.0
        self.figure.y_range.update(start=0.0, end=top, reset_start=0.0, reset_end=top)
        self.figure.yaxis.axis_label = f"rms error, {view.mode} [{display.unit_label}]"
        for name, (line, dots) in self._glyphs.items():
            colour = look(name).colour(display.dark)
            line.glyph.line_color = colour
            dots.glyph.update(line_color=colour, fill_color=colour)

    def _line(self, name: str) -> ColumnDataSource:
        if name not in self.sources:
            source = self.sources[name] = ColumnDataSource({"x": [], "y": []})
            line = add_line(self.figure, name, source)
            self._glyphs[name] = line, self.figure.scatter("x", "y", source=source, size=5)
        return self.sources[name]
