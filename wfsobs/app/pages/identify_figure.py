"""The spectrum of a record and the model of it, log-log."""

from __future__ import annotations

import numpy as np
from bokeh.models import ColumnDataSource, HoverTool, Range1d

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.identify_work import Fit, RecordSpectrum
from wfsobs.app.style import look
from wfsobs.app.views.plots import call, new_figure
from wfsobs.identification.result import IdentifiedMode

HEIGHT = 400
NAMES = {
    "measured": "measured PSD (mean)",
    "highest": "measured PSD (maximum per bin)",
    "fitted": "model",
    "parts": "model components",
    "found": "identified peaks",
}
"""Look -> what it is called in the legend."""


class SpectrumFigure:
    """What was measured, mean and highest value of every bin; over it the model, its parts, and a mark on every peak."""

    def __init__(self) -> None:
        self.figure = new_figure(
            x_range=Range1d(start=0.1, end=500.0), y_range=Range1d(start=1e-6, end=1.0), x_axis_type="log", y_axis_type="log"
        )
        self.figure.height = HEIGHT
        call(self.figure, "Spectrum of z and its model")
        self.figure.xaxis.axis_label = "frequency [Hz]"
        self.measurement = ColumnDataSource({"x": [], "mean": [], "highest": []})
        self.total = ColumnDataSource({"x": [], "y": []})
        self.parts = ColumnDataSource({"xs": [], "ys": []})
        self.spikes = ColumnDataSource({"x": [], "low": [], "high": []})
        self.peaks = ColumnDataSource({"x": [], "y": [], "text": []})
        fig = self.figure
        self._renderers = {
            "highest": [fig.line("x", "highest", source=self.measurement, line_alpha=0.45, line_width=1.0)],
            "measured": [fig.line("x", "mean", source=self.measurement, line_width=1.0)],
            "parts": [fig.multi_line("xs", "ys", source=self.parts, line_width=1.2, line_dash=list(look("parts").dash))],
            "fitted": [fig.line("x", "y", source=self.total, line_width=2.2)],
        }
        marks = fig.scatter("x", "y", source=self.peaks, marker="inverted_triangle", size=8)
        spikes = fig.segment("x", "low", "x", "high", source=self.spikes, line_width=2.2)
        self._renderers["found"] = [marks, spikes]
        fig.add_tools(HoverTool(renderers=[marks], tooltips="@text"))

    def draw_measured(self, of: RecordSpectrum, display: Display, diameter: float) -> None:
        """Send what was measured, and have the axes hold it."""
        scale, column = per_micrometre(display.unit, diameter) ** 2, display.column
        mean, highest = scale * of.mean[:, column], scale * of.highest[:, column]
        self.measurement.data = {"x": of.frequency, "mean": mean, "highest": highest}
        positive = mean[mean > 0]
        if positive.size:
            low, high = float(np.quantile(positive, 0.01)) / 5.0, float(highest.max()) * 6.0
            self.figure.y_range.update(start=low, end=high, reset_start=low, reset_end=high)
        ends = float(of.frequency[0]), float(of.frequency[-1])
        self.figure.x_range.update(start=ends[0], end=ends[1], reset_start=ends[0], reset_end=ends[1])
        self.figure.yaxis.axis_label = f"PSD of z, {display.mode_label} [{display.unit_label}²/Hz]"

    def draw_fit(self, mode: IdentifiedMode | None, of: Fit | None, display: Display, diameter: float) -> None:
        """Send the model of the mode shown, or nothing."""
        if mode is None or of is None:
            for source in (self.total, self.parts, self.spikes, self.peaks):
                source.data = {str(name): [] for name in source.data}
            return
        scale = per_micrometre(display.unit, diameter) ** 2
        self.total.data = {"x": of.frequency, "y": scale * of.total}
        self.parts.data = {"xs": [of.frequency] * len(of.parts), "ys": [scale * part for part in of.parts]}
        self.spikes.data = {
            "x": [f for f, _, _ in of.lines],
            "low": [scale * low for _, low, _ in of.lines],
            "high": [scale * high for *_, high in of.lines],
        }
        tops = {f: high for f, _, high in of.lines}
        at = [p.frequency.value for p in mode.peaks]
        height = [tops.get(f) or float(np.interp(f, of.frequency, of.total)) for f in at]
        self.peaks.data = {
            "x": at,
            "y": [1.6 * scale * y for y in height],
            "text": [f"{'line' if p.pure else 'resonance'} {p.frequency.value:.5g} Hz" for p in mode.peaks],
        }

    def restyle(self, dark: bool) -> None:
        """Set the colours of light or dark mode."""
        for name, renderers in self._renderers.items():
            for renderer in renderers:
                renderer.glyph.line_color = look(name).colour(dark)
                if "fill_color" in renderer.glyph.properties():
                    renderer.glyph.fill_color = look(name).colour(dark)
