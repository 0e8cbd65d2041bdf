"""A figure per target, which rests while it is hidden: its time traces and its spectra."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any, Final

import numpy as np
import panel as pn
from bokeh.models import BoxAnnotation, ColumnDataSource, CrosshairTool, GlyphRenderer, Label, Range1d, Span, Text, VStrip
from bokeh.plotting import figure

from wfsobs.app.compared import ComparedRun, DrawnLines
from wfsobs.app.display import Display
from wfsobs.app.render import number
from wfsobs.app.service import BackgroundTask
from wfsobs.app.style import follow_html, look, observers_of, sheets, swatch
from wfsobs.app.views.plots import (
    FONT,
    ComparedLines,
    EndLabels,
    FigureLines,
    Points,
    add_marks,
    in_view,
    model_mark,
    new_figure,
    new_spectrum,
    on_settle,
    peak_marks,
    send,
    set_ends,
    show_all_on_double_click,
    zoom_of,
)
from wfsobs.app.work import TRUTH, Key, RunResults, SignalAndError
from wfsobs.evaluation.exact_errors import band_rms, spectra
from wfsobs.evaluation.scores import half_width, trailing_rms
from wfsobs.observers.base import TARGETS, VIBRATION, Look
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.events import LASER, PEAK, WIND, Event
from wfsobs.signal.envelope import band_envelope, envelope, envelope_times
from wfsobs.typing import Array

FLEXIBLE = ":host > div { flex: 1 1 240px; width: auto !important; }"
"""Style of what shares a row with a switch."""

AXIS_TEXT: Mapping[str, Any] = {
    "major_label_text_font": FONT,
    "major_label_text_font_size": "0.925em",
    "axis_label_text_font": FONT,
    "axis_label_text_font_size": "1em",
    "axis_label_text_font_style": "normal",
    "axis_label_standoff": 12,
}
"""Text of axes as the theme of the page sets it: where it sets another the page is laid out anew."""


class TargetFigure(FigureLines):
    """One figure: the truth and the estimates of one target, those of the compared runs, and the names of the lines."""

    def __init__(self, target: str, fig: figure, source: ColumnDataSource | None = None):
        super().__init__(fig, (TRUTH, *observers_of(target)), source)
        self.target = target
        show_all_on_double_click(fig)
        self.faint: Final = ComparedLines(fig)
        self.names_at_end: Final = EndLabels(fig)

    def draw_compared(self, display: Display, points: Callable[[ComparedRun, DrawnLines, str], Points | None]) -> list[Points]:
        """Send the compared runs' visible lines; return them. points : returns x and y of one, or None."""
        lines = [
            (run.letter, name, *found)
            for run, kept in display.runs_drawn
            for name, line in self.lines.items()
            if line.visible and (found := points(run, kept, name)) is not None
        ]
        self.faint.draw_runs(lines, display.dark)
        return [(x, y) for _, _, x, y in lines]

    def name_ends(self, lines: Mapping[str, Points], dark: bool) -> None:
        """Name the lines that do not recede."""
        self.names_at_end.draw({name: points for name, points in lines.items() if not self.lines[name].recedes}, dark)


class TargetFigures(ABC):
    """A figure per target, drawn when results or switches change while the page shows them."""

    def __init__(self, run: BackgroundTask, display: Display, drawings: Mapping[str, TargetFigure], switches: Sequence[str]):
        """Watch the results and the switches of the display; drawings : target -> its figure."""
        self.run: Final = run
        self.display: Final = display
        self._drawings = drawings
        self.visible: bool = True
        self._behind = False
        run.param.watch(self._redraw, "result")
        display.param.watch(self._redraw, [*switches, "dark", "hidden_lines", "named_lines"])

    def pane(self, target: str) -> pn.pane.Bokeh:
        """Return the figure of one target."""
        fig = self._drawings[target].figure
        fig.sizing_mode = "stretch_both"
        for axis in fig.axis:
            axis.update(**AXIS_TEXT)
        return pn.pane.Bokeh(fig, sizing_mode="stretch_both", margin=0)

    def show(self, visible: bool) -> None:
        """Draw what has come meanwhile, and go on while visible."""
        self.visible = visible
        if visible and self._behind:
            self._redraw()

    def _redraw(self, *_: object) -> None:
        results = self.run.result
        self._behind = not self.visible
        if results is not None and self.visible:
            with pn.io.hold():
                for target, drawing in self._drawings.items():
                    hidden, named = (lines.get(target, []) for lines in (self.display.hidden_lines, self.display.named_lines))
                    drawing.restyle(self.display.dark, hidden, named)
                self._draw(results)

    @abstractmethod
    def _draw(self, results: RunResults) -> None:
        """Send the data of every figure, whose lines are shown or hidden by now."""


def shows_error(results: RunResults, target: str, display: Display) -> bool:
    """Whether errors are drawn: as chosen, where there is a truth to compare with."""
    return display.error and results.values(TRUTH, target) is not None


DECADES = 8
"""The most that an axis of densities spans; one of amplitudes spans half of it."""


class SpectraFigures(TargetFigures):
    """The figures, redrawn when the results or the switches change."""

    def __init__(self, run: BackgroundTask, display: Display, times: Range1d):
        """Watch the results, the switches, and the axis of time where only what it shows counts."""
        self.x_range: Final = Range1d(start=0.5, end=500.0, reset_start=0.5, reset_end=500.0)
        self.times = times
        self.spectra: Final = {target: _Spectrum(target, self.x_range) for target in TARGETS}
        super().__init__(run, display, self.spectra, ["mode", "show", "unit", "spectrum", "compared_runs", "window_spectra"])
        on_settle([times], lambda: self._redraw() if display.window_spectra else None)

    def _draw(self, results: RunResults) -> None:
        window = zoom_of(self.times) if self.display.window_spectra else None
        spectra = results.spectra if window is None else window_spectra(results, *window)
        for spectrum in self.spectra.values():
            spectrum.draw(results, spectra, self.display)
        frequencies = next((s.frequency for s in results.spectra.values()), None)
        if frequencies is not None:
            ends = float(frequencies[1]), float(frequencies[-1])
            if ends != (self.x_range.reset_start, self.x_range.reset_end):
                set_ends(self.x_range, *ends)


class _Spectrum(TargetFigure):
    """The spectra of the truth and of the estimates, or of their errors."""

    def __init__(self, target: str, x_range: Range1d):
        super().__init__(target, new_spectrum(x_range))
        self.marks = add_marks(self.figure) if target == VIBRATION else {}

    def draw(self, results: RunResults, spectra: Mapping[Key, SignalAndError], display: Display) -> None:
        """Send every line, its axis and the marks."""
        error = shows_error(results, self.target, display)
        drawn: dict[str, Points] = {}
        for name, source in self.sources.items():
            spectrum = spectra.get((name, self.target)) if self.lines[name].visible else None
            if spectrum is None:  # what is hidden is sent when it is shown
                send(source, {"x": [], "y": []})
                continue
            y = _curve(spectrum, error and name != TRUTH, display, results.scenario)
            send(source, {"x": spectrum.frequency[1:], "y": y})
            drawn[name] = spectrum.frequency[1:], y

        def compared(run: ComparedRun, lines_of_run: DrawnLines, name: str) -> Points | None:
            spectrum, of_error = lines_of_run.spectra.get((name, self.target)), error and name != TRUTH
            if spectrum is None or (of_error and not np.isfinite(spectrum.error).all()):  # errors beside errors alone
                return None
            return spectrum.frequency[1:], _curve(spectrum, of_error, display, run.scenario)

        self._fit([y for _, y in [*drawn.values(), *self.draw_compared(display, compared)]], display.cumulative)
        self.name_ends(drawn, display.dark)
        self.figure.yaxis.axis_label = display.curve_label(" of error" if error else "")
        if self.marks:
            found = {"peaks": drawn_peaks(results), "model": [model_mark(results.scenario)]}
            for name, marks in found.items():
                send(self.marks[name].data_source, {"x": [x for x, _ in marks], "text": [text for _, text in marks]})

    def _fit(self, lines: list[Array], cumulative: bool) -> None:
        """Have the axis hold every line, but for what lies too far below the highest."""
        positive = [y[y > 0] for y in lines if (y > 0).any()]
        if positive:
            low, high = min(float(np.quantile(y, 0.02)) for y in positive), max(float(y.max()) for y in positive)
            room, decades = (1.5, DECADES / 2) if cumulative else (3.0, DECADES)
            self.figure.y_range.update(start=max(low / room, high * 10.0**-decades), end=high * room)


def drawn_peaks(results: RunResults) -> list[tuple[float, str]]:
    """List the marked peaks; none of a record without truth, whose peaks are not those of the settings."""
    return peak_marks(results.scenario) if results.result.record.vibration is not None else []


def window_spectra(results: RunResults, start: float, end: float) -> dict[Key, SignalAndError]:
    """Compute the spectra of the truth and of every estimate between two times [s]; without those that are too short."""
    record = results.result.record
    cut = slice(max(round(start / record.dt), 0), round(end / record.dt) + 1)
    out: dict[Key, SignalAndError] = {}
    for (name, target), whole in results.spectra.items():
        values = results.values(name, target)
        if values is None:
            continue
        inside = np.full_like(values, np.nan)
        inside[cut] = values[cut]
        if (found := spectra(record, target, inside, start)) is not None:
            frequency, signal, error = found
            known = np.isfinite(whole.error).all()
            out[name, target] = SignalAndError(frequency, signal, error if known else np.full_like(error, np.nan))
    return out


def _curve(spectrum: SignalAndError, error: bool, display: Display, scenario: Scenario) -> Array:
    """Compute what is drawn of a spectrum. In error plots the truth stays: the error of answering zero."""
    density = (spectrum.error if error else spectrum.signal)[:, display.column]
    return display.curve(spectrum.frequency, density, scenario)


EVENTS, EVENT = "events", Look(light="#7A1FA2", dark="#E0B3FF")
"""The name of their marks, and the look."""

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


def levels(events: Sequence[Event], duration: float) -> list[int]:
    """How many lines below the top the word of each event stands, so that none stands in the one before."""
    out, before = [], -math.inf
    for event in events:
        near = event.start - before < WORD * duration
        out.append((out[-1] + 1) % LEVELS if near else 0)
        before = event.start
    return out


def event_columns(events: Sequence[Event], scenario: Scenario) -> dict[str, list[Any]]:
    """Collect what `add_event_marks` draws, but for the top; below : of a word [px]."""
    return {
        "start": [e.start for e in events],
        "end": [e.start + e.duration for e in events],
        "text": [word(e, scenario) for e in events],
        "below": [2 + LINE_PX * level for level in levels(events, scenario.run.duration)],
    }


def add_event_marks(fig: figure) -> list[GlyphRenderer[Any]]:
    """Add a strip per event, with a word that hangs from the top of the axis; of no event yet."""
    source = ColumnDataSource({name: [] for name in ("start", "end", "text", "below", "top")})
    strip = VStrip(x0="start", x1="end", fill_alpha=0.13, line_width=1.5, line_dash=[6, 3])
    text = Text(x="start", y="top", text="text", x_offset=4, y_offset="below", text_baseline="top", text_font_size="11px")
    return [fig.add_glyph(source, it, name=EVENTS, level=level) for it, level in ((strip, "underlay"), (text, "overlay"))]


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


class _Trace(TargetFigure):
    """The truth and the estimates, all lines in one data source."""

    def __init__(self, target: str, x_range: Range1d, crosshair: CrosshairTool):
        self.source = ColumnDataSource({name: [] for name in ("x", TRUTH, *observers_of(target))})
        super().__init__(target, new_figure(x_range, (-1.0, 1.0), "time [s]"), self.source)
        self.figure.add_tools(crosshair)
        self.warm_up = BoxAnnotation(left=0, right=0, fill_color="#808080", fill_alpha=0.10, line_width=0, level="underlay")
        self.figure.add_layout(self.warm_up)
        self.event_marks: list[GlyphRenderer[Any]] = []  # none until there is an event
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
        extra = self._draw_runs(display, error, data["x"]) + self._draw_band(results, display, first, last, data["x"])
        events = events_of(results)
        above = levels(events, results.scenario.run.duration)
        self._fit(data, settled, extra, 0.1 * (1 + max(above, default=-1)))
        self.name_ends({name: (data["x"], data[name]) for name, line in self.lines.items() if line.visible}, display.dark)
        if events or self.event_marks:
            self.event_marks = self.event_marks or add_event_marks(self.figure)
            strip, text = self.event_marks
            top = [in_view(self.figure.y_range)[1]] * len(events)
            send(strip.data_source, event_columns(events, results.scenario) | {"top": top})
            strip.glyph.line_color = strip.glyph.fill_color = text.glyph.text_color = EVENT.colour(display.dark)
        what = f"{'running rms of ' if error and display.running else ''}{'error of ' if error else ''}{display.mode_label}"
        self.figure.yaxis.axis_label = f"{what} [{display.unit_label}]"

    def _draw_band(self, results: RunResults, display: Display, first: int, last: int, times: Array) -> list[Points]:
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

    def _draw_runs(self, display: Display, error: bool, times: Array) -> list[Points]:
        """Send the compared runs, errors beside errors, from the first to the last of the times; return what was sent."""

        def points(run: ComparedRun, lines_of_run: DrawnLines, name: str) -> Points | None:
            values = (lines_of_run.errors if error else lines_of_run.signals).get((name, self.target))
            if values is None or display.running:  # what is kept are extremes, of which there is no rms
                return None
            first, last = np.searchsorted(lines_of_run.times, [times[0], times[-1]])
            cut = slice(first, last + 1)
            y = envelope(values[cut, display.column].astype(np.float64), BINS)
            return _times_of_envelope(lines_of_run.times[cut]), display.scale(run.scenario) * y

        return self.draw_compared(display, points)

    def _fit(self, data: dict[str, Any], warm_up: float, extra: Sequence[Points], above: float) -> None:
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


class Stretch:
    """A line below the figures of a target: the rms error of every line that is shown, where a visitor has zoomed to."""

    def __init__(self, target: str, traces: Traces, spectra: SpectraFigures):
        self.target = target
        self.traces = traces
        self.spectra = spectra
        self.run: Final = traces.run
        self.display: Final = traces.display
        sources = (self.run, "result"), (self.display, ["mode", "unit", "hidden_lines", "dark"])
        self.pane: Final = follow_html(self.html, *sources, stylesheets=[*sheets("base", "style", "bare"), FLEXIBLE])
        on_settle([traces.x_range, spectra.x_range], lambda: setattr(self.pane, "html", self.html()))

    def html(self) -> str:
        """Write the errors; nothing where there is no truth or nothing is zoomed."""
        results = self.run.result
        if results is None or results.values(TRUTH, self.target) is None:
            return ""
        hidden = self.display.hidden_lines.get(self.target, [])
        names = [name for name in observers_of(self.target) if name not in hidden]
        lines = []
        if (ends := zoom_of(self.traces.x_range)) is not None and self.traces.chosen_window() is not None:
            lines.append(self._line(f"{ends[0]:.2f} – {ends[1]:.2f} s", self._over_time(results, names, *ends), results))
        if (ends := zoom_of(self.spectra.x_range)) is not None:
            lines.append(self._line(f"{ends[0]:.3g} – {ends[1]:.3g} Hz", self._in_band(results, names, *ends), results))
        return "".join(lines)

    def _over_time(self, results: RunResults, names: list[str], start: float, end: float) -> dict[str, float]:
        """Compute the rms error of each observer over the samples that all have [um]."""
        record, truth = results.result.record, results.values(TRUTH, self.target)
        assert truth is not None
        cut = slice(max(round(start / record.dt), 0), round(end / record.dt) + 1), self.display.column
        known = {name: values[cut] for name in names if (values := results.values(name, self.target)) is not None}
        found = {name: values for name, values in known.items() if np.isfinite(values).any()}
        if not found:
            return {}
        errors = np.column_stack([*found.values()]) - truth[cut][:, None]
        errors = errors[np.isfinite(errors).all(axis=1)]
        return dict(zip(found, np.sqrt(np.mean(errors**2, axis=0)), strict=True)) if len(errors) else {}

    def _in_band(self, results: RunResults, names: list[str], low: float, high: float) -> dict[str, float]:
        """Compute the rms error of each observer in a band, over the whole record [um]."""
        spectra = {name: spectrum for name in names if (spectrum := results.spectra.get((name, self.target))) is not None}
        return {name: band_rms(s.frequency, s.error[:, self.display.column], low, high) for name, s in spectra.items()}

    def _line(self, where: str, errors: dict[str, float], results: RunResults) -> str:
        scale = self.display.scale(results.scenario)
        entries = [
            f'<span class="mark">{swatch(name, self.display.dark)}{escape(look(name).label)} '
            f"<b>{number(error * scale)}</b> {self.display.unit_label}</span>"
            for name, error in sorted(errors.items(), key=lambda item: item[1])
        ]
        return f'<p class="text stretch legend">RMS error, {where}: {"".join(entries)}</p>' if entries else ""
