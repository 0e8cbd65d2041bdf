"""A sweep in maps and figures: the best observer of each cell by its colour, the errors of all over one setting."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import param
from bokeh.models import ColumnDataSource, FixedTicker, Range1d
from bokeh.plotting import figure
from panel.custom import JSComponent

from wfsobs.app.controls.names import setting_name
from wfsobs.app.display import Display, per_micrometre, unit_text
from wfsobs.app.numbers import number
from wfsobs.app.report.text import value_of
from wfsobs.app.style import asset, look, observers_of
from wfsobs.app.views.plots import add_line, call, new_figure
from wfsobs.campaign.sweep_results import SweepResults
from wfsobs.evaluation.evidence import FEWEST
from wfsobs.evaluation.rows import row_label
from wfsobs.evaluation.scores import BOUND, BOUND_BOTH
from wfsobs.scenario import Scenario
from wfsobs.settings.parameters import unit_of
from wfsobs.typing import Array

FULL_MARGIN = 0.3
"""Margin of the best from which its colour is full: the second is 30 % worse."""

GROUNDS = {False: "#FFFFFF", True: "#1E1E1E"}
"""What lies under the cells in light and dark mode."""

MOST_ROWS = 3000
"""Of the table in a report."""

REPORT_COLUMNS = ("target", "mode", "observer", "seeds", "mean rms [nm]", "95 % [nm]", "")
OPEN, DECIDED, WAITING, FAILED = "open", "decided", "waiting", "failed"


class SweepMap(JSComponent):
    """The map in the browser; a click on a cell asks for its scenario."""

    grid = param.Dict({}, doc="Title, names of the axes and their values, cells row by row, and the key of the colours.")

    _esm = asset("sweep.js")
    _stylesheets = [asset("sweep.css")]  # noqa: RUF012

    def __init__(self, load: Callable[[int], None], **params: Any):
        """Make the map. load : takes the number of a cell."""
        self._load = load
        super().__init__(**params)

    def _handle_msg(self, data: object) -> None:
        if isinstance(data, dict) and isinstance(cell := data.get("load"), int):
            self._load(cell)


def axis_title(scenario: Scenario, path: str) -> str:
    """Name a setting of an axis, with its unit in [brackets]."""
    p = {known: p for known, _, p in scenario.walk()}.get(path)
    unit = unit_text(unit_of(p)) if p is not None else ""
    return f"{setting_name(path)} [{unit}]" if unit else setting_name(path)


def map_grid(results: SweepResults, target: str, display: Display) -> dict[str, Any]:
    """Describe the map of a target, in the mode and unit shown."""
    sweep = results.sweep
    x, y = sweep.axes[0], sweep.axes[1] if len(sweep.axes) > 1 else None
    count = len(y.values) if y else 1
    title = f"Best observers, {target}, {display.mode}"
    winners = {cell: results.winner(cell, target, display.mode) for cell in range(len(sweep.cells))}
    names = dict.fromkeys(best.name for best in winners.values() if best)
    return {
        "title": title,
        "across": axis_title(sweep.base, x.path),
        "down": axis_title(sweep.base, y.path) if y else "",
        "columns": [value_of(value) for value in x.values],
        "rows": [value_of(value) for value in reversed(y.values)] if y else [""],
        "cells": [[_cell(results, i * count + j, target, display) for i in range(len(x.values))] for j in reversed(range(count))],
        "key": [[look(name).colour(display.dark), look(name).label] for name in names],
    }


def report_part(results: SweepResults) -> dict[str, Any]:
    """Describe the maps of every target and mode and the errors of all cells, as plain values for a report; errors in [nm]."""
    groups = list(dict.fromkeys(key[1:] for key in results.known_keys()))
    rows = results.rows()
    axes = [axis.path for axis in results.sweep.axes]
    return {
        "maps": [map_grid(results, target, Display(mode=mode, unit="nm", dark=False)) for target, mode in groups],
        "columns": [*(axis_title(results.sweep.base, path) for path in axes), *REPORT_COLUMNS],
        "rows": [[*(value_of(row[path]) for path in axes), *_report_cells(row)] for row in rows[:MOST_ROWS]],
        "left_out": max(0, len(rows) - MOST_ROWS),
        "shades": legend_of_shades(),
    }


def _report_cells(row: dict[str, Any]) -> list[str]:
    interval = "" if row["low_nm"] is None else f"{number(row['low_nm'])} – {number(row['high_nm'])}"
    return [
        row["target"],
        row["mode"],
        row_label(row["observer"]),
        str(row["seeds"]),
        number(row["mean_rms_nm"]),
        interval,
        row["rank"],
    ]


def _cell(results: SweepResults, cell: int, target: str, display: Display) -> dict[str, Any]:
    best, ground = results.winner(cell, target, display.mode), GROUNDS[display.dark]
    where = ", ".join(f"{setting_name(path)} {value_of(value)}" for path, value in results.sweep.cells[cell].items())
    if best is None:
        reason = results.failures.get(cell, "")
        state, text = (FAILED, "×") if reason else (WAITING, "")
        title = f"{where}: {reason or 'not run yet'}"
        return {"index": cell, "state": state, "text": text, "title": title, "ground": ground, "stripe": ground, "ink": ""}
    unit = per_micrometre(display.unit, results.sweep.value(cell, "telescope.diameter"))
    margin = 0.0 if best.margin is None else best.margin
    said = f"{where}: {row_label(best.name)} {number(best.rms * unit)} {display.unit_label}"
    if best.margin is not None:
        said += f", {100 * best.margin:.0f} % before the next"
    if best.ties:
        said += f"; tied with {', '.join(map(row_label, best.ties))}"
    elif not best.is_significant:
        said += "; too few seeds to tell"
    said += f"; {best.seeds} {'seed' if best.seeds == 1 else 'seeds'}"
    colour, decided = look(best.name).colour(display.dark), best.is_significant
    fill = mix(colour, ground, 0.35 + 0.65 * min(1.0, margin / FULL_MARGIN) if decided else 0.12)
    return {
        "index": cell,
        "state": DECIDED if decided else OPEN,
        "text": number(best.rms * unit),
        "title": said,
        "ground": fill,
        "stripe": mix(colour, ground, 0.28),
        "ink": ink_on(fill),
    }


def mix(colour: str, ground: str, share: float) -> str:
    """Mix a share of a colour into a ground.

    >>> mix("#FF0000", "#FFFFFF", 0.5)
    '#ff8080'
    """
    parts = [share * a + (1.0 - share) * b for a, b in zip(_channels(colour), _channels(ground), strict=True)]
    return "#" + "".join(f"{round(part):02x}" for part in parts)


def ink_on(ground: str) -> str:
    """Choose black or white for a text, whichever is easier to read (contrast of WCAG 2).

    >>> ink_on("#ffffff"), ink_on("#003de6")
    ('#000000', '#ffffff')
    """
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in _channels(ground))]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return "#000000" if (luminance + 0.05) / 0.05 > 1.05 / (luminance + 0.05) else "#ffffff"


def _channels(colour: str) -> list[int]:
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


class SweepLines:
    """Errors over one setting: a line per observer and bound, and the intervals of the means as bars."""

    def __init__(self, results: SweepResults, target: str):
        self.target, (axis,) = target, results.sweep.axes
        values = axis.values
        self.numeric = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
        self.x = np.array(values if self.numeric else range(len(values)), dtype=float)
        order = np.argsort(self.x)
        self.order = order.tolist()
        logarithmic = self.numeric and self.x.min() > 0 and _unevenness(np.log(self.x)) < _unevenness(self.x)
        low, high = float(self.x.min()), float(self.x.max())
        room = 0.03 * (high - low)
        ends = (low / 1.1, high * 1.1) if logarithmic else (low - room, high + room)
        self.figure: figure = new_figure(
            x_range=Range1d(start=ends[0], end=ends[1]),
            y_range=Range1d(start=0.0, end=1.0),
            x_axis_type="log" if logarithmic else "linear",
        )
        call(self.figure, f"Error over {setting_name(axis.path)}, {target}")
        self.figure.xaxis.axis_label = axis_title(results.sweep.base, axis.path)
        if not self.numeric:
            self.figure.xaxis.ticker = FixedTicker(ticks=self.x.tolist())
            self.figure.xaxis.major_label_overrides = {float(i): value_of(v) for i, v in enumerate(values)}
        self.names = [name for name in observers_of(target) if name in results.sweep.observers]
        self.sources, self.glyphs = {}, {}
        for name in (BOUND, BOUND_BOTH, *self.names):
            source = self.sources[name] = ColumnDataSource({"x": [], "y": [], "low": [], "high": []})
            bar = self.figure.segment("x", "low", "x", "high", source=source, line_width=2, line_alpha=0.35, level="underlay")
            line = add_line(self.figure, name, source)
            self.glyphs[name] = line, bar, self.figure.scatter("x", "y", source=source, size=5)

    def draw(self, results: SweepResults, display: Display) -> None:
        """Send what is known of every line."""
        cells = self.order
        diameters = [results.sweep.value(cell, "telescope.diameter") for cell in cells]
        scale = np.array([per_micrometre(display.unit, diameter) for diameter in diameters])
        highest = []
        for name, source in self.sources.items():
            errors = [results.error(cell, (name, self.target, display.mode)) or (np.nan,) * 3 for cell in cells]
            y, low, high = scale * np.array(errors).T
            source.data = {"x": self.x[cells], "y": y, "low": low, "high": high}
            if np.isfinite(y).any():
                highest.append(float(np.nanmax(y)))
        top = 1.08 * max(highest, default=1.0)
        self.figure.y_range.update(start=0.0, end=top, reset_start=0.0, reset_end=top)
        self.figure.yaxis.axis_label = f"mean rms error, {display.mode_label} [{display.unit_label}]"

    def restyle(self, dark: bool) -> None:
        """Set the colours of light or dark mode."""
        for name, (line, bar, dots) in self.glyphs.items():
            colour = look(name).colour(dark)
            line.glyph.line_color = bar.glyph.line_color = colour
            dots.glyph.update(line_color=colour, fill_color=colour)


def _unevenness(x: Array) -> float:
    """Return the range of the steps between sorted values over their mean; without steps to compare, 0."""
    steps = np.diff(np.sort(x))
    return float(np.ptp(steps) / steps.mean())


def legend_of_shades() -> str:
    """Say what the shades of a map mean."""
    return (
        f"A full colour: the next is at least {100 * FULL_MARGIN:.0f} % worse. Striped: another does not differ significantly, "
        f"or there are fewer than {FEWEST} seeds. Numbers are the mean rms error of the best."
    )
