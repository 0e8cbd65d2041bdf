"""The first page: per target a strip of cards, traces and spectra; below them the table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import panel as pn
import panel_material_ui as pmui

from wfsobs.app.display import SIGNAL
from wfsobs.app.history import History
from wfsobs.app.idle_work import Budgets, SeedRuns
from wfsobs.app.pages.parts import (
    BELOW_FIGURES,
    EDITED,
    SMALL_LABEL,
    TALL,
    WIDE,
    Page,
    box,
    caption,
    caption_html,
    grid_style,
    halves,
    tick,
    zoom_buttons,
)
from wfsobs.app.render import macro
from wfsobs.app.style import follow_html, sheets, watch
from wfsobs.app.views.errors import MainLines, Strip, Table, VerdictLine
from wfsobs.app.views.plots import MODEL, PEAKS, call
from wfsobs.app.views.spectrum_editor import Frames, SpectrumEditor
from wfsobs.app.views.switches import Pinning, SeedSwitch, group
from wfsobs.app.views.traces import SpectraFigures, Stretch, Traces, drawn_peaks
from wfsobs.app.work import TRUTH
from wfsobs.evaluation.exact_errors import Theory
from wfsobs.observers.base import TARGETS, VIBRATION

HEAD = grid_style("minmax(0, 2fr) minmax(0, 3fr)")
GAP = ":host { gap: 10px; } .scroll-button { display: none; }"
WRAPPED = ":host { flex-wrap: wrap; gap: 8px; align-items: center; }"
SWITCHES = """
:host { gap: 8px; align-items: center; width: max-content !important; }
@media (min-width: 600.05px) and (min-height: 560.05px) { :host { flex-wrap: wrap; max-width: 100%; } }
"""
ZOOMS: Mapping[str, float | None] = {"All": None, "2 s": 2.0, "0.2 s": 0.2}


class Explore(Page):
    """The page; its figures rest while it is hidden."""

    def __init__(self, history: History, seeds: SeedRuns):
        run, display = history.store.run, history.display
        self.run = run
        self.display = display
        self.seeds = seeds
        self.show_switch: Final = group(display, "show")
        self._wanted_show = display.show
        run.param.watch(self._offer_errors, "result")  # before the figures, which then draw once
        self.lines: Final = MainLines(display, seeds)
        self.traces: Final = Traces(run, display)
        self.spectra: Final = SpectraFigures(run, display, self.traces.x_range)
        self.budgets: Final = Budgets(seeds, self.lines.names)
        self.strips: Final = {target: Strip(target, display, self.lines, self.budgets) for target in TARGETS}
        self.verdicts: Final = {target: VerdictLine(target, display, self.budgets) for target in TARGETS}
        self.stretches: Final = {target: Stretch(target, self.traces, self.spectra) for target in TARGETS}
        self.table: Final = Table(display, seeds)
        self.pinning: Final = Pinning(history)
        self.rooms: dict[str, pn.Column] = {}
        self.editors: dict[str, SpectrumEditor] = {}
        self.sections: Final = pn.Column(self._section(TARGETS[0]), **WIDE, stylesheets=[GAP])
        display.param.watch(self._edit, "editing")
        watch(lambda *_: history.note_evidence(seeds.evidence), (seeds, "evidence"), (history, "current"))

    def view(self) -> pn.Column:
        """Return the contents of the page: what is seen first, until it is completed."""
        return self.sections

    def show(self, visible: bool) -> None:
        """Draw what has come meanwhile, and go on while visible."""
        for figures in (self.traces, self.spectra):
            figures.show(visible)

    def switches(self) -> pn.Row:
        """Return the switches of this page alone."""
        return pn.Row(
            self.show_switch,
            group(self.display, "spectrum"),
            pn.Row(*zoom_buttons(self.traces.zoom, ZOOMS), margin=0),
            self._tick("editing"),
            *self.pinning.view(),
            margin=0,
            stylesheets=[SWITCHES],
        )

    def _offer_errors(self, *_: object) -> None:
        """Leave no choice but the signals of a record without truth; what was chosen comes back with the next truth."""
        results = self.run.result
        has_truth = results is None or any(results.values(TRUTH, target) is not None for target in TARGETS)
        if has_truth == self.show_switch.disabled:
            self.show_switch.disabled = not has_truth
            if has_truth:
                self.display.show = self._wanted_show
            else:
                self._wanted_show, self.display.show = self.display.show, SIGNAL

    def _tick(self, switch: str) -> pmui.Checkbox:
        return tick(self.display, switch, align="center", stylesheets=[SMALL_LABEL])

    def _section(self, target: str) -> pn.Column:
        """Lay out the strip and the two figures of one target."""
        call(self.traces.traces[target].figure, f"{target.capitalize()} time trace")
        call(self.spectra.spectra[target].figure, f"{target.capitalize()} spectrum")
        cards = self.strips[target].cards
        cards.on_all = self.budgets.ask_for_all
        above = follow_html(self._above_spectrum, (self.run, "result")) if target == VIBRATION else caption("Spectrum")
        traces = pn.Column(caption("Time trace"), self.traces.pane(target), **TALL)
        self.rooms[target] = pn.Column(above, self.spectra.pane(target), **TALL)
        figures = halves(traces, self.rooms[target])
        window = [self._tick("window_spectra")] if target == TARGETS[0] else []
        below = pn.Row(self.stretches[target].pane, *window, **WIDE, stylesheets=[WRAPPED])
        head = pn.Column(self.verdicts[target].pane, cards, **WIDE, stylesheets=[HEAD, BELOW_FIGURES])
        return pn.Column(head, figures, below, **WIDE, stylesheets=sheets("box"))

    def _above_spectrum(self) -> str:
        shown = self.run.result
        return caption_html("Spectrum", macro("marks", PEAKS if shown is None or drawn_peaks(shown) else "", MODEL))

    def complete(self) -> None:
        """Put what is further down below the first target."""
        if len(self.sections) == 1:
            seeds = pn.FlexBox(*SeedSwitch(self.seeds).view(), gap="4px 16px", align_items="center", **WIDE)
            self.sections.extend([*map(self._section, TARGETS[1:]), box("RMS errors", seeds, self.table.pane)])

    def _edit(self, *_: object) -> None:
        """Make the handles when they are first wanted, and room for what stands below them."""
        self.complete()
        for room in self.rooms.values():
            room.stylesheets = [EDITED] if self.display.editing else TALL["stylesheets"]
        if self.editors:
            return
        frames, theory = Frames(self.seeds.store.session), Theory()
        with pn.io.hold():
            for target, room in self.rooms.items():
                fig = self.spectra.spectra[target].figure
                self.editors[target] = SpectrumEditor(target, fig, self.seeds.store, self.display, frames, theory)
                room.append(self.editors[target].layer)
