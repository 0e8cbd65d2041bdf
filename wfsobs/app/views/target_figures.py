"""What the traces and the spectra have in common: a figure per target, which rests while it is hidden."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any, Final, Protocol

import numpy as np
import panel as pn
from bokeh.models import Range1d
from bokeh.plotting import figure

from wfsobs.app.display import Display
from wfsobs.app.render import number
from wfsobs.app.service import BackgroundTask
from wfsobs.app.style import follow_html, look, observers_of, sheets, swatch
from wfsobs.app.views.plots import FigureLines, on_settle, zoom_of
from wfsobs.app.work import TRUTH, RunResults
from wfsobs.evaluation.error_spectra import band_rms

FLEXIBLE = ":host > div { flex: 1 1 240px; width: auto !important; }"
"""Style of what shares a row with a switch."""

FONT = "Roboto, Helvetica, Arial, sans-serif"
AXIS_TEXT: Mapping[str, Any] = {
    "major_label_text_font": FONT,
    "major_label_text_font_size": "0.925em",
    "axis_label_text_font": FONT,
    "axis_label_text_font_size": "1em",
    "axis_label_text_font_style": "normal",
    "axis_label_standoff": 12,
}
"""Text of axes as the theme of the page sets it: where it sets another the page is laid out anew."""


class Stretch:
    """A line below the figures of a target: the rms error of every line that is shown, where a visitor has zoomed to."""

    def __init__(
        self,
        target: str,
        run: BackgroundTask,
        display: Display,
        times: Range1d,
        frequencies: Range1d,
        chosen_window: Callable[[], tuple[float, float] | None],
    ):
        self.target = target
        self.run = run
        self.display = display
        self.times = times
        self.frequencies = frequencies
        self.chosen_window = chosen_window
        sources = (run, "result"), (display, ["mode", "unit", "hidden_lines", "dark"])
        self.pane: Final = follow_html(self.html, *sources, stylesheets=[*sheets("style", "bare"), FLEXIBLE])
        on_settle([times, frequencies], lambda: setattr(self.pane, "html", self.html()))

    def html(self) -> str:
        """Write the errors; nothing where there is no truth or nothing is zoomed."""
        results = self.run.result
        if results is None or results.values(TRUTH, self.target) is None:
            return ""
        hidden = self.display.hidden_lines.get(self.target, [])
        names = [name for name in observers_of(self.target) if name not in hidden]
        lines = []
        if (ends := zoom_of(self.times)) is not None and self.chosen_window() is not None:
            lines.append(self._line(f"{ends[0]:.2f} – {ends[1]:.2f} s", self._over_time(results, names, *ends), results))
        if (ends := zoom_of(self.frequencies)) is not None:
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


class Drawing(Protocol):
    """One figure and its lines, by observer."""

    figure: figure
    lines: FigureLines


class TargetFigures(ABC):
    """A figure per target, drawn when results or switches change while the page shows them."""

    def __init__(self, run: BackgroundTask, display: Display, drawings: Mapping[str, Drawing], switches: Sequence[str]):
        """Watch the results and the switches of the display; drawings : target -> its figure."""
        self.run = run
        self.display = display
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
                    drawing.lines.restyle(self.display.dark, hidden, named)
                self._draw(results)

    @abstractmethod
    def _draw(self, results: RunResults) -> None:
        """Send the data of every figure, whose lines are shown or hidden by now."""


def shows_error(results: RunResults, target: str, display: Display) -> bool:
    """Whether errors are drawn: as chosen, where there is a truth to compare with."""
    return display.error and results.values(TRUTH, target) is not None
