"""The paper's figures: what is drawn in each, and by whom; the page *Paper figures* draws the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from wfsobs.evaluation.exact_errors import TRUTH, spectra
from wfsobs.evaluation.result import Result
from wfsobs.observers.base import TURBULENCE, VIBRATION
from wfsobs.plot.looks import look
from wfsobs.record import Record, RecordError
from wfsobs.sensors.zernike import TIP_TILT
from wfsobs.signal.envelope import envelope, envelope_times
from wfsobs.typing import Array

if TYPE_CHECKING:
    import holoviews as hv

ZOOM_S = 0.5
"""Length of a zoomed plot [s], in the middle of the record."""

BINS = 700
PSD_TOP_HZ, DECADES = 100.0, 5
WHOLE, ZOOMED, SPECTRUM = "whole record", "zoomed", "power spectrum"


@dataclass(frozen=True)
class Plot:
    """One plot: what of it (WHOLE, ZOOMED, SPECTRUM), of which column of the arrays."""

    what: str
    column: int = 0

    @property
    def is_spectrum(self) -> bool:
        """Whether it is over frequency."""
        return self.what == SPECTRUM

    @property
    def window(self) -> str:
        """Which samples it is of."""
        return WHOLE if self.is_spectrum else self.what

    @property
    def label(self) -> str:
        """What its axis of y is of."""
        mode = TIP_TILT[self.column].name
        return f"PSD, {mode}" if self.is_spectrum else mode

    def unit(self, length: str) -> str:
        """Return the unit of its axis of y, made of one of length."""
        return f"{length}²/Hz" if self.is_spectrum else length


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


@dataclass(frozen=True)
class PlotLines:
    """What a plot shows.

    lines : name of an observer or of the truth, which is last and so on top -> x [s or Hz], y [um, or um^2/Hz of a spectrum]
    ends  : of the axis of x
    """

    lines: dict[str, tuple[Array, Array]]
    ends: tuple[float, float]


def drawn_lines(
    of: PaperFigure, plot: Plot, record: Record, warm_up: float, values: Callable[[str, str], Array | None]
) -> PlotLines:
    """Return the lines of a plot, none of a mode that is not there or of a spectrum of too few samples.

    values : (name, target) -> (n_steps, n_modes) [um], None where there are none
    """
    lines, (first, last) = dict[str, tuple[Array, Array]](), samples_of(record, warm_up)[plot.window]
    for name in (*of.observers, TRUTH):
        x = values(name, of.target)
        if x is None or plot.column >= record.n_modes:
            continue
        if not plot.is_spectrum:
            lines[name] = envelope_times(first, last, BINS, record.dt), envelope(x[first:last, plot.column], BINS)
        elif (found := spectra(record, of.target, x, warm_up, [plot.column])) is not None:
            within = (found[0] > 0) & (found[0] <= PSD_TOP_HZ)
            lines[name] = found[0][within], found[1][within, 0]
    return PlotLines(lines, (0.0, PSD_TOP_HZ) if plot.is_spectrum else (first * record.dt, last * record.dt))


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
        Plots below each other, in micrometres, as the paper states its errors; without those that have no line.

    Raises
    ------
    RecordError
        There is no estimate to draw.
    """
    from wfsobs.plot.elements import stack

    known = [it for it in NUMBERS[name] if any(result.estimate(observer, it.target) for observer in it.observers)]
    if not known:
        raise RecordError(f"{name}: the record allows no estimate of {', '.join(observers_in(name))}")
    drawn = [_draw_plot(it, plot, result) for it in known for plot in it.plots]
    return stack([one for one in drawn if one is not None])


def _draw_plot(of: PaperFigure, plot: Plot, result: Result) -> hv.Overlay | None:
    from wfsobs.plot.elements import FREQUENCY, TIME, draw_line, overlay, quantity

    def values(name: str, target: str) -> Array | None:
        estimate = result.estimate(name, target)
        return result.record.truth(target) if name == TRUTH else estimate and estimate.values

    shown, drawn = drawn_lines(of, plot, result.record, result.scenario.run.warm_up, values), []
    if not shown.lines:
        return None
    label = plot.label if plot.is_spectrum else f"{of.target}, {plot.label}"
    y = quantity(f"{of.number} {plot.what} {plot.column}", plot.unit("µm"), label)
    for name, line in shown.lines.items():
        its = replace(look(name), label=of.reference if name == TRUTH else LABELS.get(name, look(name).label))
        its = its if is_dashed(name, of) else replace(its, dash=())
        drawn.append(draw_line(*line, (FREQUENCY if plot.is_spectrum else TIME, y), its))
    return overlay(drawn, log="y" if plot.is_spectrum else "", decades=DECADES, xlim=shown.ends)


def is_dashed(name: str, of: PaperFigure) -> bool:
    """Return whether a line has its dashes; one alone with the reference needs none."""
    return name == TRUTH or len(of.observers) > 1


LABELS = {"butterworth-ol": "Filtered vibration, open loop", "butterworth-cl": "Filtered vibration, closed loop"}
"""What the captions call what the page names shorter."""
