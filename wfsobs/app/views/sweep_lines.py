"""Errors over one setting of a sweep, with the intervals of the means: on the page of sweeps and in a report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, FixedTicker, Range1d
from bokeh.plotting import figure

from wfsobs.app.style import look
from wfsobs.app.views.plots import add_line, call, new_figure
from wfsobs.typing import Array


class SweepLines:
    """A line per observer and bound, and the intervals of the means as bars.

    A part, as in `sweep_views.line_part`: title; across and up, the titles of the axes; values, in increasing order; texts, what
    stands for them where they are no numbers, else None; errors, name -> mean and both ends of its interval for every value.
    """

    def __init__(self, part: Mapping[str, Any]):
        """Make the figure of a part, without its errors."""
        x, texts = np.array(part["values"], dtype=float), part["texts"]
        low, high = float(x[0]), float(x[-1])
        logarithmic = texts is None and low > 0 and _unevenness(np.log(x)) < _unevenness(x)
        room = 0.03 * (high - low)
        ends = (low / 1.1, high * 1.1) if logarithmic else (low - room, high + room)
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
            source = self.sources[name] = ColumnDataSource({"x": [], "y": [], "low": [], "high": []})
            bar = self.figure.segment("x", "low", "x", "high", source=source, line_width=2, line_alpha=0.35, level="underlay")
            line = add_line(self.figure, name, source)
            self.glyphs[name] = line, bar, self.figure.scatter("x", "y", source=source, size=5)
            for glyph in self.glyphs[name]:
                glyph.name = name

    def draw(self, part: Mapping[str, Any], dark: bool = False) -> None:
        """Send the errors of a part with the same values, in the colours of light or dark mode."""
        x, highest = np.array(part["values"], dtype=float), []
        for name, errors in part["errors"].items():
            y, low, high = np.array(errors, dtype=float)
            self.sources[name].data = {"x": x, "y": y, "low": low, "high": high}
            if np.isfinite(y).any():
                highest.append(float(np.nanmax(y)))
        top = 1.08 * max(highest, default=1.0)
        self.figure.y_range.update(start=0.0, end=top, reset_start=0.0, reset_end=top)
        self.figure.yaxis.axis_label = part["up"]
        for name, (line, bar, dots) in self.glyphs.items():
            colour = look(name).colour(dark)
            line.glyph.line_color = bar.glyph.line_color = colour
            dots.glyph.update(line_color=colour, fill_color=colour)


def _unevenness(x: Array) -> float:
    """Return the range of the steps between sorted values over their mean; without steps to compare, 0."""
    steps = np.diff(x)
    return float(np.ptp(steps) / steps.mean()) if steps.size else 0.0
