"""Errors over one setting of a sweep, with the intervals of the means: on the page of sweeps and in a report.

Each line stands a little beside the next, so that their intervals do not lie on each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, FixedTicker, Range1d
from bokeh.plotting import figure

from wfsobs.app.style import look
from wfsobs.app.views.plots import add_line, call, new_figure
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
        self.figure: figure = new_figure(
            x_range=Range1d(start=ends[0], end=ends[1]),
            y_range=Range1d(start=0.0, end=1.0),
            x_axis_type="log" if logarithmic else "linear",
        )
        call(self.figure, part["title"])
        self.figure.xaxis.axis_label = part["across"]
        if texts is not None:
            self.figure.xaxis.ticker = FixedTicker(ticks=x.tolist())
            self.figure.xaxis.major_label_overrides = dict(zip(x.tolist(), texts, strict=True))
        self.sources, self.glyphs = {}, {}
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
        x = np.array(part["values"], dtype=float)
        all_errors = {name: np.array(errors, dtype=float) for name, errors in part["errors"].items()}
        drawn = [name for name, (y, _, _) in all_errors.items() if np.isfinite(y).any()]
        places = dict(zip(drawn, self._places(x, len(drawn)), strict=True))
        for name, (y, low, high) in all_errors.items():
            self.sources[name].data = {"x": x, "at": places.get(name, x), "y": y, "low": low, "high": high}
        largest = max((float(np.nanmax(all_errors[name][0])) for name in drawn), default=1.0)
        above = max((float(np.nanmax(all_errors[name])) for name in drawn), default=1.0)
        top = 1.08 * min(above, HIGHEST * largest)
        self.figure.y_range.update(start=0.0, end=top, reset_start=0.0, reset_end=top)
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
