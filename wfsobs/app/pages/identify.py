"""The model of the record shown: its spectrum, the numbers of what is in it, and whether anything is left."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from html import escape

import panel as pn
import panel_material_ui as pmui

from wfsobs.app.controls.fields import parse_number
from wfsobs.app.copies import IDENTIFY, CopiedTask
from wfsobs.app.display import Display
from wfsobs.app.downloads import Save
from wfsobs.app.identify_work import (
    RecordSpectrum,
    compute,
    estimate_record_spectrum,
    fitted_spectrum,
    same_measurements,
    seconds,
)
from wfsobs.app.jobs.job import DONE, FAILED, RUNNING, Job
from wfsobs.app.jobs.task import BackgroundTask
from wfsobs.app.pages.identify_figure import NAMES, SpectrumFigure
from wfsobs.app.pages.identify_table import identification_html, verdict_html
from wfsobs.app.pages.link import LinkedFields
from wfsobs.app.pages.parts import WIDE, PageActions, Starter, box, html, legend, line, text
from wfsobs.app.sources import SimulatedRecord, Source
from wfsobs.app.store import Store
from wfsobs.identification import Identification
from wfsobs.identification.identification import LEVEL
from wfsobs.identification.report import identification_toml
from wfsobs.pipeline import as_stated
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError
from wfsobs.settings.parameters import hint
from wfsobs.spectral.search import LOWEST

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


class IdentifyPage(PageActions):
    """The page. The measured spectrum follows the results shown while it is visible; the model comes when asked for."""

    def __init__(self, store: Store, display: Display):
        self.store, self.run, self.display = store, store.run, display
        self.work = BackgroundTask(store.session, title="Identification")
        self.starter = Starter(
            self.work, "Identify the record", "Progress of the identification", uses=("Filters only", "As a new simulation")
        )
        self.level, self.lowest = _number("Level", LEVEL), _number("Lowest peak [Hz]", LOWEST)
        self.inputs = (self.level, self.lowest)
        self.link = LinkedFields(level=self.level, lowest=self.lowest)
        self.figure = SpectrumFigure()
        self.legend, self.table, self.verdict, self.note = html(), html(), html(), html()
        self.stale = pmui.Alert(object=EARLIER, severity="warning", visible=False, **WIDE)
        self.of: RecordSpectrum | None = None
        self.measuring = BackgroundTask(store.session)
        self._scenario: Scenario | None = None
        self.visible, self._spectrum = False, object()
        self.starter.start.on_click(lambda _event: self.start())
        filters, simulation = self.starter.uses
        filters.on_click(lambda _event: self.tell_filters())
        simulation.on_click(lambda _event: self.simulate())
        self.work.param.watch(self._redraw, "result")
        self.measuring.param.watch(self._land, ["state", "place"])
        self.run.param.watch(self._follow, ["result", "state"])
        display.param.watch(self._redraw, ["mode", "unit", "dark"])

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        row = line(self.level, self.lowest, *self.starter.view())
        return pn.Column(
            box("Identification", text(INTRO), row, self.starter.status, self.stale, self.verdict),
            box("Spectrum", self.legend, self.note, pn.pane.Bokeh(self.figure.figure, **WIDE)),
            box("Model", self.table, text(ABOUT)),
            **WIDE,
            stylesheets=[":host { gap: 10px; }"],
        )

    def show(self, visible: bool) -> None:
        """Draw what has changed meanwhile, and go on while visible."""
        self.visible = visible
        self._follow()
        self._redraw()  # mode, unit or theme may have changed

    def start(self) -> None:
        """Identify the record shown."""
        of = self.run.result
        if of is None:
            self.work.refuse("There is no record yet.")
            return
        try:
            level, lowest = _read(self.level, 1e-9, 0.5), _read(self.lowest, 1e-3, 1e4)
            cost = seconds(of.result.record)
            self.store.limits.check_seconds(cost, "identification")
        except SettingError as error:
            self.work.refuse(str(error))
        else:
            work = partial(compute, of, level, lowest)
            self.work.start(Job("identify", work, cost=cost, time_limit=self.store.limits.seconds))

    def tell_filters(self) -> None:
        """Take the model into the settings, for the filters alone: the record stays, be it loaded or simulated."""
        self._take(self.store.source or SimulatedRecord(self.store.scenario))

    def simulate(self) -> None:
        """Take the model into the settings, and simulate it in place of the record."""
        self._take(None)

    @property
    def task(self) -> CopiedTask:
        """To identify the record."""
        return CopiedTask(
            IDENTIFY, {"level": parse_number(str(self.level.value)), "lowest": parse_number(str(self.lowest.value))}
        )

    def saves(self) -> Mapping[str, Save | None]:
        """Offer the model as `wfsobs identify --out` writes it."""
        result, record = self._model_and_record()
        if result is None or record is None:
            return {"Model as TOML": None}
        text = identification_toml(result, result.scenario(as_stated(record, self.store.scenario)))
        return {"Model as TOML": Save("wfsobs-model.toml", "application/toml", text.encode)}

    def _take(self, source: Source | None) -> None:
        result, _ = self._model_and_record()
        if result is not None:
            try:
                self.store.run_on(source, result.scenario(self.store.scenario))
            except SettingError as error:
                self.work.refuse(str(error))
            else:
                self._scenario = self.store.scenario if source is None else None
                self._redraw()

    def _follow(self, *_: object) -> None:
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
        self.note.object = f'<p class="text">{task.line()}</p>' if task.place else said
        if task.state != RUNNING:
            self._redraw()

    def _model_and_record(self) -> tuple[Identification, Record] | tuple[None, None]:
        """Return the model and the record from which it was identified."""
        return self.work.result or (None, None)

    def _redraw(self, *_: object) -> None:
        of, shown = self.of, self.run.result
        if not self.visible or of is None or shown is None or self.display.column >= of.mean.shape[1]:
            return
        diameter, column = shown.scenario.telescope.diameter, self.display.column
        result, record = self._model_and_record()
        mode = result.modes[column] if result and column < len(result.modes) else None
        with pn.io.hold():
            self.legend.object = legend(NAMES, self.display.dark)
            self.figure.draw_measured(of, self.display, diameter)
            self.figure.draw_fit(mode, fitted_spectrum(mode, result) if mode and result else None, self.display, diameter)
            self.figure.restyle(self.display.dark)
            if result and record:
                self.verdict.object = verdict_html(result)
                self.table.object = identification_html(mode, self.display, diameter) if mode else ""
                replaced = self.store.source is None and self._scenario == self.store.scenario
                self.stale.param.update(
                    object=REPLACED if replaced else EARLIER, visible=not same_measurements(record, of.record)
                )


def _number(label: str, value: float) -> pmui.TextInput:
    return pmui.TextInput(label=label, value=f"{value:g}", size="small", width=120, margin=0)


def _read(field: pmui.TextInput, low: float, high: float) -> float:
    """Read a number that was typed. Raises SettingError."""
    value = parse_number(str(field.value))
    if isinstance(value, str) or not low <= value <= high:
        raise SettingError(
            f"{field.label} = {str(field.value)[:40]!r}: takes a number from {low:g} to {high:g}{hint(str(field.value))}"
        )
    return float(value)
