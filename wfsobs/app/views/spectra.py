"""Power spectra: one figure per target, log-log, the modelled peaks marked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from bokeh.models import ColumnDataSource, HoverTool, Range1d, UnionRenderers, VSpan

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.service import BackgroundTask
from wfsobs.app.style import observers_of
from wfsobs.app.views.plots import (
    MODEL,
    PEAKS,
    ComparedLines,
    EndLabels,
    FigureLines,
    marked_peaks,
    new_figure,
    on_settle,
    send,
    show_all_on_double_click,
    zoom_of,
)
from wfsobs.app.views.target_figures import TargetFigures, shows_error
from wfsobs.app.work import TRUTH, Array, Key, RunResults, SignalAndError
from wfsobs.evaluation.error_spectra import cumulative_rms, spectra
from wfsobs.observers.base import TARGETS, VIBRATION

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
            limits = {"start": float(frequencies[1]), "end": float(frequencies[-1])}
            if self.x_range.reset_start != limits["start"] or self.x_range.reset_end != limits["end"]:
                self.x_range.update(**limits, reset_start=limits["start"], reset_end=limits["end"])


class _Spectrum:
    """One figure: the spectra of the truth and of the estimates of one target, or of their errors."""

    def __init__(self, target: str, x_range: Range1d):
        self.target = target
        self.figure = new_figure(
            x_range=x_range,
            y_range=Range1d(start=1e-6, end=1.0),
            x_axis_type="log",
            y_axis_type="log",
        )
        self.figure.xaxis.axis_label = "frequency [Hz]"
        if target == VIBRATION:
            self._add_marks()
        show_all_on_double_click(self.figure)
        policy = UnionRenderers()
        self.sources = {
            name: ColumnDataSource({"x": [], "y": []}, selection_policy=policy) for name in (TRUTH, *observers_of(target))
        }
        self.lines = FigureLines(self.figure, {name: (source, "y") for name, source in self.sources.items()})
        self.faint = ComparedLines(self.figure)
        self.names_at_end = EndLabels(self.figure)

    def _add_marks(self) -> None:
        """Vertical lines at the scenario's peaks and at the one that the Kalman filters model."""
        self.peaks = ColumnDataSource({"x": [], "text": []})
        self.model = ColumnDataSource({"x": [], "text": []})
        peaks = self.figure.add_glyph(self.peaks, VSpan(x="x", line_color=PEAKS, line_alpha=0.4, line_width=1.5))
        model = self.figure.add_glyph(self.model, VSpan(x="x", line_color=MODEL, line_dash=[4, 3], line_width=1.5))
        self.figure.add_tools(HoverTool(renderers=[peaks, model], tooltips="@text"))

    def draw(self, results: RunResults, spectra: Mapping[Key, SignalAndError], display: Display) -> None:
        """Send every line, its axis and the marks."""
        diameter, error = results.scenario.telescope.diameter, shows_error(results, self.target, display)
        drawn: dict[str, tuple[Array, Array]] = {}
        for name, source in self.sources.items():
            spectrum = spectra.get((name, self.target)) if self.lines[name].visible else None
            if spectrum is None:  # what is hidden is sent when it is shown
                send(source, {"x": [], "y": []})
                continue
            y = _curve(spectrum, error and name != TRUTH, display, diameter)
            send(source, {"x": spectrum.frequency[1:], "y": y})
            drawn[name] = spectrum.frequency[1:], y
        self._fit([*(y for _, y in drawn.values()), *self._draw_compared(display, error)], display.cumulative)
        self.names_at_end.draw({name: line for name, line in drawn.items() if not self.lines[name].recedes}, display.dark)
        of = " of error" if error else ""
        what, unit = (
            (f"cumulative rms{of}", display.unit_label) if display.cumulative else (f"PSD{of}", f"{display.unit_label}²/Hz")
        )
        self.figure.yaxis.axis_label = f"{what}, {display.mode_label} [{unit}]"
        if self.target == VIBRATION:
            self._draw_marks(results)

    def _draw_compared(self, display: Display, error: bool) -> list[Array]:
        """Send the compared runs' visible lines, errors beside errors alone; what was sent."""
        lines: list[tuple[str, str, Array, Array]] = []
        for run, kept in display.runs_drawn:
            for name, line in self.lines.items():
                spectrum = kept.spectra.get((name, self.target))
                of_error = error and name != TRUTH
                if line.visible and spectrum is not None and (not of_error or np.isfinite(spectrum.error).all()):
                    y = _curve(spectrum, of_error, display, run.scenario.telescope.diameter)
                    lines.append((run.letter, name, spectrum.frequency[1:], y))
        self.faint.draw_runs(lines, display.dark)
        return [y for *_, y in lines]

    def _fit(self, lines: list[Array], cumulative: bool) -> None:
        """Have the axis hold every line, but for what lies too far below the highest."""
        positive = [y[y > 0] for y in lines if (y > 0).any()]
        if positive:
            low, high = min(float(np.quantile(y, 0.02)) for y in positive), max(float(y.max()) for y in positive)
            room, decades = (1.5, DECADES / 2) if cumulative else (3.0, DECADES)
            self.figure.y_range.update(start=max(low / room, high * 10.0**-decades), end=high * room)

    def _draw_marks(self, results: RunResults) -> None:
        simulated = results.result.record.vibration is not None  # peaks of the settings are not those of a record
        drawn, kalman = marked_peaks(results.scenario) if simulated else [], results.scenario.kalman
        send(
            self.peaks,
            {
                "x": [p.frequency for p in drawn],
                "text": [f"peak {p.frequency:.5g} Hz, damping {p.damping:.3g}" for p in drawn],
            },
        )
        send(
            self.model,
            {
                "x": [kalman.frequency],
                "text": [f"model of the Kalman filters {kalman.frequency:.5g} Hz"],
            },
        )


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
            out[name, target] = SignalAndError(
                frequency, signal, error if np.isfinite(whole.error).all() else np.full_like(error, np.nan)
            )
    return out


def _curve(spectrum: SignalAndError, error: bool, display: Display, diameter: float) -> Array:
    """Compute what is drawn of a spectrum above zero frequency. In error plots the truth stays: the error of answering zero."""
    scale = per_micrometre(display.unit, diameter)
    density = (spectrum.error if error else spectrum.signal)[1:, display.column]
    return scale * cumulative_rms(spectrum.frequency[1:], density) if display.cumulative else scale**2 * density
