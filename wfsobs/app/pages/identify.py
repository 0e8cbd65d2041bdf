"""The model of the record shown: its spectrum, the numbers of what is in it, and whether anything is left."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any, Final, NamedTuple

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource, HoverTool

from wfsobs.app.controls.fields import parse_number
from wfsobs.app.display import Display
from wfsobs.app.jobs import DONE, FAILED, RUNNING, Job, Tell
from wfsobs.app.pages.parts import (
    WIDE,
    LinkedFields,
    Page,
    Starter,
    box,
    boxes,
    html,
    legend,
    line,
    number_field,
    pane,
    read_number,
    render_part,
    text,
    warning,
)
from wfsobs.app.render import render
from wfsobs.app.service import BackgroundTask
from wfsobs.app.share import IDENTIFY, CopiedTask
from wfsobs.app.sources import LoadedRecord, SimulatedRecord, Source, record_key
from wfsobs.app.store import Store
from wfsobs.app.style import look, make_button
from wfsobs.app.views.plots import call, new_spectrum, set_ends
from wfsobs.app.work import RunResults
from wfsobs.identification import Identification, identify
from wfsobs.identification.identification import (
    HIGHEST_LEVEL,
    LEVEL,
    Fit,
    bin_periodogram,
    fitted_spectrum,
    format_number,
    identification_toml,
    mode_rows,
    whiteness_lines,
)
from wfsobs.identification.process import Number
from wfsobs.identification.result import IdentifiedMode
from wfsobs.pipeline import as_stated
from wfsobs.progress import Watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.spectral.search import LOWEST
from wfsobs.spectral.whittle import complete
from wfsobs.typing import Array

PER_SAMPLE = 40e-6
"""Time per sample and mode of a record with some ten peaks [s]; one with thirty takes ten times as long."""


class RecordSpectrum(NamedTuple):
    """The periodogram of z in the bins of an axis: mean and highest, (bins, n_modes) [um^2/Hz], at frequency (bins,) [Hz]."""

    record: Record
    frequency: Array
    mean: Array
    highest: Array


def estimate_record_spectrum(of: RunResults, _watch: Watch, _tell: Tell) -> RecordSpectrum:
    """Estimate the spectrum of the record shown, with the taper that the identification uses. Raises RecordError."""
    record = of.result.record
    return RecordSpectrum(record, *bin_periodogram(complete(record.z[record.delay :], record.dt), record.dt))


def seconds(record: Record) -> float:
    """About how long an identification takes [s]."""
    return PER_SAMPLE * record.n_steps * record.n_modes


def same_content(one: Record, other: Record) -> bool:
    """Whether two records are of the same content."""
    return one is other or record_key(one) == record_key(other)


def compute(of: RunResults, level: float, lowest: float, watch: Watch, _tell: Tell) -> tuple[Identification, Record]:
    """Identify a model in the record shown; return both. Raises RecordError, Cancelled."""
    return identify(of.result.record, level=level, lowest=lowest, watch=watch), of.result.record


HEIGHT = 400
NAMES = {
    "measured": "measured PSD (mean)",
    "highest": "measured PSD (maximum per bin)",
    "fitted": "model",
    "parts": "model components",
    "found": "identified peaks",
}
"""Look -> what it is called in the legend."""


class SpectrumFigure:
    """What was measured, mean and highest value of every bin; over it the model, its parts, and a mark on every peak."""

    def __init__(self) -> None:
        self.figure: Final = new_spectrum((0.1, 500.0))
        self.figure.height = HEIGHT
        call(self.figure, "Spectrum of z and its model")
        self.measurement: Final = ColumnDataSource({"x": [], "mean": [], "highest": []})
        self.total: Final = ColumnDataSource({"x": [], "y": []})
        self.parts: Final = ColumnDataSource({"xs": [], "ys": []})
        self.spikes: Final = ColumnDataSource({"x": [], "low": [], "high": []})
        self.peaks: Final = ColumnDataSource({"x": [], "y": [], "text": []})
        fig = self.figure
        self._glyphs: list[tuple[str, Any]] = [
            ("highest", fig.line("x", "highest", source=self.measurement, line_alpha=0.45, line_width=1.0)),
            ("measured", fig.line("x", "mean", source=self.measurement, line_width=1.0)),
            ("parts", fig.multi_line("xs", "ys", source=self.parts, line_width=1.2, line_dash=list(look("parts").dash))),
            ("fitted", fig.line("x", "y", source=self.total, line_width=2.2)),
            ("found", fig.segment("x", "low", "x", "high", source=self.spikes, line_width=2.2)),
            ("found", fig.scatter("x", "y", source=self.peaks, marker="inverted_triangle", size=8)),
        ]
        fig.add_tools(HoverTool(renderers=[self._glyphs[-1][1]], tooltips="@text"))

    def draw_measured(self, of: RecordSpectrum, display: Display, scale: float) -> None:
        """Send what was measured, and have the axes hold it. scale : of densities."""
        column = display.column
        mean, highest = scale * of.mean[:, column], scale * of.highest[:, column]
        self.measurement.data = {"x": of.frequency, "mean": mean, "highest": highest}
        positive = mean[mean > 0]
        if positive.size:
            set_ends(self.figure.y_range, float(np.quantile(positive, 0.01)) / 5.0, float(highest.max()) * 6.0)
        set_ends(self.figure.x_range, float(of.frequency[0]), float(of.frequency[-1]))
        self.figure.yaxis.axis_label = f"PSD of z, {display.mode_label} [{display.unit_label}²/Hz]"
        for name, renderer in self._glyphs:
            colour = look(name).colour(display.dark)
            renderer.glyph.update(**dict.fromkeys({"line_color", "fill_color"} & renderer.glyph.properties(), colour))

    def draw_fit(self, mode: IdentifiedMode | None, of: Fit | None, scale: float) -> None:
        """Send the model of the mode shown, or nothing."""
        if mode is None or of is None:
            for source in (self.total, self.parts, self.spikes, self.peaks):
                source.data = {str(name): [] for name in source.data}
            return
        self.total.data = {"x": of.frequency, "y": scale * of.total}
        self.parts.data = {"xs": [of.frequency] * len(of.parts), "ys": [scale * part for part in of.parts]}
        x, low, high = np.array(of.lines).reshape(-1, 3).T
        self.spikes.data = {"x": x, "low": scale * low, "high": scale * high}
        tops = dict(zip(x.tolist(), high.tolist(), strict=True))
        at = [p.frequency.value for p in mode.peaks]
        self.peaks.data = {
            "x": at,
            "y": [1.6 * scale * (tops.get(f) or float(np.interp(f, of.frequency, of.total))) for f in at],
            "text": [f"{'line' if p.pure else 'resonance'} {p.frequency.value:.5g} Hz" for p in mode.peaks],
        }


def identification_html(mode: IdentifiedMode, display: Display, scale: float) -> str:
    """Noise, turbulence and peaks of a mode, each number with its standard deviation. scale : of micrometres."""
    return render_part("identified", display, mode=mode, rows=mode_rows(mode), deviation=deviation_text, scale=scale)


def deviation_text(number: Number | None, scale: float = 1.0) -> str:
    """Write a number and its standard deviation, where there is one; nothing for none.

    >>> deviation_text(Number(47.43812, 0.0264)), deviation_text(Number(1.9, float("nan")))
    ('47.438 ± 0.026', '1.9')
    """
    if number is None:
        return ""
    text = format_number(Number(number.value * scale, number.std * scale))
    return text.replace("+-", "±").replace("-", "−").removesuffix(" ± −")


def verdict_html(result: Identification) -> str:
    """Whether anything is left, mode by mode."""
    is_white = [mode.whiteness.white for mode in result.modes]
    return render("pages/whiteness.html", lines=list(zip(is_white, whiteness_lines(result), strict=True)))


INTRO = (
    "A model is fitted to the pseudo-open-loop measurement z of the record shown, simulated or loaded: white noise, turbulence, "
    "then vibration peaks one at a time until the tests find no further peak. “Filters only” keeps the record and sets the "
    "filters to this model. “As a new simulation” replaces the record by a simulation of this model; the filters then know the "
    "simulated spectra exactly."
)
ABOUT = (
    "± is one standard deviation. The residual of a mode is called white if no candidate peak remains and it passes two tests "
    "of level 1 %: Bartlett's on the cumulative ratio of the measured to the fitted spectrum, and Ljung and Box's on the "
    "innovations of the model's Kalman filter. p is the probability that white noise deviates from whiteness by more."
)
EARLIER = "This model was identified from an earlier record than the one shown."
REPLACED = (
    "A simulation of the model has replaced the record from which it was identified. The filters now know the simulated "
    "spectra: do not compare their errors with those on the earlier record. Undo brings that record back."
)


def model_toml(finding: tuple[Identification, Record, Scenario]) -> bytes:
    """Write the model as `wfsobs identify --out` does."""
    result, record, scenario = finding
    return identification_toml(result, result.scenario(as_stated(record, scenario))).encode()


class IdentifyPage(Page):
    """The page. The measured spectrum follows the results shown while it is visible; the model comes when asked for."""

    files = {"Model as TOML": ("wfsobs-model.toml", model_toml)}

    def __init__(self, store: Store, display: Display):
        super().__init__(store, display)
        self.work: Final = BackgroundTask(store.session, title="Identification")
        uses = {"Filters only": self.tell_filters, "As a new simulation": partial(self._take, None)}
        words = "Identify the record", "Progress of the identification"
        self.starter: Final = Starter(self.work, self._start, *words, uses=uses)
        self.level: Final = number_field("Level", LEVEL, 120)
        self.lowest: Final = number_field("Lowest peak [Hz]", LOWEST, 120)
        self.link = LinkedFields({"level": self.level, "lowest": self.lowest})
        self.figure: Final = SpectrumFigure()
        self.legend, self.table, self.verdict, self.note = (html() for _ in range(4))
        self.stale: Final = warning(EARLIER)
        self.of: RecordSpectrum | None = None
        self.measuring: Final = BackgroundTask(store.session)
        self._scenario: Scenario | None = None
        self._spectrum = object()
        self.work.param.watch(self.redraw, "result")
        self.measuring.param.watch(self._land, ["state", "place"])
        self.run.param.watch(self.follow, ["result", "state"])

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        row = line(self.level, self.lowest, *self.starter.view())
        return boxes(
            box("Identification", text(INTRO), row, self.starter.status, self.stale, self.verdict),
            box("Spectrum", self.legend, self.note, pane(self.figure.figure)),
            box("Model", self.table, text(ABOUT)),
        )

    def _start(self) -> None:
        of = self.shown_results()
        work = partial(compute, of, read_number(self.level, 1e-9, HIGHEST_LEVEL), read_number(self.lowest, 1e-3, 1e4))
        self.work.start(self.store.limits.job("identify", "identification", work, seconds(of.result.record)))

    def tell_filters(self) -> None:
        """Take the model into the settings, for the filters alone: the record stays, be it loaded or simulated."""
        self._take(self.store.source or SimulatedRecord(self.store.scenario))

    @property
    def is_used(self) -> bool:
        """Whether the settings are those of the model identified in the record shown."""
        if (found := self.work.result) is None or (shown := self.run.result) is None:
            return False
        result, record = found
        return same_content(record, shown.result.record) and result.scenario(self.store.scenario) == self.store.scenario

    @property
    def task(self) -> CopiedTask:
        """To identify the record."""
        return CopiedTask(IDENTIFY, {name: parse_number(str(getattr(self, name).value)) for name in ("level", "lowest")})

    @property
    def finding(self) -> tuple[Identification, Record, Scenario] | None:
        """The model, the record from which it was identified, and the settings that it is of."""
        return None if self.work.result is None else (*self.work.result, self.store.scenario)

    def _take(self, source: Source | None) -> None:
        if self.work.result is not None:
            result, _ = self.work.result
            self.store.run_on(source, result.scenario(self.store.scenario))
            self._scenario = self.store.scenario if source is None else None
            self.redraw()

    def follow(self, *_: object) -> None:
        """Measure the record shown, once its run is over."""
        of = self.run.result
        if not self.visible or of is None or self.run.state == RUNNING or of is self._spectrum:
            return
        self._spectrum = of
        self.measuring.start(Job("identify", partial(estimate_record_spectrum, of), refusal=RecordError))

    def _land(self, *_: object) -> None:
        task = self.measuring
        if task.state in (DONE, FAILED):
            self.of = task.result if task.state == DONE else None
        said = f'<p class="failure">No spectrum: {escape(task.message)}</p>' if task.state == FAILED else ""
        self.note.html = f'<p class="text">{task.line()}</p>' if task.place else said
        if task.state != RUNNING:
            self.redraw()

    def draw(self) -> None:
        """Draw the spectrum, and the model of it where there is one."""
        of, shown = self.of, self.run.result
        if of is None or shown is None or self.display.column >= of.mean.shape[1]:
            return
        scale, column = self.display.scale(shown.scenario), self.display.column
        self.legend.html = legend(NAMES, self.display.dark)
        self.figure.draw_measured(of, self.display, scale**2)
        if self.work.result is None:
            self.figure.draw_fit(None, None, 1.0)
            return
        result, record = self.work.result
        mode = result.modes[column] if column < len(result.modes) else None
        self.figure.draw_fit(mode, fitted_spectrum(mode, result) if mode else None, scale**2)
        self.verdict.html = verdict_html(result)
        self.table.html = identification_html(mode, self.display, scale) if mode else ""
        replaced = self.store.source is None and self._scenario == self.store.scenario
        self.stale.param.update(object=REPLACED if replaced else EARLIER, visible=not same_content(record, of.record))


NEXT = "Next: identify noise, turbulence and vibration peaks in this record, as prior knowledge of the observers."
IDENTIFIED = "The observers use what was identified in this record."


class Suggestion:
    """The line above the first results of a loaded record: its button identifies it and has the filters use the model."""

    def __init__(self, store: Store, make_page: Callable[[], IdentifyPage]):
        self.store = store
        self._make_page = make_page
        self.page: IdentifyPage | None = None
        self._waits = False  # for a model that is to be used once it is there
        self.words: Final = html()
        self.button: Final = make_button("Identify", self._identify, icon="troubleshoot")
        self.view: Final = pn.FlexBox(self.words, self.button, gap="8px 12px", align_items="center", visible=False, **WIDE)
        self.words.sizing_mode = None
        store.param.watch(self._refresh, ["source", "scenario"])
        store.run.param.watch(self._refresh, "state")

    def follow(self, page: IdentifyPage) -> IdentifyPage:
        """Say from now on how far the page is; return it."""
        self.page = page
        page.work.param.watch(self._refresh, ["state", "progress", "message"])
        return page

    def _identify(self) -> None:
        page = self._make_page()
        page.starter.begin()
        self._waits = page.work.state == RUNNING
        self._refresh()

    def _refresh(self, *_: object) -> None:
        said, is_running, used = NEXT, False, False
        if self.page is not None:
            work = self.page.work
            is_running = work.state == RUNNING
            if self._waits and not is_running:
                self._waits = False
                if work.state == DONE:
                    work.attempt(self.page.tell_filters)
            used = self.page.is_used
            said = IDENTIFIED if used else work.line("Identifying") if is_running else work.message or NEXT
        with pn.io.hold():
            self.words.html = f'<p class="text" role="status">{escape(said)}</p>'
            self.button.param.update(visible=not used, disabled=is_running or self.store.run.state != DONE)
            self.view.visible = isinstance(self.store.source, LoadedRecord)
