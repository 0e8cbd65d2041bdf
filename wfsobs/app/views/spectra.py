"""Power spectra: one figure per target, log-log, the modelled peaks marked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from bokeh.models import ColumnDataSource, Range1d, UnionRenderers

from wfsobs.app.display import Display
from wfsobs.app.service import BackgroundTask
from wfsobs.app.style import observers_of
from wfsobs.app.views.plots import (
    ComparedLines,
    EndLabels,
    FigureLines,
    add_marks,
    model_mark,
    new_spectrum,
    on_settle,
    peak_marks,
    send,
    set_ends,
    show_all_on_double_click,
    zoom_of,
)
from wfsobs.app.views.target_figures import TargetFigures, shows_error
from wfsobs.app.work import TRUTH, Key, RunResults, SignalAndError
from wfsobs.evaluation.error_spectra import spectra
from wfsobs.observers.base import TARGETS, VIBRATION
from wfsobs.scenario import Scenario
from wfsobs.typing import Array

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


class _Spectrum:
    """One figure: the spectra of the truth and of the estimates of one target, or of their errors."""

    def __init__(self, target: str, x_range: Range1d):
        self.target = target
        self.figure = new_spectrum(x_range)
        self.marks = add_marks(self.figure) if target == VIBRATION else {}
        show_all_on_double_click(self.figure)
        policy = UnionRenderers()
        self.sources = {
            name: ColumnDataSource({"x": [], "y": []}, selection_policy=policy) for name in (TRUTH, *observers_of(target))
        }
        self.lines = FigureLines(self.figure, {name: (source, "y") for name, source in self.sources.items()})
        self.faint = ComparedLines(self.figure)
        self.names_at_end = EndLabels(self.figure)

    def draw(self, results: RunResults, spectra: Mapping[Key, SignalAndError], display: Display) -> None:
        """Send every line, its axis and the marks."""
        error = shows_error(results, self.target, display)
        drawn: dict[str, tuple[Array, Array]] = {}
        for name, source in self.sources.items():
            spectrum = spectra.get((name, self.target)) if self.lines[name].visible else None
            if spectrum is None:  # what is hidden is sent when it is shown
                send(source, {"x": [], "y": []})
                continue
            y = _curve(spectrum, error and name != TRUTH, display, results.scenario)
            send(source, {"x": spectrum.frequency[1:], "y": y})
            drawn[name] = spectrum.frequency[1:], y
        self._fit([*(y for _, y in drawn.values()), *self._draw_compared(display, error)], display.cumulative)
        self.names_at_end.draw({name: line for name, line in drawn.items() if not self.lines[name].recedes}, display.dark)
        self.figure.yaxis.axis_label = display.curve_label(" of error" if error else "")
        if self.marks:
            self._draw_marks(results)

    def _draw_compared(self, display: Display, error: bool) -> list[Array]:
        """Send the compared runs' visible lines, errors beside errors alone; what was sent."""
        lines: list[tuple[str, str, Array, Array]] = []
        for run, kept in display.runs_drawn:
            for name, line in self.lines.items():
                spectrum = kept.spectra.get((name, self.target))
                of_error = error and name != TRUTH
                if line.visible and spectrum is not None and (not of_error or np.isfinite(spectrum.error).all()):
                    y = _curve(spectrum, of_error, display, run.scenario)
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
        found = {"peaks": peak_marks(results.scenario) if simulated else [], "model": [model_mark(results.scenario)]}
        for name, marks in found.items():
            send(self.marks[name].data_source, {"x": [x for x, _ in marks], "text": [text for _, text in marks]})


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
