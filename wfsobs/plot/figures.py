"""Figures of records, results, identifications, sweeps and closed loops: the attribute `plot` of each.

Every function returns an object of HoloViews. Lines are the numbers of the result itself in nanometres, long ones as the
extremes of bins. `mode` is the name of a mode, by default the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import holoviews as hv
import numpy as np

from wfsobs.campaign.sweep import SweepResults
from wfsobs.closed_loop.envelope import PlantEnvelope
from wfsobs.closed_loop.run import ClosedLoop, residual_rms
from wfsobs.control.margins import Curves, curves
from wfsobs.evaluation.budget import TERMS, error_budget
from wfsobs.evaluation.exact_errors import FEWEST, TRUTH, cumulative_rms
from wfsobs.evaluation.result import NO_ESTIMATE, Result, row_label
from wfsobs.identification.result import Identification
from wfsobs.observers.base import TARGETS, Look
from wfsobs.plot.elements import (
    FREQUENCY,
    draw_bars,
    draw_intervals,
    draw_line,
    draw_marks,
    draw_trace,
    legend_of,
    overlay,
    quantity,
    stack,
    style,
)
from wfsobs.plot.looks import TERM_COLOURS, look
from wfsobs.record import Record, hold_last
from wfsobs.registry import name_list
from wfsobs.scenario.configfile import Variation
from wfsobs.sensors.zernike import MODE_NAMES
from wfsobs.signal.spectrum import psd
from wfsobs.spectral.whittle import complete
from wfsobs.typing import Array
from wfsobs.units import unit_text

NM = 1e3
"""Nanometres in a micrometre."""

WIDEST = 2.0
"""End of the axis over the longest bar where an interval goes beyond: in short records it can be a hundred bars long."""

SIGNALS = {
    "z": Look("Pseudo-open-loop LGS", "#8A8A8A"),
    "y_lgs": Look("Residual LGS", "#FF6600"),
    "turbulence": Look("Turbulence", "#003DE6", dash=(8, 2)),
    "vibration": Look("Vibration", "#B40000", dash=(6, 3)),
}
"""What is drawn of a record."""

Selection = Sequence[str] | str | None
"""Ids of what is drawn, or one of them; None for all that there is."""


@dataclass(frozen=True)
class RecordPlots:
    """Figures of a record: `record.plot`."""

    record: Record

    def traces(self, *, mode: str | None = None, start: float = 0.0, stop: float | None = None) -> hv.Overlay:
        """Draw measurements and truth over time, from `start` to `stop` [s]."""
        (name, column), dt = _mode_of(self.record.n_modes, mode), self.record.dt
        y, part = quantity(f"signal {name}", "nm", name), _samples(self.record, start, stop)
        return overlay(draw_trace(NM * x, dt, y, SIGNALS[key], part) for key, x in self._signals(column).items())

    def spectra(self, *, mode: str | None = None) -> hv.Overlay:
        """Draw power spectral densities of measurements and truth; a missing sample has the value of the one before."""
        (name, column), dt = _mode_of(self.record.n_modes, mode), self.record.dt
        y, lines = quantity(f"PSD {name}", "nm²/Hz", f"PSD, {name}"), []
        for key, x in self._signals(column).items() if self.record.n_steps >= FEWEST else ():
            frequency, density = psd(hold_last(x[:, None]), dt)
            lines.append(draw_line(frequency[1:], NM**2 * density[1:, 0], (FREQUENCY, y), SIGNALS[key]))
        return overlay(_some(lines, f"spectrum of fewer than {FEWEST} samples"), log="xy")

    def _signals(self, column: int) -> dict[str, Array]:
        every = {key: getattr(self.record, key) for key in SIGNALS}
        return {key: x[:, column] for key, x in every.items() if x is not None}


@dataclass(frozen=True)
class ResultPlots:
    """Figures of a result: `result.plot`.

    `observers` are ids, by default all that gave an estimate; `target` is "turbulence" or "vibration", by default both, one below
    the other.
    """

    result: Result

    def traces(
        self,
        *,
        observers: Selection = None,
        target: str | None = None,
        mode: str | None = None,
        of_error: bool = False,
        start: float = 0.0,
        stop: float | None = None,
    ) -> hv.Layout:
        """Draw truth and estimates over time, or the errors of the estimates, from `start` to `stop` [s]."""
        (name, column), record, figures = _mode_of(self.result.record.n_modes, mode), self.result.record, []
        for of, signals in self._signals(observers, target, of_error).items():
            y = quantity(f"{of} {name} {of_error}", "nm", f"{'error of ' if of_error else ''}{of}, {name}")
            part = _samples(record, start, stop)
            figures.append(overlay(draw_trace(NM * x[:, column], record.dt, y, key, part) for key, x in signals.items()))
        return stack(figures)

    def spectra(
        self,
        *,
        observers: Selection = None,
        target: str | None = None,
        mode: str | None = None,
        of_error: bool = False,
    ) -> hv.Layout:
        """Draw power spectral densities of truth and estimates, or of the errors, after the warm-up."""
        return self._of_frequency("PSD", "nm²/Hz", lambda _, density: NM**2 * density, observers, target, mode, of_error)

    def cumulative(
        self,
        *,
        observers: Selection = None,
        target: str | None = None,
        mode: str | None = None,
        of_error: bool = True,
    ) -> hv.Layout:
        """Draw the rms above each frequency of the errors after the warm-up, or of truth and estimates."""
        return self._of_frequency(
            "cumulative rms", "nm", lambda f, density: NM * cumulative_rms(f, density), observers, target, mode, of_error
        )

    def errors(self, *, observers: Selection = None, target: str | None = None, mode: str | None = None) -> hv.Layout:
        """Draw the errors of the table as bars, the least on top, each with its 95 % interval; limits among them."""
        (name, _), figures = _mode_of(self.result.record.n_modes, mode), []
        chosen = self._choose(observers)
        for of in dict.fromkeys(s.target for s in self.result.scores):
            rows = [s for s in self.result.scores if (s.target, s.mode) == (of, name) and s.observer in chosen]
            rows.sort(key=lambda s: s.rms)
            if rows and target in (None, of):
                x = quantity(f"rms {of} {name}", "nm", f"rms error, {of}, {name}")
                of_rows = [(row_label(s.observer), [NM * s.rms], [look(s.observer).light]) for s in rows]
                ends = [None if s.interval is None else (NM * s.interval[0], NM * s.interval[1]) for s in rows]
                most = WIDEST * NM * rows[-1].rms
                if any(end is not None and end[1] > most for end in ends):
                    x.range = (0.0, most)
                figures.append(overlay([draw_bars(of_rows, x), draw_intervals(ends, x)], rows=len(rows)))
        return stack(_some(figures, f"error of {target or 'any target'}"))

    def budget(self, *, observers: Selection = None, target: str | None = None, mode: str | None = None) -> hv.Layout:
        """Draw the error budgets as stacked bars of mean squares, the least on top, and the limit of each as a line.

        Those that are not linear have one only where they are named in `observers`. Raises ValueError where there is none.
        """
        (name, _), figures = _mode_of(self.result.record.n_modes, mode), []
        self._choose(observers)
        found = [it for it in error_budget(self.result, observers=observers, mode=name) if it.terms]
        for of in dict.fromkeys(it.target for it in found):
            rows = sorted((it for it in found if it.target == of), key=lambda it: it.total)
            if target in (None, of):
                x = quantity(f"budget {of} {name}", "nm²", f"mean square, {of}, {name}")
                colours = [TERM_COLOURS[term] for term in TERMS]
                boxes = [(row_label(it.observer), [NM**2 * it.terms[term] for term in TERMS], colours) for it in rows]
                at = [None if it.bound is None else NM**2 * it.bound for it in rows]
                legend = legend_of({label: TERM_COLOURS[term] for term, label in TERMS.items()}, x)
                figures.append(overlay([draw_bars(boxes, x), draw_marks(at, x), *legend], rows=len(rows)))
        return stack(_some(figures, f"error budget of {target or 'any target'}"))

    def _signals(self, observers: Selection, target: str | None, of_error: bool) -> dict[str, dict[str, Array]]:
        """Return target -> what is drawn of it -> (n_steps, n_modes) [um]: the truth, last and so on top, where there is one."""
        out: dict[str, dict[str, Array]] = {}
        chosen = self._choose(observers)
        for of in TARGETS if target is None else (_one_of(TARGETS, target, "target"),):
            truth = self.result.record.truth(of)
            some = [e for e in self.result.estimates if e.target == of and e.observer in chosen and e.observer != NO_ESTIMATE]
            own = {e.observer: e.values for e in some}
            if of_error and truth is None:
                raise ValueError(f"the record has no true {of}, so no error of an estimate: of_error=False draws estimates")
            if of_error:
                out[of] = {key: x - truth for key, x in own.items()}
            else:
                out[of] = own if truth is None else {**own, TRUTH: truth}
        if not any(out.values()):
            raise ValueError(f"nothing to draw: there is no estimate of {target or 'any target'}")
        return {of: signals for of, signals in out.items() if signals}

    def _choose(self, observers: Selection) -> list[str]:
        """Return the ids that are chosen. Raises ValueError for an observer that has neither an estimate nor a score."""
        return _choose(observers, [it.observer for it in (*self.result.estimates, *self.result.scores)], "observer")

    def _of_frequency(
        self,
        what: str,
        unit: str,
        curve: Any,
        observers: Selection,
        target: str | None,
        mode: str | None,
        of_error: bool,
    ) -> hv.Layout:
        (name, column), dt, figures = _mode_of(self.result.record.n_modes, mode), self.result.record.dt, []
        for of, signals in self._signals(observers, target, of_error).items():
            y = quantity(f"{what} {of} {name}", unit, f"{what}{' of error' if of_error else ''}\n{of}, {name}")
            lines = []
            for key, x in signals.items():
                known = x[round(self.result.scenario.run.warm_up / dt) :, column]
                known = known[~np.isnan(known)]
                if known.size >= FEWEST:
                    frequency, density = psd(known[:, None], dt)
                    lines.append(draw_line(frequency[1:], curve(frequency[1:], density[1:, 0]), (FREQUENCY, y), key))
            figures.append(overlay(_some(lines, f"spectrum of {of}"), log="xy"))
        return stack(figures)


@dataclass(frozen=True)
class IdentificationPlots:
    """Figures of an identification: `identification.plot`."""

    identification: Identification

    def spectra(self, record: Record | None = None, *, mode: str | None = None) -> hv.Overlay:
        """Draw the spectrum of the model and its peaks, over that of z, completed, where the record is given."""
        it = self.identification
        name, column = _mode_of(len(it.modes), mode)
        found = it.modes[column]
        y, lines = quantity(f"PSD of z {name}", "nm²/Hz", f"PSD of z, {name}"), []
        if record is not None:
            frequency, density = psd(complete(record.z[record.delay :], record.dt), record.dt)
            lines.append(draw_line(frequency[1:], NM**2 * density[1:, column], (FREQUENCY, y), "measured"))
        peaks = np.array([p.frequency.value for p in found.peaks])
        f = np.unique(np.concatenate([np.geomspace(1.0 / it.duration, 0.5 / it.dt, 4000), peaks]))
        lines.append(draw_line(f, NM**2 * found.spectrum.psd(f), (FREQUENCY, y), "fitted"))
        points = hv.Scatter((peaks, NM**2 * found.spectrum.psd(peaks)), FREQUENCY, y, label=look("found").label)
        shape = {"size": 7, "marker": "inverted_triangle"}, {"s": 14, "marker": "v"}
        return overlay([*lines, style(points, color=look("found").light, bokeh=shape[0], matplotlib=shape[1])], log="xy")


@dataclass(frozen=True)
class SweepPlots:
    """Figures of a sweep: `results.plot`."""

    results: SweepResults

    def errors(self, *, observers: Selection = None, target: str = "vibration", mode: str | None = None) -> hv.Overlay:
        """Draw mean errors over the setting, each with its 95 % interval; over two settings, the best observer and its error."""
        known = self.results.known_keys()
        name = _one_of(list(dict.fromkeys(key[2] for key in known)), mode, "mode")
        _one_of(list(dict.fromkeys(key[1] for key in known)), target, "target")
        chosen = _choose(observers, [key[0] for key in known], "observer")
        y = quantity(f"mean rms {target} {name}", "nm", f"mean rms error\n{target}, {name}")
        if len(self.results.sweep.axes) == 2:
            return self._map(target, name, y)
        (axis,) = self.results.sweep.axes
        (x, places, ticks), parts = self._place("x", axis), []
        for key in [k for k in known if k[1:] == (target, name) and k[0] in chosen]:
            cells = [(at, self.results.error(i, key)) for i, at in enumerate(places)]
            points = np.array([(value, *(NM * e for e in error)) for value, error in cells if error is not None])
            if key[0] != NO_ESTIMATE and len(points):
                at, mean, low, high = points[points[:, 0].argsort()].T
                band = hv.Spread((at, mean, mean - low, high - mean), x, [y, "below", "above"])
                colour = look(key[0]).light
                style(band, alpha=0.15, color=colour, show_legend=False, bokeh={}, matplotlib={"facecolor": colour})
                parts += [band, draw_line(at, mean, (x, y), key[0])]
        return overlay(_some(parts, f"error of {target}"), **ticks)

    def _place(self, name: str, axis: Variation) -> tuple[hv.Dimension, list[float], dict[str, Any]]:
        """Return what an axis is of, where its values lie, and options with what stands there, where they are no numbers."""
        x, is_numeric = (
            quantity(axis.path, unit_text(self.results.sweep.base.unit(axis.path))),
            set(map(type, axis.values)) <= {int, float},
        )
        places = [float(value) if is_numeric else float(i) for i, value in enumerate(axis.values)]
        ticks = [(at, str(value)) for at, value in zip(places, axis.values, strict=True)]
        return x, places, {} if is_numeric else {f"{name}ticks": ticks}

    def _map(self, target: str, mode: str, of: hv.Dimension) -> hv.Overlay:
        first, second = self.results.sweep.axes
        (x, across, x_ticks), (y, up, y_ticks) = self._place("x", first), self._place("y", second)
        places = [(a, b) for a in across for b in up]
        best = {i: self.results.winner(i, target, mode) for i in range(len(places))}
        cells = [(*places[i], NM * it.rms, look(it.name).label) for i, it in best.items() if it]
        field = hv.HeatMap([cell[:3] for cell in cells], [x, y], of)
        style(field, cmap="cividis", alpha=0.5, bokeh={}, matplotlib={"show_values": False})
        names = hv.Labels([(a, b, f"{name}\n{error:.1f} nm") for a, b, error, name in cells], [x, y], "best")
        style(names, bokeh={"text_font_size": "8pt", "text_color": "black"}, matplotlib={"size": 6, "color": "black"})
        return overlay([field, names], **x_ticks, **y_ticks)


@dataclass(frozen=True)
class LoopPlots:
    """Figures of a closed loop: `loop.plot`. `controllers` are ids, by default all for which there is something to draw."""

    loop: ClosedLoop

    def residuals(self, *, controllers: Selection = None, mode: str | None = None) -> hv.Overlay:
        """Draw power spectral densities of what every controller left."""
        (chosen, name, column), dt = self._choose(controllers, mode), self.loop.record.dt
        y, lines = quantity(f"PSD of residual {name}", "nm²/Hz", f"PSD of residual\n{name}"), []
        for it in self.loop.outcomes:
            if it.residual is not None and it.controller in chosen:
                frequency, density = psd(it.residual[round(self.loop.design.start / dt) :], dt)
                lines.append(draw_line(frequency[1:], NM**2 * density[1:, column], (FREQUENCY, y), it.controller))
        return overlay(_some(lines, "residual"), log="xy")

    def errors(self, *, controllers: Selection = None, mode: str | None = None) -> hv.Overlay:
        """Draw the rms of what every controller left as bars, the least on top."""
        chosen, name, column = self._choose(controllers, mode)
        left = {it.controller: residual_rms(it, self.loop.record, self.loop.design.start) for it in self.loop.outcomes}
        known = {key: NM * rms[column] for key, rms in left.items() if rms is not None}
        known = {key: known[key] for key in sorted(known, key=known.__getitem__) if key in chosen}
        x = quantity(f"rms of residual {name}", "nm", f"rms of residual, {name}")
        _some(list(known), "residual")
        return overlay([draw_bars([(look(k).label, [v], [look(k).light]) for k, v in known.items()], x)], rows=len(known))

    def rejection(self, *, controllers: Selection = None, mode: str | None = None) -> hv.Overlay:
        """Draw the gain from the disturbance to the residual of every time-invariant loop."""
        y = quantity("rejection", "dB")
        found = self._curves(controllers, mode).items()
        lines = [draw_line(c.frequency, 20.0 * np.log10(np.abs(c.rejection)), (FREQUENCY, y), key) for key, c in found]
        return overlay(_some(lines, "time-invariant loop"), log="x")

    def nyquist(self, *, controllers: Selection = None, mode: str | None = None) -> hv.Overlay:
        """Draw the loop gain of every time-invariant loop in the complex plane, around the point -1."""
        axes = quantity("loop gain, real", ""), quantity("loop gain, imaginary", "")
        parts: list[Any] = []
        for key, c in self._curves(controllers, mode).items():
            gain = c.loop_gain[np.isfinite(c.loop_gain)]
            parts.append(draw_line(gain.real, gain.imag, axes, key))
        _some(parts, "time-invariant loop")
        point = hv.Scatter(([-1.0], [0.0]), *axes, label="-1")
        style(point, color="black", bokeh={"marker": "star", "size": 9}, matplotlib={"marker": "*", "s": 30})
        return overlay([*parts, point], xlim=(-3.0, 1.5), ylim=(-2.0, 2.0))

    def _choose(self, controllers: Selection, mode: str | None) -> tuple[list[str], str, int]:
        chosen = _choose(controllers, [it.controller for it in self.loop.outcomes], "controller")
        return chosen, *_mode_of(len(self.loop.scenario.modes), mode)

    def _curves(self, controllers: Selection, mode: str | None) -> dict[str, Curves]:
        (chosen, _, column), plan = self._choose(controllers, mode), self.loop.design
        laws = {key: of[column] for key, of in plan.laws.items() if key in chosen}
        known = {key: it.law.poles for key, it in laws.items() if it.law and it.margins}
        return {key: curves(plan.loop(key, column), poles, self.loop.record.dt) for key, poles in known.items()}


@dataclass(frozen=True)
class EnvelopePlots:
    """Figures of controllers over an uncertain plant: `envelope.plot`."""

    envelope: PlantEnvelope

    def residuals(self, *, over: str = "delay", controllers: Selection = None, mode: str | None = None) -> hv.Overlay:
        """Draw the rms of the residual against one error of the plant: the mean and the largest of the stable plants of a bin.

        over : "delay", "gain", "rotation" or "resonance"
        """
        of, (mode, column) = self.envelope, _mode_of(len(self.envelope.scenario.modes), mode)
        over, unit = _one_of(list(of.errors), over, "error"), {"delay": "frames", "rotation": "deg"}.get(over, "")
        x, y = quantity(f"error of {over}", unit), quantity(f"rms {mode}", "nm", f"residual, {mode}")
        lines, found = list[Any](), of.curves(over, column)
        for name in _choose(controllers, list(found), "controller"):
            (at, mean, most), it = found[name], look(name)
            known, worst = np.isfinite(mean), Look(f"{it.label}, worst", it.light, it.dark, (2, 2))
            lines.append(draw_line(at[known], NM * mean[known], (x, y), it))
            lines.append(draw_line(at[known], NM * most[known], (x, y), worst))
        return overlay(_some(lines, "stable plant"), log="y")


@singledispatch
def plots_of(source: object) -> Any:
    """Return the figures of an object."""
    raise TypeError(f"no figures of {type(source).__name__}")


for _kind, _plots in {
    Record: RecordPlots,
    Result: ResultPlots,
    Identification: IdentificationPlots,
    SweepResults: SweepPlots,
    ClosedLoop: LoopPlots,
    PlantEnvelope: EnvelopePlots,
}.items():
    plots_of.register(_kind, _plots)


def _mode_of(n_modes: int, name: str | None) -> tuple[str, int]:
    """Return the name of one of so many modes, by default of the first, and its column. Raises ValueError."""
    names = MODE_NAMES[:n_modes]
    name = _one_of(names, name, "mode")
    return name, names.index(name)


def _one_of(names: Sequence[str], name: str | None, what: str) -> str:
    """Return a name, by default the first. Raises ValueError for one that is not there."""
    if name is not None and name not in names:
        raise ValueError(f"{what} {name!r}: there are {', '.join(names)}")
    return names[0] if name is None else name


def _some(parts: list[Any], what: str) -> list[Any]:
    """Return a list that is not empty. Raises ValueError."""
    if not parts:
        raise ValueError(f"nothing to draw: there is no {what}")
    return parts


def _choose(selection: Selection, names: Sequence[str], what: str) -> list[str]:
    """Return which of some names are chosen, in their order. Raises ValueError for one that is not there."""
    names, chosen = list(dict.fromkeys(names)), name_list(selection)
    for name in chosen or ():
        _one_of(names, name, what)
    return [name for name in names if chosen is None or name in chosen]


def _samples(record: Record, start: float, stop: float | None) -> slice:
    """Return which samples lie between two times [s]. Raises ValueError where there are not two of them."""
    n, dt = record.n_steps, record.dt
    first, last = round(start / dt), n if stop is None else min(round(stop / dt), n)
    if not 0 <= first < last - 1:
        raise ValueError(f"nothing to draw from {start:g} s to {last * dt:g} s: the record has {n * dt:g} s")
    return slice(first, last)
