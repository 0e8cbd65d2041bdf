"""The paper's figures: what is drawn in each, and by whom; the page *Paper figures* draws the same."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.evaluation.error_spectra import TRUTH, spectra
from wfsobs.evaluation.result import Result
from wfsobs.observers.base import TURBULENCE, VIBRATION
from wfsobs.plot.looks import look
from wfsobs.record import Record, RecordError
from wfsobs.sensors.modes import TIP_TILT
from wfsobs.signal.envelope import envelope, envelope_times
from wfsobs.typing import Array

if TYPE_CHECKING:
    import holoviews as hv

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

    reference    : how its caption names the truth
    paper_errors : (observer, the RMS error that the paper states, taken as [um])
    """

    number: str
    title: str
    caption: str
    target: str
    observers: tuple[str, ...]
    plots: tuple[Plot, ...]
    reference: str
    paper_errors: tuple[tuple[str, float], ...] = ()


FIGURES = (
    PaperFigure(
        "4a",
        "Butterworth reference, open loop",
        "Vibration filtered from open-loop data, the grey stretch enlarged below; tip only.",
        VIBRATION,
        ("butterworth-ol",),
        (Plot(WHOLE), Plot(ZOOMED)),
        "Real vibration",
        (("butterworth-ol", 7.66e-3),),
    ),
    PaperFigure(
        "4b",
        "Butterworth reference, closed loop",
        "Vibration filtered from closed-loop data, the grey stretch enlarged below; tip only.",
        VIBRATION,
        ("butterworth-cl",),
        (Plot(WHOLE), Plot(ZOOMED)),
        "Real vibration",
        (("butterworth-cl", 13.4e-3),),
    ),
    PaperFigure(
        "5",
        "Estimation of the atmospheric turbulence",
        "Tip above, tilt below.",
        TURBULENCE,
        ("kf-lgs", "kf-ngs", "multirate"),
        (Plot(WHOLE, 0), Plot(WHOLE, 1)),
        "Reference",
    ),
    PaperFigure(
        "6",
        "Estimation of structural vibrations",
        "Traces, the grey stretch enlarged, and power spectra; tip only.",
        VIBRATION,
        ("kf-lgs", "gpr-offline", "gpr-online"),
        (Plot(WHOLE), Plot(ZOOMED), Plot(SPECTRUM)),
        "Real vibration",
        (("kf-lgs", 16.6e-3), ("gpr-offline", 12.4e-3), ("gpr-online", 13.3e-3)),
    ),
)


def samples_of(record: Record, warm_up: float) -> dict[str, tuple[int, int]]:
    """Return the first sample and the one past the last of a whole record after its warm-up [s], and of the zoomed stretch."""
    n = record.n_steps
    begin = min(round(warm_up / record.dt), n - 2)
    middle, half = (begin + n) // 2, min(round(ZOOM_S / record.dt), n - begin) // 2
    return {WHOLE: (begin, n), ZOOMED: (middle - half, middle + half)}


def trace_of(record: Record, values: Array | None, column: int, first: int, last: int) -> tuple[Array, Array]:
    """Return times [s] and values [um] of a trace, NaN where there are no values, the extremes of bins where they are many."""
    shown = np.full(last - first, np.nan) if values is None else values[first:last, column]
    return envelope_times(first, last, BINS, record.dt), envelope(shown, BINS)


def spectrum_part(frequency: Array, density: Array) -> tuple[Array, Array]:
    """Return the part of a spectrum (n,) that is drawn."""
    within = (frequency > 0) & (frequency <= PSD_TOP_HZ)
    return frequency[within], density[within]


NUMBERS = {f"paper-{number}": tuple(it for it in FIGURES if it.number.startswith(number)) for number in "456"}
"""Name of a figure -> its parts."""


def observers_in(name: str) -> tuple[str, ...]:
    """Return the observers that a figure shows."""
    return tuple(observer for it in NUMBERS[name] for observer in it.observers)


def draw_paper_figure(name: str, result: Result) -> hv.Layout:
    """Draw a figure of the paper from a result: what it has estimates for, with a reference where it has a truth.

    Parameters
    ----------
    name : str
        "paper-4" (vibration by the Butterworth filter, open loop above closed loop), "paper-5" (turbulence) or "paper-6"
        (vibration).
    result : Result
        Record and estimates, of `observers_in(name)`.

    Returns
    -------
    holoviews.Layout
        Plots below each other, in micrometres, as the paper states its errors.

    Raises
    ------
    RecordError
        There is no estimate to draw.
    """
    from wfsobs.plot.elements import stack

    known = [it for it in NUMBERS[name] if any(result.estimate(observer, it.target) for observer in it.observers)]
    if not known:
        raise RecordError(f"{name}: the record allows no estimate of {', '.join(observers_in(name))}")
    return stack([_draw_plot(it, plot, result) for it in known for plot in it.plots])


def _draw_plot(of: PaperFigure, plot: Plot, result: Result) -> hv.Overlay:
    from wfsobs.plot.elements import FREQUENCY, TIME, draw_line, overlay, quantity

    record, warm_up, mode = result.record, result.scenario.run.warm_up, TIP_TILT[plot.column].name
    values = {name: it.values for name in of.observers if (it := result.estimate(name, of.target))}
    if (truth := record.truth(of.target)) is not None:
        values[TRUTH] = truth
    label, unit = (f"PSD, {mode}", "µm²/Hz") if plot.what == SPECTRUM else (f"{of.target}, {mode}", "µm")
    first, last = samples_of(record, warm_up)[plot.what if plot.what != SPECTRUM else WHOLE]
    x_axis, ends = (FREQUENCY, (0.0, PSD_TOP_HZ)) if plot.what == SPECTRUM else (TIME, (first * record.dt, last * record.dt))
    y, lines = quantity(f"{of.number} {plot.what} {mode}", unit, label), []
    for name, x in values.items():
        its = replace(look(name), label=of.reference if name == TRUTH else LABELS.get(name, look(name).label))
        its = its if is_dashed(name, of) else replace(its, dash=())
        if plot.what != SPECTRUM:
            lines.append(draw_line(*trace_of(record, x, plot.column, first, last), (x_axis, y), its))
        elif (found := spectra(record, of.target, x, warm_up, [plot.column])) is not None:
            lines.append(draw_line(*spectrum_part(found[0], found[1][:, 0]), (x_axis, y), its))
    return overlay(lines, log="y" if plot.what == SPECTRUM else "", decades=5, xlim=ends)


def is_dashed(name: str, of: PaperFigure) -> bool:
    """Return whether a line has its dashes; one alone with the reference needs none."""
    return name == TRUTH or len(of.observers) > 1


LABELS = {"butterworth-ol": "Filtered vibration, open loop", "butterworth-cl": "Filtered vibration, closed loop"}
"""What the captions call what the page names shorter."""
