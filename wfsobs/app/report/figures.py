"""The figures of a report as Bokeh models without data: the page's script fills them, state by state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bokeh.models import BoxAnnotation, ColumnDataSource, CrosshairTool, DataRenderer, HoverTool, Range1d, Span, VSpan
from bokeh.plotting import figure

from wfsobs.app.pages.sweep_views import SweepLines
from wfsobs.app.style import look, observers_of
from wfsobs.app.views.plots import MODEL, PEAKS, add_line, new_figure
from wfsobs.app.work import TRUTH
from wfsobs.observers.base import TARGETS, VIBRATION

TRACE, SPECTRUM, SWEEP, PART = "trace", "spectrum", "sweep", "part"

WARM_UP, WINDOW = "warm-up", "window"
NOW = "now"
SHADES = {WARM_UP: "#808080", WINDOW: "#2B8AB3"}
"""Stretches of a trace that are shaded."""


def all_figures(sweeps: bool, parts: Sequence[Mapping[str, Any]] = ()) -> dict[str, figure]:
    """Make all figures by name, as in "trace-turbulence"; the traces share their time axis, the spectra their frequencies.

    sweeps : with those of errors over a setting that varies; parts : errors of a sweep over one setting, which have their data
    """
    times, frequencies = Range1d(start=0.0, end=10.0), Range1d(start=0.5, end=500.0)
    crosshair = CrosshairTool(dimensions="height", overlay=Span(dimension="height", line_alpha=0.4, line_width=1))
    made = {f"{TRACE}-{target}": _trace(target, times, crosshair) for target in TARGETS}
    made |= {f"{SPECTRUM}-{target}": _spectrum(target, frequencies) for target in TARGETS}
    if sweeps:
        values = Range1d(start=0.0, end=1.0)
        made |= {f"{SWEEP}-{target}": _sweep(target, values) for target in TARGETS}
    made |= {f"{PART}-{i}": _part(part) for i, part in enumerate(parts)}
    for name, fig in made.items():  # see-through from the start: a white ground leaves its edge behind in dark mode
        fig.update(name=name, background_fill_alpha=0.0, border_fill_alpha=0.0)
    return made


def _trace(target: str, times: Range1d, crosshair: CrosshairTool) -> figure:
    """Time traces of the truth and the estimates; warm-up and the stretch of every sample shaded."""
    fig = new_figure(x_range=times, y_range=Range1d(start=-1.0, end=1.0))
    fig.xaxis.axis_label = "time [s]"
    fig.add_tools(crosshair)
    for name, colour in SHADES.items():
        fig.add_layout(
            BoxAnnotation(left=0, right=0, fill_color=colour, fill_alpha=0.10, line_width=0, level="underlay", name=name)
        )
    source = ColumnDataSource({"x": [], **{name: [] for name in _names(target)}})
    for name in _names(target):
        add_line(fig, name, source, name)
    return fig


def _spectrum(target: str, frequencies: Range1d) -> figure:
    """Spectra, log-log, the peaks of the vibration and of the Kalman filters' model marked."""
    fig = new_figure(x_range=frequencies, y_range=Range1d(start=1e-6, end=1.0), x_axis_type="log", y_axis_type="log")
    fig.xaxis.axis_label = "frequency [Hz]"
    if target == VIBRATION:
        marks: list[DataRenderer] = [
            fig.add_glyph(ColumnDataSource({"x": [], "text": []}), VSpan(x="x", **look), name=name)
            for name, look in (
                ("peaks", {"line_color": PEAKS, "line_alpha": 0.4, "line_width": 1.5}),
                ("model", {"line_color": MODEL, "line_dash": [4, 3], "line_width": 1.5}),
            )
        ]
        fig.add_tools(HoverTool(renderers=marks, tooltips="@text"))
    source = ColumnDataSource({"x": [], **{name: [] for name in _names(target)}})
    for name in _names(target):
        add_line(fig, name, source, name)
    return fig


def _sweep(target: str, values: Range1d) -> figure:
    """RMS errors over the values of a setting, a dot for every run; the present one marked."""
    fig = new_figure(x_range=values, y_range=Range1d(start=0.0, end=1.0))
    fig.add_glyph(ColumnDataSource({"x": []}), VSpan(x="x", line_color=PEAKS, line_alpha=0.6, line_width=1.5), name=NOW)
    source = ColumnDataSource({"x": [], **{name: [] for name in _names(target)}})
    for name in _names(target):
        add_line(fig, name, source, name)
        fig.scatter("x", name, source=source, size=5, color=look(name).light, name=name)
    return fig


def _part(part: Mapping[str, Any]) -> figure:
    """Errors of a sweep over its one setting, as on the page of sweeps."""
    lines = SweepLines(part)
    lines.draw(part)
    return lines.figure


def _names(target: str) -> list[str]:
    return [TRUTH, *observers_of(target)]
