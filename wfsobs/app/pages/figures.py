"""The paper's figures, drawn from the results shown."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np
import panel as pn
from bokeh.models import BoxAnnotation, ColumnDataSource, DataRange1d, GlyphRenderer, Range1d
from bokeh.plotting import figure

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.pages.parts import WIDE, Page, boxes, html
from wfsobs.app.render import number
from wfsobs.app.store import Store
from wfsobs.app.style import asset, look, swatch
from wfsobs.app.views.plots import call, envelope, envelope_times, new_figure
from wfsobs.app.views.table import find
from wfsobs.app.work import TRUTH, RunResults
from wfsobs.observers.base import TURBULENCE, VIBRATION
from wfsobs.sensors.modes import TIP_TILT

ZOOM_S = 0.5
"""Length of a zoomed plot [s], in the middle of the record."""

BINS = 700
PSD_TOP_HZ = 100.0
WHOLE, ZOOMED, SPECTRUM = "whole record", "zoomed", "power spectrum"


@dataclass(frozen=True)
class Plot:
    """One plot: what of it (WHOLE, ZOOMED, SPECTRUM), of which column of the arrays."""

    what: str
    column: int = 0


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper: its number, its lines beside the reference, its plots from the top.

    paper_errors : (observer, the RMS error that the paper states, taken as [um])
    """

    number: str
    title: str
    caption: str
    target: str
    observers: tuple[str, ...]
    plots: tuple[Plot, ...]
    paper_errors: tuple[tuple[str, float], ...] = ()


FIGURES = (
    PaperFigure(
        "4a",
        "Butterworth reference, open loop",
        "Vibration filtered from open-loop data, the grey stretch enlarged below; tip only.",
        VIBRATION,
        ("butterworth-ol",),
        (Plot(WHOLE), Plot(ZOOMED)),
        (("butterworth-ol", 7.66e-3),),
    ),
    PaperFigure(
        "4b",
        "Butterworth reference, closed loop",
        "Vibration filtered from closed-loop data, the grey stretch enlarged below; tip only.",
        VIBRATION,
        ("butterworth-cl",),
        (Plot(WHOLE), Plot(ZOOMED)),
        (("butterworth-cl", 13.4e-3),),
    ),
    PaperFigure(
        "5",
        "Estimation of the atmospheric turbulence",
        "Tip above, tilt below.",
        TURBULENCE,
        ("kf-lgs", "kf-ngs", "multirate"),
        (Plot(WHOLE, 0), Plot(WHOLE, 1)),
    ),
    PaperFigure(
        "6",
        "Estimation of structural vibrations",
        "Traces, the grey stretch enlarged, and power spectra; tip only.",
        VIBRATION,
        ("kf-lgs", "gpr-offline", "gpr-online"),
        (Plot(WHOLE), Plot(ZOOMED), Plot(SPECTRUM)),
        (("kf-lgs", 16.6e-3), ("gpr-offline", 12.4e-3), ("gpr-online", 13.3e-3)),
    ),
)


class Figures(Page):
    """The page; redrawn with the results and the unit while it is visible."""

    def __init__(self, store: Store, display: Display):
        super().__init__(store, display, "unit", "dark")
        self.sheets = [_Sheet(it) for it in FIGURES]
        self.run.param.watch(self.redraw, "result")

    def view(self) -> pn.Column:
        """Return the figures, one below the other."""
        return boxes(*(sheet.view() for sheet in self.sheets))

    def draw(self) -> None:
        """Draw every figure."""
        if (shown := self.run.result) is not None:
            for sheet in self.sheets:
                sheet.draw(shown, self.display)


class _Sheet:
    """One figure of the paper: heading, legend, plots, caption."""

    def __init__(self, figure: PaperFigure):
        self.figure = figure
        self.names = (*figure.observers, TRUTH)  # the reference on top
        self.plots = [_PlotLines(plot, self.names, figure) for plot in figure.plots]
        self.head, self.caption = html(), html()

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        panes = [pn.pane.Bokeh(drawn.figure, **WIDE) for drawn in self.plots]
        return pn.Column(self.head, *panes, self.caption, **WIDE, stylesheets=[asset("box.css")])

    def draw(self, results: RunResults, display: Display) -> None:
        """Every plot and the texts."""
        legend = "".join(
            f'<span class="mark">{swatch(n, display.dark, with_dash=_is_dashed(n, self.figure))}{escape(_label(n))}</span>'
            for n in self.names
        )
        title = escape(f"Figure {self.figure.number} of the paper: {self.figure.title}")
        self.head.object = f'<h2 class="title">{title}</h2><div class="caption legend">{legend}</div>'
        self.caption.object = f'<p class="text">{escape(self.figure.caption)} {escape(self._errors(results, display))}</p>'
        for drawn in self.plots:
            drawn.draw(results, display)

    def _errors(self, results: RunResults, display: Display) -> str:
        """List the RMS errors of the lines, mode by mode."""
        scale, parts = per_micrometre(display.unit, results.scenario.telescope.diameter), []
        for column in sorted({plot.column for plot in self.figure.plots}):
            mode = TIP_TILT[column].name
            scores = {name: find(results, name, self.figure.target, mode) for name in self.figure.observers}
            found = ", ".join(f"{_label(n)} {number(s.rms * scale)}{self._paper_error(n, scale)}" for n, s in scores.items() if s)
            if found:
                parts.append(f"RMS error of {mode} [{display.unit_label}]: {found}.")
        return " ".join(parts)

    def _paper_error(self, name: str, scale: float) -> str:
        """Write the error that the paper states, to stand behind the one of the run."""
        error = dict(self.figure.paper_errors).get(name)
        return "" if error is None else f" (paper {number(error * scale)})"


class _PlotLines:
    """One plot."""

    def __init__(self, plot: Plot, names: tuple[str, ...], of: PaperFigure):
        self.plot, self.of = plot, of
        if plot.what == SPECTRUM:
            self.figure: figure = new_figure(
                x_range=Range1d(start=0.0, end=PSD_TOP_HZ), y_range=Range1d(start=1e-3, end=1.0), y_axis_type="log"
            )
        else:
            self.figure = new_figure(x_range=Range1d(start=0.0, end=1.0), y_range=DataRange1d())
        self.figure.xaxis.axis_label = "frequency [Hz]" if plot.what == SPECTRUM else "time [s]"
        call(self.figure, f"{of.title}, {TIP_TILT[plot.column].name}, {plot.what}")
        self.sources = {name: ColumnDataSource({"x": [], "y": []}) for name in names}
        self.lines: dict[str, GlyphRenderer] = {
            name: self.figure.line(
                "x",
                "y",
                source=source,
                line_width=1.6,
                line_dash=list(look(name).dash) if _is_dashed(name, of) else [],
                name=name,
            )
            for name, source in self.sources.items()
        }
        self.window = BoxAnnotation(left=0, right=0, fill_color="#808080", fill_alpha=0.15, line_width=0, level="underlay")
        if plot.what == WHOLE and any(p.what == ZOOMED for p in of.plots):
            self.figure.add_layout(self.window)

    def draw(self, results: RunResults, display: Display) -> None:
        """Send every line in the colours of the paper."""
        scale = per_micrometre(display.unit, results.scenario.telescope.diameter)
        for name, line in self.lines.items():
            line.glyph.line_color = look(name).colour(display.dark)
        mode = TIP_TILT[self.plot.column].name
        if self.plot.what == SPECTRUM:
            self.figure.yaxis.axis_label = f"PSD, {mode} [{display.unit_label}²/Hz]"
            self._draw_spectra(results, scale**2)
        else:
            self.figure.yaxis.axis_label = f"{mode} [{display.unit_label}]"
            self._draw_traces(results, scale)

    def _draw_traces(self, results: RunResults, scale: float) -> None:
        dt, n = results.result.record.dt, results.result.record.n_steps
        begin = min(round(results.scenario.run.warm_up / dt), n - 2)
        middle, half = (begin + n) // 2, min(round(ZOOM_S / dt), n - begin) // 2
        zoomed = (middle - half, middle + half)
        first, last = zoomed if self.plot.what == ZOOMED else (begin, n)
        times = envelope_times(first, last, BINS, dt)
        for name, source in self.sources.items():
            values = results.values(name, self.of.target)
            lines = np.full(last - first, np.nan) if values is None else values[first:last, self.plot.column]
            source.data = {"x": times, "y": (scale * envelope(lines, BINS)).astype(np.float32)}
        self.figure.x_range.update(start=first * dt, end=last * dt, reset_start=first * dt, reset_end=last * dt)
        self.window.update(left=zoomed[0] * dt, right=zoomed[1] * dt)

    def _draw_spectra(self, results: RunResults, scale: float) -> None:
        tops: list[float] = []
        for name, source in self.sources.items():
            spectrum = results.spectra.get((name, self.of.target))
            if spectrum is None:
                source.data = {"x": [], "y": []}
                continue
            within = (spectrum.frequency > 0) & (spectrum.frequency <= PSD_TOP_HZ)
            y = scale * spectrum.signal[within, self.plot.column]
            source.data = {"x": spectrum.frequency[within], "y": y}
            tops.append(float(y.max()))
        if tops and max(tops) > 0:
            self.figure.y_range.update(start=1e-5 * max(tops), end=2 * max(tops))


def _label(name: str) -> str:
    return "Reference" if name == TRUTH else look(name).label


def _is_dashed(name: str, of: PaperFigure) -> bool:
    """Whether a line has its dashes; one alone with the reference needs none."""
    return name == TRUTH or len(of.observers) > 1
