"""The figures of the live loop: traces that roll, spectra, latencies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from bokeh.core.validation import silence
from bokeh.core.validation.warnings import MISSING_RENDERERS
from bokeh.models import ColumnDataSource, Range1d, Span
from bokeh.plotting import figure

from wfsobs.app.display import Display
from wfsobs.app.pages.live_paint import Painter
from wfsobs.app.views.envelope import envelope, envelope_times
from wfsobs.app.views.lines import FigureLines
from wfsobs.app.views.plots import new_figure
from wfsobs.app.views.traces import WINDOW_S
from wfsobs.app.work import TRUTH
from wfsobs.evaluation.error_spectra import cumulative_rms
from wfsobs.evaluation.recovery import trailing_rms
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.latencies import EDGES
from wfsobs.live.alarms import ALARM
from wfsobs.live.board import SLOTS, Board
from wfsobs.live.finding import Bounds
from wfsobs.live.spectrum_of_minute import bridge_missing
from wfsobs.live.view import LiveEvent, LiveView
from wfsobs.signal.welch import welch_psd
from wfsobs.typing import Array

BINS = 300
"""Pairs of extremes of a trace."""
MEMORY = 5.0
"""Time over which spectra are averaged: those of earlier times fade exponentially [s]."""
DECADES = 7
"""Of the axis of spectra."""
ROOM = 30
"""Characters of an event that the height of a figure takes."""
CLOSE = 0.05
"""Part of the window within which the words of two events would cover each other."""
COARSE = 20
"""Bins of the histogram of latencies that are drawn as one."""
NAMES = (TRUTH, *BOUNDS, *SLOTS)
silence(MISSING_RENDERERS)  # of figures whose lines are made when they are first shown


class LiveFigure:
    """A figure with a line per observer, each made when it is first shown."""

    def __init__(self, fig: figure, painter: Painter):
        self.figure, self.painter = fig, painter
        self.sources = {name: ColumnDataSource({"x": [], "y": []}) for name in NAMES}
        self.lines = FigureLines(fig, {name: (source, "y") for name, source in self.sources.items()})
        self._style: tuple[bool, set[str]] = (False, set())

    def put(self, data: Mapping[str, tuple[Array, Array]], dark: bool) -> None:
        """Show these lines, x and y by name, and no others."""
        for name, (x, y) in data.items():
            self.painter.data(self.figure, self.sources[name], {"x": x, "y": y})
        if (style := (dark, set(data))) != self._style:
            self._style = style
            self.lines.restyle(dark, [name for name in NAMES if name not in data])


class LiveMarks:
    """When something happened: lines over the traces, with words up from the bottom where there is room beside each other."""

    def __init__(self, fig: figure):
        self._source = ColumnDataSource({"x": [], "line": []})
        fig.extra_y_ranges = {"height": Range1d(start=0.0, end=1.0)}
        at: dict[str, Any] = {"source": self._source, "level": "annotation"}
        fig.vspan(x="x", line_color="#B84A00", line_dash=[2, 2], **at)
        words = {"angle": np.pi / 2, "text_font_size": "11px", "text_color": "#B84A00", "x_offset": 12, "y_range_name": "height"}
        fig.text("x", 0.02, text="line", **at, **words)

    def draw(self, events: Sequence[LiveEvent], dt: float, close: float) -> None:
        """Send them; of those within `close` [s] the first has words."""
        times, lines, written = [], [], -np.inf
        for event in sorted(events):
            times.append(event.frame * dt)
            lines.append(short_line(event.line) if times[-1] - written > close else "")
            written = times[-1] if lines[-1] else written
        marks: dict[str, Any] = {"x": times, "line": lines}
        if marks != self._source.data:
            self._source.data = marks


def short_line(line: str) -> str:
    """Return what of an event there is room for in a figure; all of it is in the list of events.

    >>> short_line("ALARM error of kf-lgs up: 29.7 nm, it was 19.6 nm"), short_line("over: error of kf-lgs")
    ('ALARM error of kf-lgs up', 'over: error of kf-lgs')
    >>> short_line("peak from 47.50 to 50.50 Hz, 30.0 nm")
    'peak from 47.50 to 50.50 Hz'
    >>> short_line("/dev/shm/aol1_modevalOL.im.shm: no frame for 0.1 s")
    'no frame for 0.1 s'
    """
    if len(line) <= ROOM:
        return line
    head, _, tail = line.rpartition(": ")
    parts = [head if line.startswith(ALARM) else tail, line.rpartition(", ")[0]]
    return next((part for part in parts if 0 < len(part) <= ROOM), line[: ROOM - 1] + "…")


class RollingTraces(LiveFigure):
    """The last seconds of errors, or of estimates and truth."""

    def __init__(self, painter: Painter) -> None:
        super().__init__(new_figure(x_range=Range1d(start=0.0, end=1.0), y_range=Range1d(start=-1.0, end=1.0)), painter)
        self.figure.xaxis.axis_label = "time of the loop [s]"
        self._marks = LiveMarks(self.figure)

    @staticmethod
    def run_in(display: Display) -> float:
        """How much before the window is needed [s]."""
        return WINDOW_S if display.running else 0.0

    def draw(
        self,
        view: LiveView,
        n: int,
        target: str,
        names: Sequence[str],
        display: Display,
        scale: float,
        events: Sequence[LiveEvent],
        bounds: Bounds,
    ) -> None:
        """Send the last `n` frames of the view; scale : of micrometres in the unit shown; bounds : of a running rms."""
        last = view.first + view.n
        first = max(view.first, last - n)
        times = envelope_times(first, last, BINS, view.dt)

        def trace(x: Array) -> Array:
            if display.running:
                x = trailing_rms(x, min(round(WINDOW_S / view.dt), len(x)))
            return envelope(x[first - view.first :, display.column], BINS)

        def drawn(name: str) -> tuple[Array, Array]:
            key = ("trace", name, target, display.column, display.show, first)
            return times, scale * view.once(key, lambda: trace(shown_signal(view, name, target, display)))

        data = {name: drawn(name) for name in ([] if display.error else [TRUTH]) + [*names]}
        top = 1.1 * max((float(np.nanmax(np.abs(y))) for _, y in data.values() if np.isfinite(y).any()), default=1.0) or 1.0
        if display.running:
            ends = times[[0, -1]]
            data |= {name: (ends, np.full(2, scale * of[target][display.column])) for name, of in bounds.items() if target in of}
        self.put(data, display.dark)
        self.painter.update(self.figure, self.figure.x_range, start=first * view.dt, end=last * view.dt)
        self.painter.update(self.figure, self.figure.y_range, start=0.0 if display.running else -top, end=top)
        what = "running rms of error of" if display.running else "error of" if display.error else ""
        self.figure.yaxis.axis_label = f"{what} {display.mode_label} [{display.unit_label}]".strip()
        self._marks.draw([event for event in events if first <= event.frame <= last], view.dt, CLOSE * n * view.dt)


class RollingSpectra(LiveFigure):
    """Spectra of the errors, averaged over time with weights that fade."""

    def __init__(self, painter: Painter) -> None:
        super().__init__(
            new_figure(
                x_range=Range1d(start=1.0, end=500.0),
                y_range=Range1d(start=1e-6, end=1.0),
                x_axis_type="log",
                y_axis_type="log",
            ),
            painter,
        )
        self.figure.xaxis.axis_label = "frequency [Hz]"
        self._sums: dict[str, Array] = {}
        self._of: tuple[object, ...] = ()
        self._last = 0

    def draw(self, view: LiveView, target: str, names: Sequence[str], display: Display, scale: float) -> None:
        """Take what is new into the average, and send it."""
        of, last = (target, display.column, display.error), view.first + view.n
        if of != self._of or last < self._last:
            self._sums, self._of, self._last = {}, of, 0
        n = min(view.n, round(1.0 / view.dt))
        if n < 64 or last // (n // 2) == self._last // (n // 2):  # all pages at the same time
            return
        share = 1.0 - np.exp(-(last - max(self._last, last - n)) * view.dt / MEMORY)
        self._last = last
        data = {}
        for name in [*names, *([] if display.error else [TRUTH])]:
            found = view.once(("spectrum", name, *of, n), partial(_last_spectrum, view, name, target, display, n))
            if found is None:
                continue
            frequency: Array = found[0]
            density: Array = found[1]
            before = self._sums.get(name, density)
            now = self._sums[name] = before + share * (density - before) if before.shape == density.shape else density
            of_errors = scale * cumulative_rms(frequency[1:], now[1:]) if display.cumulative else scale**2 * now[1:]
            data[name] = frequency[1:], of_errors
        self.put(data, display.dark)
        top = 3.0 * max((float(y.max()) for _, y in data.values()), default=1.0) or 1.0
        self.figure.x_range.update(start=1.0, end=0.5 / view.dt)
        self.figure.y_range.update(start=top * 10.0 ** -(DECADES / 2 if display.cumulative else DECADES), end=top)
        of, unit = " of error" if display.error else "", display.unit_label
        what = (f"cumulative rms{of}", unit) if display.cumulative else (f"PSD{of}", f"{unit}²/Hz")
        self.figure.yaxis.axis_label = f"{what[0]}, {display.mode_label} [{what[1]}]"


def shown_signal(view: LiveView, name: str, target: str, display: Display) -> Array:
    """Return what a line is of: the truth, or an observer's error or estimate, (n, n_modes) [um]."""
    if name == TRUTH:
        return view.truth(target)
    return view.error(name, target) if display.error else view.estimate(name, target)


def _last_spectrum(view: LiveView, name: str, target: str, display: Display, n: int) -> tuple[Array, Array] | None:
    """Return frequencies [Hz] and the spectrum of the last n frames [um^2/Hz]; None where too many are missing."""
    x = bridge_missing(shown_signal(view, name, target, display)[-n:, display.column])
    if x is None:
        return None
    frequency, density = welch_psd(x[:, None], view.dt, 1.0 / (n * view.dt))
    return frequency, density[:, 0]


class LatencyHistogram(LiveFigure):
    """How long the steps of each observer take, beside the time of a frame."""

    def __init__(self, painter: Painter) -> None:
        super().__init__(
            new_figure(x_range=Range1d(start=1.0, end=1e5), y_range=Range1d(start=0.0, end=100.0), x_axis_type="log"), painter
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
