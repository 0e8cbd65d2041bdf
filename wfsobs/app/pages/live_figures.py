"""The figures of the live loop: traces that roll, spectra, latencies, and the star on the detector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from bokeh.models import ColumnDataSource, Range1d, Span
from bokeh.plotting import figure

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.style import look
from wfsobs.app.views.envelope import envelope, envelope_times
from wfsobs.app.views.lines import FigureLines
from wfsobs.app.views.plots import new_figure
from wfsobs.app.work import TRUTH
from wfsobs.latencies import EDGES
from wfsobs.live.board import SLOTS, Board
from wfsobs.live.view import LiveEvent, LiveView
from wfsobs.signal.welch import welch_psd
from wfsobs.typing import Array

BINS = 300
"""Pairs of extremes of a trace."""
MEMORY = 5.0
"""Time over which spectra are averaged: those of earlier times fade exponentially [s]."""
DECADES = 7
"""Of the axis of spectra."""
COARSE = 20
"""Bins of the histogram of latencies that are drawn as one."""
TRAIL, POINTS = 0.2, 60
"""Length of the trail of the star [s], and its points."""
NAMES = (TRUTH, *SLOTS)


class LiveFigure:
    """A figure with a line per observer, each made when it is first shown."""

    def __init__(self, fig: figure):
        self.figure = fig
        self.sources = {name: ColumnDataSource({"x": [], "y": []}) for name in NAMES}
        self.lines = FigureLines(fig, {name: (source, "y") for name, source in self.sources.items()})

    def put(self, data: Mapping[str, tuple[Array, Array]], dark: bool) -> None:
        """Show these lines, x and y by name, and no others."""
        for name, (x, y) in data.items():
            self.sources[name].data = {"x": x.astype(np.float32), "y": y.astype(np.float32)}
        self.lines.restyle(dark, [name for name in NAMES if name not in data])


class RollingTraces(LiveFigure):
    """The last seconds of errors, or of estimates and truth."""

    def __init__(self) -> None:
        super().__init__(new_figure(x_range=Range1d(start=0.0, end=1.0), y_range=Range1d(start=-1.0, end=1.0)))
        self.figure.xaxis.axis_label = "time of the loop [s]"
        self._marks = ColumnDataSource({"x": [], "line": []})
        self.figure.vspan(x="x", source=self._marks, line_color="#B84A00", line_dash=[2, 2])
        self.figure.text(
            "x", 0, text="line", source=self._marks, angle=np.pi / 2, text_font_size="11px", text_color="#B84A00", x_offset=12
        )

    def draw(
        self, view: LiveView, target: str, names: Sequence[str], display: Display, scale: float, events: Sequence[LiveEvent]
    ) -> None:
        """Send the window; scale : of micrometres in the unit shown."""
        column, last = display.column, view.first + view.n
        times = envelope_times(view.first, last, BINS, view.dt)

        def trace(x: Array) -> tuple[Array, Array]:
            return times, scale * envelope(x[:, column], BINS)

        take = view.error if display.error else view.estimate
        data = {name: trace(take(name, target)) for name in names}
        if not display.error:
            data = {TRUTH: trace(view.truth(target)), **data}
        self.put(data, display.dark)
        top = 1.1 * max((float(np.nanmax(np.abs(y))) for _, y in data.values() if np.isfinite(y).any()), default=1.0) or 1.0
        self.figure.x_range.update(start=view.first * view.dt, end=last * view.dt)
        self.figure.y_range.update(start=-top, end=top)
        what = "error of" if display.error else ""
        self.figure.yaxis.axis_label = f"{what} {display.mode_label} [{display.unit_label}]".strip()
        shown = [event for event in events if view.first <= event.frame <= last]
        self._marks.data = {"x": [event.frame * view.dt for event in shown], "line": [event.line[:40] for event in shown]}


class RollingSpectra(LiveFigure):
    """Spectra of the errors, averaged over time with weights that fade."""

    def __init__(self) -> None:
        super().__init__(
            new_figure(
                x_range=Range1d(start=1.0, end=500.0),
                y_range=Range1d(start=1e-6, end=1.0),
                x_axis_type="log",
                y_axis_type="log",
            )
        )
        self.figure.xaxis.axis_label = "frequency [Hz]"
        self._sums: dict[str, Array] = {}
        self._of: tuple[object, ...] = ()
        self._last = 0

    def draw(self, view: LiveView, target: str, names: Sequence[str], display: Display, scale: float) -> None:
        """Take what is new into the average, and send it."""
        of, last = (id(view.frames.z.shape), target, display.column, display.error)[1:], view.first + view.n
        if of != self._of or last < self._last:
            self._sums, self._of, self._last = {}, of, 0
        n = min(view.n, round(1.0 / view.dt))
        if n < 64 or last - self._last < n // 2:
            return
        share = 1.0 - np.exp(-(last - max(self._last, last - n)) * view.dt / MEMORY)
        self._last = last
        take = view.error if display.error else view.estimate
        signals = {name: take(name, target)[-n:, display.column] for name in names}
        if not display.error:
            signals[TRUTH] = view.truth(target)[-n:, display.column]
        data = {}
        for name, x in signals.items():
            if np.isnan(x).any():
                continue
            frequency, density = welch_psd(x[:, None], view.dt, 1.0 / (n * view.dt))
            before = self._sums.get(name, density[:, 0])
            now = self._sums[name] = (
                before + share * (density[:, 0] - before) if before.shape == density[:, 0].shape else density[:, 0]
            )
            data[name] = frequency[1:], scale**2 * now[1:]
        self.put(data, display.dark)
        top = 3.0 * max((float(y.max()) for _, y in data.values()), default=1.0) or 1.0
        self.figure.x_range.update(start=1.0, end=0.5 / view.dt)
        self.figure.y_range.update(start=top * 10.0**-DECADES, end=top)
        self.figure.yaxis.axis_label = f"PSD, {display.mode_label} [{display.unit_label}²/Hz]"


class LatencyHistogram(LiveFigure):
    """How long the steps of each observer take, beside the time of a frame."""

    def __init__(self) -> None:
        super().__init__(
            new_figure(x_range=Range1d(start=1.0, end=1e5), y_range=Range1d(start=0.0, end=100.0), x_axis_type="log")
        )
        self._limit = Span(location=1000.0, dimension="height", line_dash=[6, 3], line_color="#888888")
        self.figure.add_layout(self._limit)
        self.figure.xaxis.axis_label, self.figure.yaxis.axis_label = "time of a step [µs]", "share of frames [%]"
        edges = 1e6 * EDGES[::COARSE]
        self._x = np.repeat(edges, 2)[1:-1]

    def draw(self, board: Board, names: Sequence[str], dt: float, dark: bool) -> None:
        """Send the histograms since the start."""
        self._limit.location = 1e6 * dt
        data = {}
        for name in names:
            counts = board[name].latencies.counts[1:-1]
            shares = 100.0 * np.add.reduceat(counts, np.arange(0, len(counts), COARSE)) / max(1, counts.sum())
            data[name] = self._x, np.repeat(shares, 2)
        self.put(data, dark)
        top = 1.1 * max((float(y.max()) for _, y in data.values()), default=1.0) or 1.0
        self.figure.y_range.update(end=top)


class Detector:
    """Where the star is on the detector: as it comes, and behind a mirror that takes an observer's estimate off."""

    def __init__(self) -> None:
        options = {"x_range": Range1d(start=-1.0, end=1.0), "y_range": Range1d(start=-1.0, end=1.0)}
        self.figure: figure = new_figure(**options)
        self.figure.update(height=None, aspect_ratio=1.0, max_width=380, min_width=200)
        self.figure.xaxis.axis_label, self.figure.yaxis.axis_label = "tip [mas]", "tilt [mas]"
        self._trails = [ColumnDataSource({"x": [], "y": []}) for _ in range(2)]
        self._spots = [ColumnDataSource({"x": [], "y": []}) for _ in range(2)]
        for trail, spot, colour in zip(self._trails, self._spots, ("#888888", "#003DE6"), strict=True):
            self.figure.line("x", "y", source=trail, line_color=colour, line_alpha=0.5)
            mark = self.figure.scatter("x", "y", source=spot, size=16, fill_color=colour, line_color=colour, fill_alpha=0.6)
            self._mark = mark.glyph
        self._top = 1.0

    def draw(self, view: LiveView, name: str, diameter: float, dark: bool) -> None:
        """Send the last instants; name : observer whose estimate is taken off."""
        scale, n = per_micrometre("mas", diameter), max(2, round(TRAIL / view.dt))
        total = view.truth("turbulence") + view.truth("vibration")
        if np.isnan(total).all():
            total, left = view.frames.z, view.error(name, "next")
        else:
            left = total - np.nan_to_num(view.estimate(name, "turbulence")) - np.nan_to_num(view.estimate(name, "vibration"))
        step = max(1, n // POINTS)
        for x, trail, spot in zip((total, left), self._trails, self._spots, strict=True):
            points = scale * x[-n:, :2]
            trail.data = {"x": points[::step, 0], "y": points[::step, 1]}
            spot.data = {"x": points[-1:, 0], "y": points[-1:, 1]}
        reach = 1.1 * float(np.nanmax(np.abs(scale * total[:, :2]), initial=1e-3))
        if not self._top / 1.6 < reach < self._top:
            self._top = 1.25 * reach
            for axis in (self.figure.x_range, self.figure.y_range):
                axis.update(start=-self._top, end=self._top)
        colour = look(name).colour(dark)
        self._mark.update(fill_color=colour, line_color=colour)
