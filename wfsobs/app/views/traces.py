"""Time traces: one figure per target, sharing their time axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from bokeh.models import BoxAnnotation, ColumnDataSource, CrosshairTool, GlyphRenderer, Label, Range1d, Span, Text, VSpan, VStrip
from bokeh.plotting import figure

from wfsobs.app.display import Display
from wfsobs.app.service import BackgroundTask
from wfsobs.app.style import look, observers_of
from wfsobs.app.views.plots import (
    ComparedLines,
    EndLabels,
    FigureLines,
    in_view,
    new_figure,
    on_settle,
    send,
    show_all_on_double_click,
    zoom_of,
)
from wfsobs.app.views.target_figures import TargetFigures, shows_error
from wfsobs.app.work import TRUTH, RunResults
from wfsobs.evaluation.recovery import trailing_rms
from wfsobs.evaluation.scores import half_width
from wfsobs.observers.base import TARGETS
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.events import LASER, PEAK, WIND, Event
from wfsobs.signal.envelope import band_envelope, envelope, envelope_times
from wfsobs.typing import Array

COLOURS = {False: "#7A1FA2", True: "#E0B3FF"}
"""In light and dark mode."""

LEVELS = 3
"""Words one below the other before they start at the top again."""

LINE_PX = 13
WORD = 0.25
"""How wide a word is at most, as a share of the record."""


def word(event: Event, scenario: Scenario) -> str:
    """Name an event in a word or two.

    >>> word(Event(kind="peak", frequency_shift=3.0), Scenario()), word(Event(kind="laser", lasers=2), Scenario())
    ('47.5 Hz peak +3 Hz', '2 LGS out')
    """
    if event.kind == PEAK:
        moves = f" {event.frequency_shift:+g} Hz" if event.frequency_shift else ""
        grows = f" × {event.strength:g}" if event.strength != 1.0 else ""
        return f"{scenario.vibration.peaks[event.peak].frequency:.3g} Hz peak{moves}{grows}".replace("-", "−")
    if event.kind == WIND:
        return f"wind × {event.wind_factor:g}"
    if event.kind == LASER:
        return f"{event.lasers} LGS out"
    return f"{100 * event.share:g} % {event.sensor.upper()} lost"


def events_of(results: RunResults) -> list[Event]:
    """By their start, of the simulation; a record that was loaded has none."""
    return [] if results.simulation is None else sorted(results.simulation.events, key=lambda e: e.start)


def room(results: RunResults) -> float:
    """Compute the height of the words above the lines, as a share of the axis."""
    return 0.1 * (1 + max(levels(results), default=-1))


def levels(results: RunResults) -> list[int]:
    """How many lines below the top the word of each event stands, so that none stands in the one before."""
    out, before = [], -math.inf
    for event in events_of(results):
        near = event.start - before < WORD * results.scenario.run.duration
        out.append((out[-1] + 1) % LEVELS if near else 0)
        before = event.start
    return out


class EventMarks:
    """The marks in one figure, none until there is an event; words hang from the top of its axis."""

    def __init__(self, fig: figure):
        self.figure = fig
        self._marks_exist = False
        self.jumps: Final = ColumnDataSource({"x": []})
        self.spans: Final = ColumnDataSource({"start": [], "end": []})
        self.words: Final = ColumnDataSource({"x": [], "y": [], "text": [], "below": []})
        self._line = VSpan(x="x", line_width=1.5, line_dash=[6, 3])
        self._strip = VStrip(x0="start", x1="end", fill_alpha=0.13, line_width=0)
        self._text = Text(x="x", y="y", text="text", x_offset=4, y_offset="below", text_baseline="top", text_font_size="11px")

    def draw(self, results: RunResults, dark: bool) -> None:
        """Show those of the results."""
        events = events_of(results)
        if not events and not self._marks_exist:
            return
        self._make()
        lasting = [e for e in events if e.duration > 0]
        send(self.jumps, {"x": [e.start for e in events if not e.duration > 0]})
        send(self.spans, {"start": [e.start for e in lasting], "end": [e.start + e.duration for e in lasting]})
        _, top = in_view(self.figure.y_range)
        send(
            self.words,
            {
                "x": [e.start for e in events],
                "y": [top] * len(events),
                "text": [word(e, results.scenario) for e in events],
                "below": [2 + LINE_PX * level for level in levels(results)],
            },
        )
        self.restyle(dark)

    def _make(self) -> None:
        if not self._marks_exist:
            self._marks_exist = True
            self.figure.add_glyph(self.spans, self._strip, level="underlay")
            self.figure.add_glyph(self.jumps, self._line)
            self.figure.add_glyph(self.words, self._text, level="overlay")

    def restyle(self, dark: bool) -> None:
        """Set the colour of light or dark mode."""
        self._line.line_color = self._strip.fill_color = self._text.text_color = COLOURS[dark]


BINS = 500
"""Pairs of extremes per figure, about one per pixel."""

MARGIN = 0.25
"""What is sent beyond either side of a zoomed window, as a share of it: a pan shows something at once."""

WINDOW_S = 1.0
"""Over which the running rms of an error is taken [s]."""

FIRST_S = 2.0
"""How much of a record is shown at first [s]: of ten seconds a vibration is a block."""


class Traces(TargetFigures):
    """The figures, redrawn when the results, the switches or the window change."""

    def __init__(self, run: BackgroundTask, display: Display):
        self.x_range: Final = Range1d(start=0.0, end=10.0, reset_start=0.0, reset_end=10.0)
        self.length: float = 0.0
        self._wanted_window: tuple[float, float] | None = None
        crosshair = CrosshairTool(dimensions="height", overlay=Span(dimension="height", line_alpha=0.4, line_width=1))
        self.traces: Final = {target: _Trace(target, self.x_range, crosshair) for target in TARGETS}
        super().__init__(run, display, self.traces, ["mode", "show", "unit", "compared_runs"])
        on_settle([self.x_range], self._redraw)

    def _draw(self, results: RunResults) -> None:
        record = results.result.record
        length = record.n_steps * record.dt
        if length != self.length:
            whole = self.length > 0 and zoom_of(self.x_range) is None  # stays so
            self.length = length
            start, end = self._wanted_window or ((0.0, length) if whole else first_window(results))
            self._wanted_window = None
            self.x_range.update(start=start, end=min(end, length), reset_start=0.0, reset_end=length)
        first, last = self._window(record.n_steps, record.dt)
        for trace in self.traces.values():
            trace.draw(results, self.display, first, last)

    def _window(self, n_steps: int, dt: float) -> tuple[int, int]:
        """Find the samples to send: those in view and a margin."""
        start, end = in_view(self.x_range)
        margin = 0.0 if end - start >= self.length else MARGIN * (end - start)
        first = max(int((start - margin) / dt), 0)
        return min(first, n_steps - 2), min(max(int((end + margin) / dt) + 2, 2), n_steps)

    def open_window(self, window: tuple[float, float] | None) -> None:
        """Show a stretch of the record [s], that of a fresh page if None; with the first results where there are none yet."""
        if self.run.result is None or not self.length:
            self._wanted_window = window
        else:
            start, end = window or first_window(self.run.result)
            self.x_range.update(start=start, end=min(end, self.length))

    def chosen_window(self) -> tuple[float, float] | None:
        """Return the stretch in view [s]; None where it is that of a fresh page."""
        if self.run.result is None or not self.length:  # nothing has been drawn yet
            return self._wanted_window
        start, end = in_view(self.x_range)
        first = first_window(self.run.result)
        return None if abs(start - first[0]) + abs(end - first[1]) < 1e-9 else (start, end)

    def zoom(self, seconds: float | None) -> None:
        """Show a stretch of the record around the middle of the one in view, or all of it."""
        length = min(seconds or self.length, self.length)
        middle = 0.5 * sum(in_view(self.x_range))
        start = min(max(middle - 0.5 * length, 0.0), self.length - length)
        self.x_range.update(start=start, end=start + length)


class _Band:
    """The band around a line that is alone, and what it is in words; no band in the figure until there is one."""

    def __init__(self, fig: figure):
        self.figure, self.source = fig, ColumnDataSource({"x": [], "low": [], "high": []})
        self.renderer: GlyphRenderer[Any] | None = None
        place = {"x": 6, "y": 6, "x_units": "screen", "y_units": "screen", "text_font_size": "12px"}
        self.label = Label(text="95 % band predicted by the filter", visible=False, **place)
        fig.add_layout(self.label)  # from the start: the browser looks for it in vain if it comes later

    def draw(self, x: Array, low: Array, high: Array, colour: str) -> None:
        """Shade what is between two edges."""
        send(self.source, {"x": x, "low": low.astype(np.float32), "high": high.astype(np.float32)})
        if self.renderer is None:
            look_of = {"fill_alpha": 0.2, "name": "band", "level": "underlay"}
            self.renderer = self.figure.varea("x", "low", "high", source=self.source, **look_of)
        self.renderer.glyph.fill_color = self.label.text_color = colour
        self.renderer.visible = self.label.visible = True

    def hide(self) -> None:
        """Show no band."""
        if self.renderer is not None:
            self.renderer.visible = self.label.visible = False


class _Trace:
    """One figure: the truth and the estimates of one target, all lines in one data source."""

    def __init__(self, target: str, x_range: Range1d, crosshair: CrosshairTool):
        self.target = target
        self.names = [TRUTH, *observers_of(target)]
        self.source = ColumnDataSource({"x": [], **{name: [] for name in self.names}})
        self.figure = new_figure(x_range, (-1.0, 1.0), "time [s]")
        self.figure.add_tools(crosshair)
        show_all_on_double_click(self.figure)
        self.warm_up = BoxAnnotation(left=0, right=0, fill_color="#808080", fill_alpha=0.10, line_width=0, level="underlay")
        self.figure.add_layout(self.warm_up)
        self.lines = FigureLines(self.figure, {name: (self.source, name) for name in self.names})
        self.faint = ComparedLines(self.figure)
        self.names_at_end = EndLabels(self.figure)
        self.events = EventMarks(self.figure)
        self.band = _Band(self.figure)

    def draw(self, results: RunResults, display: Display, first: int, last: int) -> None:
        """Send the samples first ... last - 1 of every line."""
        scale = display.scale(results.scenario)
        data: dict[str, Any] = {"x": envelope_times(first, last, BINS, results.result.record.dt)}
        nothing = np.full(len(data["x"]), np.nan, np.float32)
        for name, line in self.lines.items():  # what is hidden is sent when it is shown
            values = _line(results, name, self.target, display, first, last) if line.visible else None
            data[name] = nothing if values is None else (scale * envelope(values, BINS)).astype(np.float32)
        send(self.source, data)
        warm_up = results.scenario.run.warm_up
        self.warm_up.right = warm_up
        settled = warm_up + WINDOW_S * display.running
        error = shows_error(results, self.target, display)
        extra = self._draw_compared(display, error, data["x"]) + self._draw_band(results, display, first, last, data["x"])
        self._fit(data, settled, extra, room(results))
        shown = {name: (data["x"], data[name]) for name, line in self.lines.items() if line.visible and not line.recedes}
        self.names_at_end.draw(shown, display.dark)
        self.events.draw(results, display.dark)
        what = f"{'running rms of ' if error and display.running else ''}{'error of ' if error else ''}{display.mode_label}"
        self.figure.yaxis.axis_label = f"{what} [{display.unit_label}]"

    def _draw_band(self, results: RunResults, display: Display, first: int, last: int, times: Array) -> list[tuple[Array, Array]]:
        """Shade the 95 % band of the one observer that is shown, where it states one; its edges."""
        shown = [name for name, line in self.lines.items() if line.visible and name != TRUTH]
        sd = results.sd(shown[0], self.target) if len(shown) == 1 and not display.running else None
        if sd is None:
            self.band.hide()
            return []
        scale, cut = display.scale(results.scenario), slice(first, last)
        half = half_width(0.95) * sd[cut, display.column]
        values = None if shows_error(results, self.target, display) else results.values(shown[0], self.target)
        middle = 0.0 if values is None else values[cut, display.column]
        low, high = (scale * edge for edge in band_envelope(middle - half, middle + half, BINS))
        self.band.draw(times, low, high, look(shown[0]).colour(display.dark))
        return [(times, low), (times, high)]

    def _draw_compared(self, display: Display, error: bool, times: Array) -> list[tuple[Array, Array]]:
        """Send the compared runs' visible lines, errors beside errors, from the first to the last of the times; what was sent."""
        lines: list[tuple[str, str, Array, Array]] = []
        for run, kept in display.runs_drawn if not display.running else []:  # what is kept are extremes, of which there is no rms
            first, last = np.searchsorted(kept.times, [times[0], times[-1]])
            cut = slice(first, last + 1)
            x = _times_of_envelope(kept.times[cut])
            scale = display.scale(run.scenario)
            for name, line in self.lines.items():
                values = (kept.errors if error else kept.signals).get((name, self.target))
                if line.visible and values is not None:
                    lines.append((run.letter, name, x, scale * envelope(values[cut, display.column].astype(np.float64), BINS)))
        self.faint.draw_runs(lines, display.dark)
        return [(x, y) for _, _, x, y in lines]

    def _fit(self, data: dict[str, Any], warm_up: float, extra: Sequence[tuple[Array, Array]], above: float) -> None:
        """Have the axis hold every visible line; what a filter does while it settles does not count."""
        counted = data["x"] >= warm_up
        if not counted.any():
            counted[:] = True
        lines = [data[name][counted] for name, line in self.lines.items() if line.visible]
        lines += [y[x >= warm_up] for x, y in extra]
        values = np.concatenate(lines) if lines else np.empty(0)
        values = values[np.isfinite(values)]
        if values.size:
            low, high = float(values.min()), float(values.max())
            pad = 0.05 * (high - low) or 1.0
            self.figure.y_range.update(start=low - pad, end=high + pad + above * (high - low))


def first_window(results: RunResults) -> tuple[float, float]:
    """Choose what is shown of a record at first [s]: around its first event, or the middle of what counts."""
    record = results.result.record
    length = record.n_steps * record.dt
    events = events_of(results)
    middle = events[0].start if events else 0.5 * (results.scenario.run.warm_up + length)
    start = max(min(middle - 0.5 * FIRST_S, length - FIRST_S), 0.0)
    return start, min(start + FIRST_S, length)


def _times_of_envelope(times: Array) -> Array:
    """Compute the times of an envelope of samples that are a run of times themselves."""
    if times.size <= 2 * BINS:
        return times
    return np.interp(envelope_times(0, times.size, BINS, 1.0), np.arange(times.size), times)


def _line(results: RunResults, name: str, target: str, display: Display, first: int, last: int) -> Array:
    """Compute the samples of one line [um], NaN where there is nothing to draw."""
    values, truth = results.values(name, target), results.values(TRUTH, target)
    nothing = np.full(last - first, np.nan)
    if values is None:
        return nothing
    n = max(round(WINDOW_S / results.result.record.dt), 1)
    before = min(n - 1, first) if display.running and truth is not None else 0
    cut = slice(first - before, last), slice(display.column, display.column + 1)
    if truth is None or not display.error:
        return values[cut][:, 0]
    if name == TRUTH:
        return nothing
    error = values[cut] - truth[cut]
    if display.running:  # where there is no estimate yet, that of a while ago is not results in its place
        error = np.where(np.isnan(error), np.nan, trailing_rms(error, n))
    return error[before:, 0]
