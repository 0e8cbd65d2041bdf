"""The figures of the live loop: traces that roll, spectra, waterfall, detectors; and how they are sent."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from time import monotonic
from typing import Any, Final

import numpy as np
import panel as pn
from bokeh.model import Model
from bokeh.models import BasicTicker, ColorBar, ColumnDataSource, Image, LogColorMapper, Range1d
from bokeh.palettes import Viridis256
from bokeh.plotting import figure

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.pages.parts import WIDE, grid_style, pane
from wfsobs.app.style import Component, bare, look, script
from wfsobs.app.views.plots import FigureLines, Points, call, new_figure, new_spectrum
from wfsobs.app.views.traces import WINDOW_S
from wfsobs.app.work import TRUTH
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.scores import BOUNDS, trailing_rms
from wfsobs.live.board import SLOTS, LiveView
from wfsobs.live.crew import ControlView
from wfsobs.live.finding import LENGTH, LOWEST, ROWS, Bounds, bridge_missing, second_spectrum
from wfsobs.live.source import LiveEvent
from wfsobs.scenario import Scenario
from wfsobs.signal.envelope import envelope, envelope_times
from wfsobs.signal.spectrum import psd
from wfsobs.typing import Array

PATIENCE = 10.0
"""Time after which a picture that the browser has not answered is given up [s]."""


class Pulse(Component):
    """Collects changes of figures, has the browser make them as one picture, and tells when it has painted it.

    Changes of models that the browser has not seen are made here; once it makes them, the models of the server keep the values of
    before.
    """

    _esm = script("pulse")

    def __init__(self, **params: Any):
        self.answer: int = -1
        self.picture: int = 0
        self._time = 0.0
        self._waiting: Callable[[], None] | None = None
        self._steps: list[list[Any]] = []
        self._numbers: list[Array] = []
        super().__init__(self._take, **params)

    def _take(self, data: dict[str, Any]) -> None:
        if isinstance(number := data.get("painted"), int):
            self.answer = number
            if self._waiting is not None and self.is_free:
                self.when_free(self._waiting)

    @property
    def is_free(self) -> bool:
        """Whether the browser is ready for another; for the first once it has drawn the page."""
        return self.answer >= self.picture or (self.answer >= 0 and monotonic() - self._time > PATIENCE)

    def when_free(self, act: Callable[[], None]) -> None:
        """Do something, or have it done as soon as the browser is ready: else a picture that it is a little late for is lost."""
        self._waiting = None if self.is_free else act
        if self._waiting is None:
            act()

    def beat(self) -> None:
        """Ask for an answer to the picture that has been sent."""
        self._time = monotonic()
        self.picture += 1
        self._send_msg({"picture": self.picture})

    def draw(self, fig: figure, source: ColumnDataSource, columns: Mapping[str, Array]) -> None:
        """Have a source of a figure hold these numbers, columns of one length, in single precision."""
        numbers = {name: np.asarray(x, dtype=np.float32) for name, x in columns.items()}
        if self._reaches(source):
            self._steps.append([fig.id, source.id, list(numbers), len(next(iter(numbers.values()))), []])
            self._numbers += numbers.values()
        else:
            source.data = {**numbers}

    def move(self, fig: figure, model: Model, **values: float) -> None:
        """Set properties of a part of a figure that are numbers."""
        if self._reaches(model):
            self._steps.append([fig.id, model.id, [], 0, [list(pair) for pair in values.items()]])
        else:
            model.update(**values)

    def flush(self) -> None:
        """Send what has been collected: by message, since setting a property of a component costs as much as a figure."""
        if self._steps:
            self._send_msg({"changes": [self._steps, np.concatenate([np.empty(0, dtype=np.float32), *self._numbers])]})
            self._steps, self._numbers = [], []

    def _reaches(self, model: Model) -> bool:
        return self.answer >= 0 and model.document is not None


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
NAMES = (TRUTH, *BOUNDS, *SLOTS)


class LiveFigure(FigureLines):
    """A figure with a line per observer, whose changes are sent as part of a picture."""

    def __init__(self, fig: figure, pulse: Pulse):
        super().__init__(fig, NAMES)
        self.pulse = pulse
        self._lines_shown: tuple[bool, set[str]] = (False, set())

    def paint(self, data: Mapping[str, Points], dark: bool) -> None:
        """Show these lines, x and y by name, and no others."""
        for name, (x, y) in data.items():
            self.pulse.draw(self.figure, self.sources[name], {"x": x, "y": y})
        if (shown := (dark, set(data))) != self._lines_shown:
            self._lines_shown = shown
            self.restyle(dark, [name for name in NAMES if name not in data])


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
            lines.append(short_line(event) if times[-1] - written > close else "")
            written = times[-1] if lines[-1] else written
        marks: dict[str, Any] = {"x": times, "line": lines}
        if marks != self._source.data:
            self._source.data = marks


def short_line(event: LiveEvent) -> str:
    """Return what of an event there is room for in a figure; all of it is in the list of events.

    >>> short_line(LiveEvent(0, "error of {} up", "kf-lgs", ": 29.7 nm, it was 19.6 nm", kind="ALARM"))
    'ALARM error of kf-lgs up'
    >>> short_line(LiveEvent(0, "no frame for 0.1 s", origin="/dev/shm/aol1_modevalOL.im.shm"))
    'no frame for 0.1 s'
    """
    words = event.words(event.about)
    return next((part for part in (event.line, words) if len(part) <= ROOM), words[: ROOM - 1] + "…")


class RollingTraces(LiveFigure):
    """The last seconds of errors, or of estimates and truth."""

    def __init__(self, pulse: Pulse) -> None:
        super().__init__(new_figure((0.0, 1.0), (-1.0, 1.0), "time of the loop [s]"), pulse)
        self._marks = LiveMarks(self.figure)

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

        def trace(name: str) -> Array:
            x = shown_signal(view, name, target, display)
            if display.running:
                x = trailing_rms(x, min(round(WINDOW_S / view.dt), len(x)))
            return envelope(x[first - view.first :, display.column], BINS)

        def drawn(name: str) -> Points:
            key = ("trace", name, target, display.column, display.show, first)
            return times, scale * view.once(key, partial(trace, name))

        data = {name: drawn(name) for name in ([] if display.error else [TRUTH]) + [*names]}
        top = 1.1 * max((float(np.nanmax(np.abs(y))) for _, y in data.values() if np.isfinite(y).any()), default=1.0) or 1.0
        if display.running:
            ends = times[[0, -1]]
            data |= {name: (ends, np.full(2, scale * of[target][display.column])) for name, of in bounds.items() if target in of}
        self.paint(data, display.dark)
        self.pulse.move(self.figure, self.figure.x_range, start=first * view.dt, end=last * view.dt)
        self.pulse.move(self.figure, self.figure.y_range, start=0.0 if display.running else -top, end=top)
        what = "running rms of error of" if display.running else "error of" if display.error else ""
        self.figure.yaxis.axis_label = f"{what} {display.mode_label} [{display.unit_label}]".strip()
        self._marks.draw([event for event in events if first <= event.frame <= last], view.dt, CLOSE * n * view.dt)


class RollingSpectra(LiveFigure):
    """Spectra of the errors, averaged over time with weights that fade."""

    def __init__(self, pulse: Pulse) -> None:
        super().__init__(new_spectrum((1.0, 500.0)), pulse)
        self._sums: dict[str, Array] = {}
        self._of: tuple[object, ...] = ()
        self._last = 0

    def draw(self, view: LiveView, target: str, names: Sequence[str], display: Display, scenario: Scenario) -> None:
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
            data[name] = frequency[1:], display.curve(frequency, now, scenario)
        self.paint(data, display.dark)
        top = 3.0 * max((float(y.max()) for _, y in data.values()), default=1.0) or 1.0
        self.figure.x_range.update(start=1.0, end=0.5 / view.dt)
        self.figure.y_range.update(start=top * 10.0 ** -(DECADES / 2 if display.cumulative else DECADES), end=top)
        self.figure.yaxis.axis_label = display.curve_label(" of error" if display.error else "")


def shown_signal(view: LiveView, name: str, target: str, display: Display) -> Array:
    """Return what a line is of: the truth, or an observer's error or estimate, (n, n_modes) [um]."""
    if name == TRUTH:
        return view.truth(target)
    return view.error(name, target) if display.error else view.estimate(name, target)


def _last_spectrum(view: LiveView, name: str, target: str, display: Display, n: int) -> Points | None:
    """Return frequencies [Hz] and the spectrum of the last n frames [um^2/Hz]; None where too many are missing."""
    x = bridge_missing(shown_signal(view, name, target, display)[-n:, display.column])
    if x is None:
        return None
    frequency, density = psd(x[:, None], view.dt, resolution=1.0 / (n * view.dt))
    return frequency, density[:, 0]


MEASUREMENT = "measurement"
HOP = 0.5
"""Time between two spectra [s]."""
COLUMNS = 120
"""Spectra that are kept: a minute."""
FLOOR, SPAN = 0.05, 2.0
"""The darkest colour is that below which this part of the spectra is; the colours span so many decades at least."""


class Waterfall:
    """Spectra of a signal over the last minute.

    Attributes
    ----------
    figure : figure
        Time to the right, frequency upwards.
    columns : Array
        Spectra, (ROWS, COLUMNS) [um^2/Hz], the newest last; NaN where there is none.
    """

    def __init__(self) -> None:
        self.figure: Final = new_figure((0.0, 1.0), (LOWEST, 500.0), "time of the loop [s]", "y", y_axis_label="frequency [Hz]")
        self.figure.grid.visible = False
        self._colours = LogColorMapper(palette=Viridis256, low=1e-6, high=1.0, nan_color="rgba(0, 0, 0, 0)")
        self._source = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
        glyph = Image(image="image", x="x", y="y", dw="dw", dh="dh", color_mapper=self._colours)
        self.figure.add_glyph(self._source, glyph, level="image")
        self._bar = ColorBar(
            color_mapper=self._colours, width=8, padding=4, title_text_font_style="normal", background_fill_alpha=0.0
        )
        self.figure.add_layout(self._bar, "right")
        self.columns: Final = np.full((ROWS, COLUMNS), np.nan)
        self._of: tuple[str, str, int] = ("", "", 0)
        self._number = 0
        self._sent_in = ("", False)

    def draw(self, view: LiveView, what: str, target: str, display: Display, scale: float) -> None:
        """Take new spectra in, and send them; what : MEASUREMENT, or the observer whose error it is; scale : as for lines."""
        hop = round(HOP / view.dt)
        newest, of = (view.first + view.n) // hop, (what, target, display.column)
        fresh = of != self._of or newest < self._number
        if fresh:
            self.columns[:], self._of, self._number = np.nan, of, max(0, newest - COLUMNS)
        elif newest == self._number and (display.unit, display.dark) == self._sent_in:
            return
        self._take(view, hop, newest)
        self._send(newest * HOP, view.dt, scale, display)

    def _take(self, view: LiveView, hop: int, newest: int) -> None:
        """Move the spectra to the left, and add those of which the view has all frames."""
        step = min(newest - self._number, COLUMNS)
        self.columns[:] = np.hstack([self.columns[:, step:], np.full((ROWS, step), np.nan)])
        self._number = newest
        for back in range(step):
            stop = (newest - back) * hop - view.first
            if stop < round(LENGTH / view.dt):
                return
            self.columns[:, COLUMNS - 1 - back] = view.once(("second", stop, *self._of), partial(self._spectrum, view, stop))

    def _spectrum(self, view: LiveView, stop: int) -> Array:
        """Return the spectrum of the second before a frame of the view."""
        what, target, column = self._of
        signal = view.frames.z if what == MEASUREMENT else view.error(what, target)
        return second_spectrum(signal[stop - round(LENGTH / view.dt) : stop, column], view.dt)

    def _send(self, end: float, dt: float, scale: float, display: Display) -> None:
        self._sent_in = display.unit, display.dark
        image = (scale**2 * self.columns).astype(np.float32)
        left, top = end - COLUMNS * HOP, 0.5 / dt
        if not np.isfinite(image).any():
            return
        high = float(np.nanmax(image))
        self._colours.update(low=min(float(np.nanquantile(image, FLOOR)), high * 10.0**-SPAN), high=high)
        ink = "#C8C8C8" if display.dark else "#404040"
        self._bar.update(title=f"{display.unit_label}²/Hz", title_text_color=ink, major_label_text_color=ink)
        # An image is drawn between its corners, in equal steps of the axis: of a logarithmic one, of the logarithm.
        self._source.data = {"image": [image], "x": [left], "y": [LOWEST], "dw": [end - left], "dh": [top - LOWEST]}
        self.figure.x_range.update(start=max(left, 0.0), end=end)  # before the loop there was nothing
        self.figure.y_range.update(start=LOWEST, end=top)
        self.figure.yaxis.axis_label = f"frequency [Hz], {display.mode_label}"


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

    def __init__(self, name: str, pulse: Pulse):
        self.pulse = pulse
        self.name = name
        label = look("none" if name == TRUTH else name).label
        self.figure: figure = new_figure((-1.0, 1.0), (-1.0, 1.0), "mas")
        self.figure.update(height=None, aspect_ratio=1.0, min_width=SIDE, min_border_left=36, toolbar_location=None)
        for axis in self.figure.axis:
            ticker = BasicTicker(desired_num_ticks=3)
            axis.update(major_label_text_font_size="10px", minor_tick_line_color=None, ticker=ticker)
        self.figure.xaxis.update(axis_label_text_font_size="10px", axis_label_standoff=2)
        call(self.figure, f"Star: {label}")
        self._trail, self._spot = (ColumnDataSource({"x": [], "y": []}) for _ in range(2))
        self._line = self.figure.line("x", "y", source=self._trail, line_alpha=0.5).glyph
        self._core = self.figure.circle("x", "y", radius=1.0, source=self._spot, fill_alpha=0.6).glyph
        self._style: tuple[float, float, str] | None = None
        self.view: Final = pn.Column(bare(f'<div class="caption">{label}</div>'), pane(self.figure), **WIDE)

    def draw(self, points: Array, reach: float, radius: float, dark: bool) -> None:
        """Send the last instants (n, 2), the newest last; reach : of the axes;  radius : of the core, all in mas."""
        points = points[~np.isnan(points).any(axis=1)]
        for source, shown in ((self._trail, points), (self._spot, points[-1:])):
            self.pulse.draw(self.figure, source, {"x": shown[:, 0], "y": shown[:, 1]})
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

    def __init__(self, pulse: Pulse) -> None:
        self._pulse = pulse
        self.row: Final = pn.Column(**{**WIDE, "margin": (12, 0, 0, 0)}, stylesheets=[GRID])
        self._detectors: dict[str, Detector] = {}
        self._reach = 1.0

    def draw(self, view: LiveView, left: ControlView | None, names: Sequence[str], scenario: Scenario, dark: bool) -> None:
        """Send the last instants; left, names : controllers, and what they leave."""
        scale, n = per_micrometre("mas", scenario.telescope.diameter), max(2, round(TRAIL / view.dt))
        come = view.truth("turbulence") + view.truth("vibration")
        signals = {TRUTH: view.frames.z if np.isnan(come).all() else come}
        if left is not None:
            signals |= {name: left.residual(name) for name in names if not CONTROLLERS[name].is_idle}
        if list(signals) != list(self._detectors):
            self._detectors = {name: self._detectors.get(name) or Detector(name, self._pulse) for name in signals}
            self.row[:] = [detector.view for detector in self._detectors.values()]
        reach = 1.1 * float(np.nanmax(np.abs(scale * signals[TRUTH][:, :2]), initial=1e-3))
        if not self._reach / 1.6 < reach < self._reach:
            self._reach = 1.25 * reach
        # wavelength [um] over diameter [m] is in microradians
        radius = 0.5 * FWHM * np.degrees(scenario.control.wavelength * 1e-6 / scenario.telescope.diameter) * 3.6e6
        step = max(1, n // POINTS)
        for name, detector in self._detectors.items():
            detector.draw(scale * signals[name][-n:, :2][::-step][::-1], self._reach, radius, dark)
