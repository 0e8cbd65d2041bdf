"""A sweep in maps and lines: the best observer of each cell by its colour, the errors of all over one setting."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
from bokeh.colors import RGB
from bokeh.models import ColumnDataSource, FixedTicker
from bokeh.plotting import figure

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.render import number
from wfsobs.app.style import look, observers_of
from wfsobs.app.views.plots import add_line, call, new_figure, set_ends
from wfsobs.campaign.sweep import SweepResults
from wfsobs.evaluation.evidence import FEWEST
from wfsobs.evaluation.result import row_label
from wfsobs.evaluation.scores import BOUND, BOUND_BOTH
from wfsobs.evaluation.verdict import sentence_of_several
from wfsobs.scenario.names import setting_label, setting_name, value_of
from wfsobs.typing import Array

APART = 0.12
"""Of the smallest step between values, what the lines lie apart from the first to the last."""

HIGHEST = 1.5
"""Of the largest mean, where the axis ends at the most: what few seeds tell may be an interval far beyond."""


class SweepLines:
    """A line per observer and bound, and the intervals of the means as bars.

    A part, as in `sweep_views.line_part`: title; across and up, the titles of the axes; values, in increasing order; texts, what
    stands for them where they are no numbers, else None; errors, name -> mean and both ends of its interval for every value.
    """

    def __init__(self, part: Mapping[str, Any]):
        """Make the figure of a part, without its errors."""
        x, texts = np.array(part["values"], dtype=float), part["texts"]
        low, high = float(x[0]), float(x[-1])
        self.logarithmic = logarithmic = texts is None and low > 0 and _unevenness(np.log(x)) < _unevenness(x)
        room = 0.03 * (high - low) + 0.5 * APART * float(np.diff(x).min())
        ratio = 1.1 * float(np.exp(0.5 * APART * np.diff(np.log(x)).min())) if logarithmic else 1.0
        ends = (low / ratio, high * ratio) if logarithmic else (low - room, high + room)
        self.figure: figure = new_figure(ends, (0.0, 1.0), part["across"], "x" * logarithmic)
        if texts is not None:
            self.figure.xaxis.ticker = FixedTicker(ticks=x.tolist())
            self.figure.xaxis.major_label_overrides = dict(zip(x.tolist(), texts, strict=True))
        self.sources: Final = {}
        self.glyphs: Final = {}
        for name in part["errors"]:
            source = self.sources[name] = ColumnDataSource({column: [] for column in ("x", "at", "y", "low", "high")})
            bar = self.figure.segment("at", "low", "at", "high", source=source, line_width=2, line_alpha=0.35, level="underlay")
            line = add_line(self.figure, name, source)
            line.glyph.x = "at"
            self.glyphs[name] = line, bar, self.figure.scatter("at", "y", source=source, size=5)
            for glyph in self.glyphs[name]:
                glyph.name = name

    def draw(self, part: Mapping[str, Any], dark: bool = False) -> None:
        """Send the errors of a part with the same values, in the colours of light or dark mode."""
        call(self.figure, part["title"])
        x = np.array(part["values"], dtype=float)
        all_errors = {name: np.array(errors, dtype=float) for name, errors in part["errors"].items()}
        drawn = [name for name, (y, _, _) in all_errors.items() if np.isfinite(y).any()]
        places = dict(zip(drawn, self._places(x, len(drawn)), strict=True))
        for name, (y, low, high) in all_errors.items():
            self.sources[name].data = {"x": x, "at": places.get(name, x), "y": y, "low": low, "high": high}
        largest = max((float(np.nanmax(all_errors[name][0])) for name in drawn), default=1.0)
        above = max((float(np.nanmax(all_errors[name])) for name in drawn), default=1.0)
        top = 1.08 * min(above, HIGHEST * largest)
        set_ends(self.figure.y_range, 0.0, top)
        self.figure.yaxis.axis_label = part["up"]
        for name, (line, bar, dots) in self.glyphs.items():
            colour = look(name).colour(dark)
            line.glyph.line_color = bar.glyph.line_color = colour
            dots.glyph.update(line_color=colour, fill_color=colour)

    def _places(self, x: Array, count: int) -> list[Array]:
        """Return where the points of each of so many lines are drawn."""
        scale = np.log(x) if self.logarithmic else x
        apart = APART * float(np.diff(scale).min()) / max(count - 1, 1)
        shifted = [scale + (i - 0.5 * (count - 1)) * apart for i in range(count)]
        return [np.exp(at) for at in shifted] if self.logarithmic else shifted


def _unevenness(x: Array) -> float:
    """Return the range of the steps between sorted values over their mean; without steps to compare, 0."""
    steps = np.diff(x)
    return float(np.ptp(steps) / steps.mean()) if steps.size else 0.0


FULL_MARGIN = 0.3
"""Margin of the best from which its colour is full: the second is 30 % worse."""

GROUNDS = {False: "#FFFFFF", True: "#1E1E1E"}
"""What lies under the cells in light and dark mode."""

MOST_ROWS = 3000
"""Of the table in a report."""

REPORT_COLUMNS = ("target", "mode", "observer", "seeds", "mean rms [nm]", "95 % [nm]", "")
OPEN, DECIDED, WAITING, FAILED, LEFT_OUT = "open", "decided", "waiting", "failed", "left-out"


def _scale(results: SweepResults, cell: int, display: Display) -> float:
    """Return how many of the unit shown one micrometre is in a cell."""
    return per_micrometre(display.unit, results.sweep.value(cell, "telescope.diameter"))


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
        "across": setting_label(sweep.base, x.path),
        "down": setting_label(sweep.base, y.path) if y else "",
        "columns": [value_of(value) for value in x.values],
        "rows": [value_of(value) for value in reversed(y.values)] if y else [""],
        "cells": [[_cell(results, i * count + j, target, display) for i in range(len(x.values))] for j in reversed(range(count))],
        "key": [[look(name).colour(display.dark), look(name).label] for name in names],
    }


def verdict_of_sweep(results: SweepResults, target: str, display: Display) -> str:
    """Write who is best, of a single scenario with the limit and its reasons, of several in how many."""
    sweep = results.sweep
    found = {cell: results.verdict(cell, target, display.mode) for cell in range(len(sweep.cells))}
    verdicts = {cell: it for cell, it in found.items() if it is not None}
    scales = [_scale(results, cell, display) for cell in verdicts]
    if len(sweep.cells) == 1 and verdicts:
        return " ".join(verdicts[0].sentences(scales[0], display.unit_label))
    return sentence_of_several([*verdicts.values()], scales, display.unit_label)


def line_part(results: SweepResults, target: str, display: Display) -> dict[str, Any]:
    """Describe the errors over the one setting of a sweep, in the mode and unit shown, as `SweepLines` draws them."""
    (axis,) = results.sweep.axes
    is_numeric = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in axis.values)
    x = np.array(axis.values if is_numeric else range(len(axis.values)), dtype=float)
    cells = np.argsort(x).tolist()
    scale = np.array([_scale(results, cell, display) for cell in cells])
    names = (BOUND, BOUND_BOTH, *(name for name in observers_of(target) if name in results.sweep.observers))
    unknown = (np.nan,) * 3
    errors = {name: [results.error(cell, (name, target, display.mode)) or unknown for cell in cells] for name in names}
    return {
        "title": f"Error over {setting_name(axis.path)}, {target}",
        "mode": display.mode,
        "across": setting_label(results.sweep.base, axis.path),
        "up": f"mean rms error, {display.mode_label} [{display.unit_label}]",
        "values": x[cells].tolist(),
        "texts": None if is_numeric else [value_of(axis.values[cell]) for cell in cells],
        "errors": {name: (scale * np.array(known).T).tolist() for name, known in errors.items()},
    }


def report_part(results: SweepResults) -> dict[str, Any]:
    """Describe a sweep for a report as plain values: maps and lines of every target and mode, errors of all cells [nm]."""
    groups = list(dict.fromkeys(key[1:] for key in results.known_keys()))
    rows = results.rows()
    axes = [axis.path for axis in results.sweep.axes]
    shown = [(target, Display(mode=mode, unit="nm", dark=False)) for target, mode in groups]
    return {
        "maps": [map_grid(results, target, display) for target, display in shown],
        "lines": [line_part(results, target, display) for target, display in shown] if len(axes) == 1 else [],
        "columns": [*(setting_label(results.sweep.base, path) for path in axes), *REPORT_COLUMNS],
        "rows": [
            [
                *(value_of(row[path]) for path in axes),
                *(row["target"], row["mode"], row_label(row["observer"]), str(row["seeds"]), number(row["mean_rms_nm"])),
                "" if row["low_nm"] is None else f"{number(row['low_nm'])} – {number(row['high_nm'])}",
                row["rank"],
            ]
            for row in rows[:MOST_ROWS]
        ],
        "left_out": max(0, len(rows) - MOST_ROWS),
        "shades": legend_of_shades(),
    }


def _cell(results: SweepResults, cell: int, target: str, display: Display) -> dict[str, Any]:
    best = results.winner(cell, target, display.mode)
    where = ", ".join(f"{setting_name(path)} {value_of(value)}" for path, value in results.sweep.cells[cell].items())
    if best is None:
        reason = results.failures.get(cell, "")
        state, text = (FAILED, "×") if reason else (WAITING, "")
        return map_square(cell, state, f"{where}: {reason or 'not run yet'}", text, display.dark)
    error = number(best.rms * _scale(results, cell, display))
    said = f"{where}: {row_label(best.name)} {error} {display.unit_label}"
    said += verdict_text(best.margin, map(row_label, best.ties), best.is_significant, "seeds")
    said += f"; {best.seeds} {'seed' if best.seeds == 1 else 'seeds'}"
    return map_square(cell, DECIDED if best.is_significant else OPEN, said, error, display.dark, best.name, best.margin)


def verdict_text(margin: float | None, ties: Iterable[str], is_decided: bool, few: str) -> str:
    """Say how far the best is before the next; few : what there is too little of where that is not decided."""
    said = "" if margin is None else f", {100 * margin:.0f} % before the next"
    tied = ", ".join(ties)
    return said + (f"; not significantly different from {tied}" if tied else "" if is_decided else f"; too few {few} to tell")


def map_square(
    index: int, state: str, title: str, text: str, dark: bool, best: str = "", margin: float | None = None
) -> dict[str, Any]:
    """Describe a square of a map: the scenario that it opens, what it says, and in its colour the best and its margin."""
    ground = fill = stripe = GROUNDS[dark]
    if best:
        colour, full = look(best).colour(dark), min(1.0, max(0.0, margin or 0.0) / FULL_MARGIN)
        fill, stripe = mix(colour, ground, 0.35 + 0.65 * full if state == DECIDED else 0.12), mix(colour, ground, 0.28)
    ink = ink_on(fill) if best else ""
    return {"index": index, "state": state, "text": text, "title": title, "ground": fill, "stripe": stripe, "ink": ink}


def mix(colour: str, ground: str, share: float) -> str:
    """Mix a share of a colour into a ground.

    >>> mix("#FF0000", "#FFFFFF", 0.5)
    '#ff8080'
    """
    one, other = RGB.from_hex_string(colour), RGB.from_hex_string(ground)
    parts = [share * getattr(one, c) + (1.0 - share) * getattr(other, c) for c in "rgb"]
    return "#" + "".join(f"{round(part):02x}" for part in parts)


def ink_on(ground: str) -> str:
    """Choose black or white for a text, whichever is easier to read (contrast of WCAG 2).

    >>> ink_on("#ffffff"), ink_on("#003de6")
    ('#000000', '#ffffff')
    """
    return "#000000" if RGB.from_hex_string(ground).luminance > 0.179 else "#ffffff"


def legend_of_shades() -> str:
    """Say what the shades of a map mean."""
    return (
        f"A full colour: the next is at least {100 * FULL_MARGIN:.0f} % worse. Striped: another does not differ significantly, "
        f"or there are fewer than {FEWEST} seeds. Numbers are the mean rms error of the best."
    )
