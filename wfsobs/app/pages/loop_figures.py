"""The figures of the closed loop, a line per controller."""

from __future__ import annotations

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, Range1d
from bokeh.plotting import figure

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.loop_work import LoopResults
from wfsobs.app.style import look
from wfsobs.app.views.envelope import envelope, envelope_times
from wfsobs.app.views.plots import add_line, new_figure, restyle
from wfsobs.app.views.settle import on_settle
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array

BINS = 600
DECADES = 7
NYQUIST = 2.5
"""How far the Nyquist plot reaches from the origin."""

NONE = "none"
CURVES = tuple(c.id for c in CONTROLLERS.values() if c.law and not c.predict and not c.ngs)
"""Controllers that may have a transfer function."""

NOWHERE = (np.empty(0), np.empty(0, dtype=complex), np.empty(0, dtype=complex))


class LoopLines:
    """A figure with a line per controller."""

    def __init__(self, fig: figure, names: tuple[str, ...]):
        self.figure = fig
        self.sources = {name: ColumnDataSource({"x": [], "y": []}) for name in names}
        self.lines = {name: add_line(fig, name, source) for name, source in self.sources.items()}

    def restyle(self, dark: bool, hidden_names: list[str]) -> None:
        """Set the colours of light or dark mode, and hide lines."""
        restyle(self.lines, dark, hidden_names)


class Trace(LoopLines):
    """The residual of every controller over time; that of none would dwarf the rest. seconds : shown of a record at first."""

    def __init__(self, seconds: float):
        self.x_range = Range1d(start=0.0, end=1.0)
        super().__init__(
            new_figure(x_range=self.x_range, y_range=Range1d(start=-1.0, end=1.0)),
            tuple(name for name in CONTROLLERS if name != NONE),
        )
        self.seconds = seconds
        self._of: tuple[LoopResults, Display] | None = None
        self._invisible_names: list[str] = []
        self.figure.xaxis.axis_label = "time [s]"
        on_settle([self.x_range], self._send)

    def draw(self, results: LoopResults, display: Display) -> None:
        """Draw what is in view of every line; of another record that is its middle at first."""
        it = results.result
        start, end = it.scenario.run.warm_up, it.record.n_steps * it.record.dt
        self._of = results, display
        if (start, end) != (self.x_range.reset_start, self.x_range.reset_end):
            self.x_range.update(reset_start=start, reset_end=end)
            self.zoom(self.seconds)
        self._send()
        self.figure.yaxis.axis_label = f"residual {display.mode_label} [{display.unit_label}]"

    def zoom(self, seconds: float | None) -> None:
        """Show the middle of the record, or all of it after the start."""
        start, end = float(self.x_range.reset_start), float(self.x_range.reset_end)  # type: ignore[arg-type]
        half = 0.5 * min(seconds or end - start, end - start)
        self.x_range.update(start=0.5 * (start + end) - half, end=0.5 * (start + end) + half)

    def _send(self) -> None:
        """Send the samples in view, as extremes where they are many."""
        if self._of is None:
            return
        results, display = self._of
        record = results.result.record
        start, end = sorted((float(self.x_range.start), float(self.x_range.end)))  # type: ignore[arg-type]
        first = min(max(int(start / record.dt), 0), record.n_steps - 2)
        last = min(max(int(np.ceil(end / record.dt)) + 1, first + 2), record.n_steps)
        scale = per_micrometre(display.unit, results.result.scenario.telescope.diameter)
        times = envelope_times(first, last, BINS, record.dt)
        with pn.io.hold():
            for name, source in self.sources.items():
                residual = results.residual(name)
                source.data = (
                    {"x": [], "y": []}
                    if residual is None
                    else {"x": times, "y": (scale * envelope(residual[first:last, display.column], BINS)).astype(np.float32)}
                )
            self.fit(self._invisible_names)

    def fit(self, hidden_names: list[str]) -> None:
        """Have the axis hold every visible line."""
        self._invisible_names = hidden_names
        lines = [np.abs(s.data["y"]) for name, s in self.sources.items() if name not in hidden_names and len(s.data["y"])]
        top = 1.1 * max((float(y.max()) for y in lines), default=1.0)
        self.figure.y_range.update(start=-top, end=top, reset_start=-top, reset_end=top)


class LoopSpectrum(LoopLines):
    """The power spectral density of every residual."""

    def __init__(self) -> None:
        super().__init__(
            new_figure(
                x_range=Range1d(start=0.5, end=500.0), y_range=Range1d(start=1e-6, end=1.0), x_axis_type="log", y_axis_type="log"
            ),
            tuple(CONTROLLERS),
        )
        self.figure.xaxis.axis_label = "frequency [Hz]"

    def draw(self, results: LoopResults, display: Display) -> None:
        """Send every line."""
        scale = per_micrometre(display.unit, results.result.scenario.telescope.diameter) ** 2
        for name, source in self.sources.items():
            frequency, density = results.spectra.get(name, (np.empty(0), np.empty((0, display.column + 1))))
            source.data = {"x": frequency[1:], "y": scale * density[1:, display.column]}
            if frequency.size:
                self.figure.x_range.update(start=float(frequency[1]), end=float(frequency[-1]))
        self.figure.yaxis.axis_label = f"PSD of residual, {display.mode_label} [{display.unit_label}²/Hz]"

    def fit(self, hidden_names: list[str]) -> None:
        """Have the axis hold every visible line, but for what lies too far below the highest."""
        lines = [s.data["y"] for name, s in self.sources.items() if name not in hidden_names and len(s.data["y"])]
        top = 3.0 * max((float(np.max(y)) for y in lines), default=0.0) or 1.0
        self.figure.y_range.update(start=top * 10.0**-DECADES, end=top)


class Response(LoopLines):
    """Rejection and noise transfer of the loops that have them."""

    def __init__(self) -> None:
        fig = new_figure(x_range=Range1d(start=0.5, end=500.0), y_range=Range1d(start=-50.0, end=15.0), x_axis_type="log")
        super().__init__(fig, CURVES)
        self.noise = {name: ColumnDataSource({"x": [], "y": []}) for name in CURVES}
        self.faint = {name: add_line(fig, name, source) for name, source in self.noise.items()}
        for line in self.lines.values():
            line.glyph.line_width = 2.2
        for line in self.faint.values():
            line.glyph.update(line_alpha=0.45, line_width=1.2)
        fig.xaxis.axis_label, fig.yaxis.axis_label = "frequency [Hz]", "amplitude [dB]"

    def draw(self, results: LoopResults, display: Display) -> None:
        """Send every line."""
        nyquist = 0.5 / results.result.record.dt
        self.figure.x_range.update(start=1e-3 * nyquist, end=nyquist)
        for name in CURVES:
            of = results.curves.get(name)
            curves = of[display.column] if of else None
            x, rejection, noise = (curves.frequency, curves.rejection, curves.noise) if curves else NOWHERE
            self.sources[name].data = {"x": x, "y": _decibel(rejection)}
            self.noise[name].data = {"x": x, "y": _decibel(noise)}

    def restyle(self, dark: bool, hidden_names: list[str]) -> None:
        """Restyle the faint lines too."""
        super().restyle(dark, hidden_names)
        restyle(self.faint, dark, hidden_names)


def _decibel(x: Complex) -> Array:
    return 20.0 * np.log10(np.maximum(np.abs(x), 1e-6))


class Nyquist(LoopLines):
    """The loop gain in the complex plane, the unit circle, and where the margins are measured."""

    def __init__(self) -> None:
        fig = new_figure(x_range=Range1d(start=-NYQUIST, end=NYQUIST), y_range=Range1d(start=-NYQUIST, end=NYQUIST))
        fig.update(height=None, aspect_ratio=1.0, max_width=480)
        turn = np.linspace(0.0, 2.0 * np.pi, 181)
        fig.line(np.cos(turn), np.sin(turn), line_color="#888888", line_dash=[4, 3])
        fig.scatter([-1.0], [0.0], marker="x", size=11, line_color="#888888", line_width=2)
        super().__init__(fig, CURVES)
        self.marks = ColumnDataSource({"x": [], "y": [], "colour": [], "marker": []})
        fig.scatter("x", "y", source=self.marks, marker="marker", line_color="colour", fill_alpha=0.0, size=9, line_width=2)
        fig.xaxis.axis_label, fig.yaxis.axis_label = "real part", "imaginary part"
        self._at: dict[str, list[tuple[complex, str]]] = {}

    def draw(self, results: LoopResults, display: Display) -> None:
        """Send every line and mark."""
        self._at = {}
        for name, source in self.sources.items():
            of = results.curves.get(name)
            L = of[display.column].loop_gain if of else np.empty(0, dtype=complex)
            x, y = plane(L)
            source.data = {"x": x, "y": y}
            margins = results.result.design.laws[name][display.column].margins if name in results.result.design.laws else None
            if margins is None or not L.size:
                continue
            self._at[name] = [(complex(-1.0 / margins.gain), "circle")] if margins.gain else []
            if margins.phase is not None:
                both = [-np.exp(1j * sign * margins.phase) for sign in (1.0, -1.0)]
                self._at[name].append((min(both, key=lambda p, L=L: np.nanmin(np.abs(L - p))), "square"))

    def restyle(self, dark: bool, hidden_names: list[str]) -> None:
        """Restyle the marks too."""
        super().restyle(dark, hidden_names)
        shown = [
            (point, marker, look(name).colour(dark))
            for name, at in self._at.items()
            if name not in hidden_names
            for point, marker in at
        ]
        self.marks.data = {
            "x": [p.real for p, *_ in shown],
            "y": [p.imag for p, *_ in shown],
            "colour": [c for *_, c in shown],
            "marker": [m for _, m, _ in shown],
        }


def plane(loop_gain: Complex) -> tuple[Array, Array]:
    """Return the real and imaginary parts of a loop gain, without what is far outside of the figure."""
    near = np.where(np.abs(loop_gain) < 20.0, loop_gain, np.nan)
    return np.real(near), np.imag(near)
