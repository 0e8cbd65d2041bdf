"""The star of the live loop on the detector: as it comes, and behind the mirror of each controller."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import panel as pn
from bokeh.models import BasicTicker, ColumnDataSource, Range1d
from bokeh.plotting import figure

from wfsobs.app.display import per_micrometre
from wfsobs.app.pages.live_paint import Painter
from wfsobs.app.pages.parts import WIDE, grid_style
from wfsobs.app.style import asset, look
from wfsobs.app.views.plots import call, new_figure
from wfsobs.app.work import TRUTH
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.live.control_process import ControlView
from wfsobs.live.view import LiveView
from wfsobs.scenario import Scenario
from wfsobs.typing import Array

TRAIL, POINTS = 0.2, 60
"""Length of the trail of the star [s], and its points."""
SIDE = 150
"""Of a detector at least [px]."""
GRID = grid_style(CELLS := "repeat(auto-fill, minmax(180px, 1fr))", CELLS)
FWHM = 1.03
"""Full width at half maximum of an Airy pattern, in wavelengths over the diameter."""


class Detector:
    """One detector: the core of the star, and where it has been in the last instants.

    Attributes
    ----------
    view : pn.Column
        The figure under its caption.
    """

    def __init__(self, name: str, painter: Painter):
        self.painter = painter
        self.name, self.label = name, look("none" if name == TRUTH else name).label
        ranges = {"x_range": Range1d(start=-1.0, end=1.0), "y_range": Range1d(start=-1.0, end=1.0)}
        self.figure: figure = new_figure(**ranges)
        self.figure.update(height=None, aspect_ratio=1.0, min_width=SIDE, min_border_left=36, toolbar_location=None)
        for axis in self.figure.axis:
            ticker = BasicTicker(desired_num_ticks=3)
            axis.update(major_label_text_font_size="10px", minor_tick_line_color=None, ticker=ticker)
        self.figure.xaxis.update(axis_label="mas", axis_label_text_font_size="10px", axis_label_standoff=2)
        call(self.figure, f"Star: {self.label}")
        self._trail, self._spot = ColumnDataSource({"x": [], "y": []}), ColumnDataSource({"x": [], "y": []})
        self._line = self.figure.line("x", "y", source=self._trail, line_alpha=0.5).glyph
        self._core = self.figure.circle("x", "y", radius=1.0, source=self._spot, fill_alpha=0.6).glyph
        self._style: tuple[float, float, str] | None = None
        caption = pn.pane.HTML(f'<div class="caption">{self.label}</div>', margin=0, stylesheets=[asset("style.css")])
        self.view = pn.Column(caption, pn.pane.Bokeh(self.figure, sizing_mode=self.figure.sizing_mode, margin=0), **WIDE)

    def draw(self, points: Array, reach: float, radius: float, dark: bool) -> None:
        """Send the last instants (n, 2), the newest last; reach : of the axes;  radius : of the core, all in mas."""
        points = points[~np.isnan(points).any(axis=1)]
        for source, shown in ((self._trail, points), (self._spot, points[-1:])):
            self.painter.data(self.figure, source, {"x": shown[:, 0], "y": shown[:, 1]})
        colour = look(self.name).colour(dark)
        if (style := (reach, radius, colour)) == self._style:
            return
        self._style = style
        for axis in (self.figure.x_range, self.figure.y_range):
            axis.update(start=-reach, end=reach)
        self._line.line_color = colour
        self._core.update(radius=radius, fill_color=colour, line_color=colour)


class Stars:
    """The detectors, of one scale."""

    def __init__(self, painter: Painter) -> None:
        self._painter = painter
        self.row = pn.Column(**{**WIDE, "margin": (12, 0, 0, 0)}, stylesheets=[GRID])
        self._detectors: dict[str, Detector] = {}
        self._reach = 1.0

    def draw(self, view: LiveView, left: ControlView | None, names: Sequence[str], scenario: Scenario, dark: bool) -> None:
        """Send the last instants; left, names : controllers, and what they leave."""
        scale, n = per_micrometre("mas", scenario.telescope.diameter), max(2, round(TRAIL / view.dt))
        come = view.truth("turbulence") + view.truth("vibration")
        signals = {TRUTH: view.frames.z if np.isnan(come).all() else come}
        if left is not None:
            signals |= {name: left.residual(name) for name in names if CONTROLLERS[name].law is not None}
        if list(signals) != list(self._detectors):
            self._detectors = {name: self._detectors.get(name) or Detector(name, self._painter) for name in signals}
            self.row[:] = [detector.view for detector in self._detectors.values()]
        reach = 1.1 * float(np.nanmax(np.abs(scale * signals[TRUTH][:, :2]), initial=1e-3))
        if not self._reach / 1.6 < reach < self._reach:
            self._reach = 1.25 * reach
        # wavelength [um] over diameter [m] is in microradians
        radius = 0.5 * FWHM * np.degrees(scenario.control.wavelength * 1e-6 / scenario.telescope.diameter) * 3.6e6
        step = max(1, n // POINTS)
        for name, detector in self._detectors.items():
            detector.draw(scale * signals[name][-n:, :2][::-step][::-1], self._reach, radius, dark)
