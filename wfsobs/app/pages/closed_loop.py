"""What every controller leaves of the disturbance of the results shown, and how far each is from instability."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from html import escape
from typing import Any

import panel as pn
import panel_material_ui as pmui

from wfsobs.app.copies import LOOP, CopiedTask
from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.downloads import Save, residuals_csv, residuals_npz, table_csv
from wfsobs.app.glossary import STREHL, TERMS
from wfsobs.app.jobs.job import CANCELLED, FAILED, RUNNING, Job
from wfsobs.app.jobs.task import BackgroundTask
from wfsobs.app.loop_work import LoopResults, compute, cost, seconds
from wfsobs.app.numerals import NOTHING, number
from wfsobs.app.pages.link import LinkedLines
from wfsobs.app.pages.loop_figures import LoopSpectrum, Nyquist, Response, Trace
from wfsobs.app.pages.loop_table import loop_html, margins_html
from wfsobs.app.pages.parts import (
    EDITED,
    HALVES,
    SMALL_LABEL,
    TALL,
    WIDE,
    PageActions,
    box,
    figure_with_caption,
    html,
    text,
    zoom_buttons,
)
from wfsobs.app.store import Store
from wfsobs.app.style import look
from wfsobs.app.views.gain_editor import GainEditor
from wfsobs.app.views.strip import MAIN, Cards
from wfsobs.control.controllers import CONTROLLERS

REFERENCES = ("integrator", "lqg-kf-lgs")
"""Shown at first beside the best, of which there are two."""

FIRST_S, ZOOM_S = 2.0, 0.5
"""Length of the two traces at first [s], in the middle of the record."""

INTRO = (
    "Every controller runs on the disturbance and the noise of the results shown, with the delay and the "
    "limits of the mirror set under Controllers. The Strehl ratio counts the simulated modes alone."
)
ABOUT = (
    "Rejection |E| bold, noise transfer faint. The distance of the loop gain L from −1 is the distance of the loop from "
    "instability; ○ marks the gain margin, □ the phase margin. Multi-rate loops change from step to step, and a GPR is not "
    "linear: neither has such curves."
)


class ClosedLoopPage(PageActions):
    """The page; computed anew when the results change, while it is visible."""

    def __init__(self, store: Store, display: Display):
        self.store, self.run, self.display = store, store.run, display
        run = store.run
        self.work = BackgroundTask(store.session, title="Closed loop")
        self.visible, self._of = False, object()
        self._rooms = list[pn.viewable.Viewable]()
        self.note, self.table, self.margins = html(), html(), html()
        terms = {STREHL: TERMS[STREHL]}
        self.cards = Cards(items=[], hidden_lines=[], terms=terms, main=MAIN, sizing_mode="stretch_width", margin=0)
        self.cards.on_main, self._main, self._is_chosen = self._show_main, list[str](), False
        self.link = LinkedLines(self.cards, CONTROLLERS, lambda: self._is_chosen, self._show_main)
        self.trace, self.zoom = Trace(FIRST_S), Trace(ZOOM_S)
        self.spectrum, self.response, self.nyquist = LoopSpectrum(), Response(), Nyquist()
        self.room = figure_with_caption("Rejection and noise transfer", self.response.figure, tall=True)
        self.stability = figure_with_caption("Loop gain L, unit circle", self.nyquist.figure)
        self.editor: GainEditor | None = None
        display.param.watch(self._edit, "editing")
        self._edit()
        self._figures = (self.trace, self.zoom, self.spectrum, self.response, self.nyquist)
        self.work.param.watch(self._say, ["state", "place", "message"])
        self.work.param.watch(self._redraw, "result")
        run.param.watch(self._follow, ["result", "state"])
        display.param.watch(self._redraw, ["mode", "unit"])
        display.param.watch(self._restyle, "dark")
        self.cards.param.watch(self._choose, "hidden_lines")

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        figures = pn.Column(
            *(
                figure_with_caption(title, drawn.figure, tall=True)
                for title, drawn in (
                    ("Residual", self.trace),
                    ("Spectrum of the residual", self.spectrum),
                    ("Residual, zoomed", self.zoom),
                )
            ),
            self.room,
            **WIDE,
            stylesheets=[HALVES],
        )
        stability = pn.Column(
            self.stability,
            pn.Column(text(ABOUT), self.margins, **WIDE),
            **WIDE,
            stylesheets=[HALVES],
        )
        parts = (self._switch(), figures, box("Controllers", self.table), box("Stability", stability))
        self._rooms = [pn.Column(part, **WIDE) for part in parts]  # a grid by its own style is shown even where it is not visible
        return pn.Column(
            box("Residual in closed loop", text(INTRO), self.note, self.cards, *self._rooms[:2]),
            *self._rooms[2:],
            **WIDE,
            stylesheets=[":host { gap: 10px; }"],
        )

    def _switch(self) -> pn.FlexBox:
        edit = pmui.Checkbox.from_param(self.display.param.editing, size="small", margin=0, stylesheets=[SMALL_LABEL])
        return pn.FlexBox(*zoom_buttons(self.trace.zoom, {"Whole record": None, f"{FIRST_S:g} s": FIRST_S}), edit, **WIDE)

    def _edit(self, *_: object) -> None:
        """Make the handle when it is first wanted, and room for what stands below the figure."""
        self.room.stylesheets = [EDITED] if self.display.editing else TALL["stylesheets"]
        if self.display.editing and self.editor is None:
            self.editor = GainEditor(self.response.figure, self.nyquist.figure, self.store, self.display, lambda: self.results)
            for room, handle in zip((self.room, self.stability), self.editor.handles, strict=True):
                room.append(handle.layer)

    def show(self, visible: bool) -> None:
        """Compute what has changed meanwhile, and go on while visible."""
        self.visible = visible
        self._follow()
        self._redraw()  # mode or unit may have changed

    @property
    def task(self) -> CopiedTask:
        """To close the loop."""
        return CopiedTask(LOOP)

    def saves(self) -> Mapping[str, Save | None]:
        """Offer the table of `wfsobs loop --json`, and the residuals."""
        shown = self.results
        if shown is None:
            return {"Controllers as CSV": None, "Residuals as CSV": None, "Residuals as NPZ": None}
        return {
            "Controllers as CSV": Save("wfsobs-controllers.csv", "text/csv", lambda: table_csv(shown.rows)),
            "Residuals as CSV": Save("wfsobs-residuals.csv", "text/csv", lambda: residuals_csv(shown)),
            "Residuals as NPZ": Save("wfsobs-residuals.npz", "application/octet-stream", lambda: residuals_npz(shown)),
        }

    def _follow(self, *_: object) -> None:
        """Start the loop of the results shown, once their run is over; stop where the page is hidden."""
        of = self.run.result
        if not self.visible:
            self.work.cancel()
            if self.work.state == CANCELLED:
                self._of = object()
            return
        if of is None or self.run.state == RUNNING or of is self._of:
            return
        self._of = of
        self.work.start(Job("loop", partial(compute, of, memo=self.store.session.service.memo), cost=cost(of.scenario)))

    @property
    def results(self) -> LoopResults | None:
        """What the loop has given so far, or the one before; None where there cannot be one."""
        return None if self.work.state == FAILED else self.work.result

    def _say(self, *_: object) -> None:
        work = self.work
        doing = work.line() if work.place else "computing …"
        said = {RUNNING: doing, FAILED: f"No closed loop: {work.message}"}.get(work.state, "")
        self.note.object = f'<p class="text" role="status">{escape(said)}</p>' if said else ""
        for room in (self.cards, *self._rooms):  # of other results
            room.visible = work.state != FAILED

    def _redraw(self, *_: object) -> None:
        shown = self.results
        if shown is None or not self.visible or self.display.column >= len(shown.result.scenario.modes):
            return
        with pn.io.hold():
            for drawn in self._figures:
                drawn.draw(shown, self.display)
            if not self._is_chosen:
                self._show_main()
            self._restyle()
            if self.editor is not None:
                self.editor.follow()

    def _restyle(self, *_: object) -> None:
        with pn.io.hold():
            for drawn in self._figures:
                drawn.restyle(self.display.dark, self.cards.hidden_lines)
            for drawn in (self.trace, self.zoom, self.spectrum):
                drawn.fit(self.cards.hidden_lines)
            if self.results is not None:
                self.table.object = loop_html(self.results, self.display)
                self.margins.object = margins_html(self.results, self.display)
                self.cards.items = self._items(self.results)

    def _choose(self, *_: object) -> None:
        """Keep to the lines that a visitor has chosen."""
        self._is_chosen = self.cards.hidden_lines != self._main
        self._restyle()

    def _show_main(self) -> None:
        """Show the few lines that matter: the references, and the best two of the mode."""
        shown = self.results
        if shown is None:
            return
        of_mode = [r for r in shown.rows if r["mode"] == self.display.mode and r["controller"] in CONTROLLERS]
        ranked = sorted((r for r in of_mode if r["residual_rms_nm"] is not None), key=lambda r: r["residual_rms_nm"])
        main = {*REFERENCES, *(r["controller"] for r in ranked[:2])}
        self._main = [name for name in CONTROLLERS if name not in main]
        self.cards.hidden_lines = self._main

    def _items(self, results: LoopResults) -> list[dict[str, Any]]:
        """Describe a card per controller."""
        scale = 1e-3 * per_micrometre(self.display.unit, results.result.scenario.telescope.diameter)
        left = {r["controller"]: r for r in results.rows if r["mode"] == self.display.mode}
        out = []
        for name in CONTROLLERS:
            it, row = look(name), left.get(name)
            value, unit = NOTHING, ""
            if row is None:
                note = f"left out, {seconds(name, results.result.scenario):.0f} s" if results.complete else "computing …"
            elif row["residual_rms_nm"] is None:
                note = "unstable" if row["stable"] is False else "could not run"
            else:
                value, unit = number(row["residual_rms_nm"] * scale), self.display.unit_label
                note = f"Strehl {row['strehl']:.3f}"
            out.append(
                {
                    "name": name,
                    "label": it.label,
                    "colour": it.colour(self.display.dark),
                    "dash": list(it.dash),
                    "note": note,
                    "value": value,
                    "unit": unit,
                }
            )
        return out
