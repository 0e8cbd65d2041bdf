"""What the figures have in common."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, GlyphRenderer
from bokeh.plotting import figure
from numpy.typing import ArrayLike

from wfsobs.app.style import look
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.vibration import Peak
from wfsobs.scenario.measured_spectra import measured_spectrum

HEIGHT = 230

PEAKS, MODEL = "#888888", "#FF6600"
"""Colours of the marks: the scenario's peaks, and the one that the Kalman filters model."""

MARKED_LINE = 0.004
"""Lines of a measured spectrum get a mark above this rms in either axis [um]."""


def new_figure(**options: Any) -> figure:
    """Make an empty figure as wide as its room, the scroll wheel left to the page until chosen."""
    fig = figure(
        height=HEIGHT,
        sizing_mode="stretch_width",
        min_width=240,
        tools="xbox_zoom,xpan,xwheel_zoom,reset,save",
        active_drag="xbox_zoom",
        toolbar_location="above",
        toolbar_inner=True,
        min_border_right=10,
        min_border_left=70,
        **options,
    )
    fig.toolbar.logo = None
    fig.toolbar.autohide = True
    return fig


def call(fig: figure, name: str) -> None:
    """Name a figure, for its file and for those who hear the page."""
    fig.update(name=name, html_attributes={"role": "figure", "aria-label": name})


def add_line(fig: figure, name: str, source: ColumnDataSource, y: str = "y") -> GlyphRenderer:
    """Draw a line in the look of an observer or of the truth."""
    it = look(name)
    renderer = fig.line("x", y, source=source, color=it.light, line_width=it.width, line_dash=list(it.dash), name=name)
    return renderer


def marked_peaks(scenario: Scenario) -> list[Peak]:
    """List the peaks in the scenario's vibration; of a measured spectrum, its stronger lines."""
    vibration = scenario.vibration
    if vibration.source == "ar2":
        return list(vibration.peaks)
    peaks = list(vibration.peaks) if vibration.source == "peaks" else []
    if vibration.source == "measured":
        lines = measured_spectrum(vibration.spectrum).lines(MARKED_LINE)
        peaks = [Peak(frequency=line.frequency, damping=0.0, rms=list(line.rms)) for line in lines]
    return [p for p in peaks if p.frequency <= vibration.cutoff]


def send(source: ColumnDataSource, data: dict[str, Any]) -> None:
    """Give a source its data, unless it has them already: each one sent has its figure drawn anew."""
    old = source.data
    if data.keys() != old.keys() or not all(_same(old[name], data[name]) for name in data):  # type: ignore[arg-type]
        source.data = data


def _same(a: Any, b: Any) -> bool:
    if len(a) != len(b):
        return False
    return np.array_equal(a, b, equal_nan=True) if isinstance(b, np.ndarray) else list(a) == list(b)


def restyle(lines: dict[str, GlyphRenderer], dark: bool, hidden_names: list[str]) -> None:
    """Give every line the colour of the mode, and hide those that are to be hidden."""
    for name, line in lines.items():
        line.glyph.line_color = look(name).colour(dark)
        line.visible = name not in hidden_names


class PinnedLines:
    """The lines of the pinned run in a figure, faint under those of the present one; nothing until there is one."""

    def __init__(self, fig: figure, name: str = "pinned", **style: Any):
        self.figure, self.name = fig, name
        self.style = {"line_alpha": 0.4, "line_width": 1.0, "level": "underlay", **style}
        self.source: ColumnDataSource | None = None

    def draw(self, lines: dict[str, tuple[ArrayLike, ArrayLike]], dark: bool) -> None:
        """Show these lines (name -> x, y) in place of those before."""
        if self.source is None:
            if not lines:
                return
            self.source = ColumnDataSource({"xs": [], "ys": [], "colour": []})
            self.figure.multi_line("xs", "ys", line_color="colour", source=self.source, name=self.name, **self.style)
        self.source.data = {
            "xs": [x for x, _ in lines.values()],
            "ys": [y for _, y in lines.values()],
            "colour": [look(name).colour(dark) for name in lines],
        }
