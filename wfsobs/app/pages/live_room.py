"""What is shown of a live loop: figures, detectors and tables, made when there is something to show."""

from __future__ import annotations

from time import monotonic

import panel as pn
import panel_material_ui as pmui

from wfsobs.app.display import CUMULATIVE, ERROR, PSD, RUNNING_RMS, SIGNAL, Display, per_micrometre
from wfsobs.app.pages.live_controls import LiveControls, Pulse
from wfsobs.app.pages.live_figures import LatencyHistogram, RollingSpectra, RollingTraces
from wfsobs.app.pages.live_paint import Painter
from wfsobs.app.pages.live_stars import Stars
from wfsobs.app.pages.live_table import control_html, events_html, live_html, peaks_html
from wfsobs.app.pages.live_text import live_text
from wfsobs.app.pages.live_waterfall import MEASUREMENT, Waterfall
from wfsobs.app.pages.parts import HALVES, WIDE, box, figure_with_caption, group, legend, line
from wfsobs.app.store import Store
from wfsobs.app.style import look
from wfsobs.app.views.frames import Frames
from wfsobs.app.views.spectrum_editor import SpectrumEditor
from wfsobs.app.work import TRUTH
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.evaluation.theory import Theory
from wfsobs.live.board import NEXT
from wfsobs.live.finding import Bounds
from wfsobs.live.loop import LiveLoop
from wfsobs.live.source import SIMULATION
from wfsobs.live.view import LiveView
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS

SLOW = 1.0
"""Between two tables [s]."""


class LiveRoom:
    """The figures and tables of one page."""

    def __init__(self, store: Store, display: Display, controls: LiveControls, pulse: Pulse):
        self.display, self.store, self.controls = display, store, controls
        self._painter = painter = Painter(pulse)
        self.traces, self.spectra, self.waterfall = RollingTraces(painter), RollingSpectra(painter), Waterfall()
        self.latencies, self.stars = LatencyHistogram(painter), Stars(painter)
        self.table, self.control_table, self.news, self.peaks = (live_text() for _ in range(4))
        self.editor: SpectrumEditor | None = None
        self.legend = live_text()
        self._second = 0
        self._bounds: Bounds = {}
        self._spectra_room = figure_with_caption("Spectra", self.spectra.figure)

    def view(self) -> list[pn.Column]:
        """Return the boxes."""
        c = self.controls
        figures = [
            figure_with_caption("The last seconds", self.traces.figure),
            self._spectra_room,
            pn.Column(figure_with_caption("Waterfall", self.waterfall.figure), **WIDE),
            figure_with_caption("Latencies", self.latencies.figure),
        ]
        switches = line(
            c.window,
            c.target,
            group(self.display, "show", {"Signal": SIGNAL, "Error": ERROR, "Running rms": RUNNING_RMS}),
            group(self.display, "spectrum", {"PSD": PSD, "Cumulative rms": CUMULATIVE}),
            c.waterfall,
            pmui.Checkbox.from_param(self.display.param.editing, size="small", margin=0),
        )
        return [
            box("Now", switches, c.lines, self.legend, pn.Column(*figures, **WIDE, stylesheets=[HALVES])),
            box("Observers", self.table, self.peaks),
            box("Controllers on the same disturbance", c.controllers, self.control_table, self.stars.row),
            box("Events", self.news),
        ]

    def draw(self, loop: LiveLoop, view: LiveView) -> None:
        """Send the present."""
        display, dark = self.display, self.display.dark
        target = self._target(loop)
        scale = per_micrometre(display.unit, loop.scenario.telescope.diameter)
        active = loop.board.active()
        names = [name for name in active if name in self.controls.lines.value]
        run_in = RollingTraces.run_in(display)
        longer = view.n * view.dt + run_in
        before = loop.readings.look(loop.view, longer, anew=not loop.is_playing) if run_in else view
        self.traces.draw(before, view.n, target, names, display, scale, list(loop.events), self._bounds)
        self.spectra.draw(view, target, names, display, scale)
        what = self.controls.waterfall.value
        self.waterfall.draw(view, what if what in active else MEASUREMENT, target, display, scale)
        running = [name for name in self.controls.controllers.value if name in loop.controllers]
        seconds = self.controls.window.value
        left = view.once(("left", seconds), lambda: loop.control_view(seconds))
        self.stars.draw(view, left, running, loop.scenario, dark)
        self._edit(loop, target)
        if (second := int(monotonic() / SLOW)) != self._second or not loop.is_playing:  # all pages at the same time
            self._second = second
            self._draw_tables(loop, view, target, scale)
            self.latencies.draw(loop.board, names, loop.sampling.dt, dark)
        self._painter.send()

    def _target(self, loop: LiveLoop) -> str:
        """Return what errors are shown of: without truth, of the next measurement."""
        return self.controls.target.value if loop.source.has_truth else NEXT

    def _draw_tables(self, loop: LiveLoop, view: LiveView, target: str, scale: float) -> None:
        self._bounds = loop.workshop.bounds(loop.scenario)
        self.legend.object = self._legend(loop, target)
        d, seconds = self.display, self.controls.window.value
        of = (d.column, d.unit, d.dark)
        key = ("table", target, tuple(self._bounds), *of)
        self.table.object = view.once(key, lambda: live_html(loop, view, target, d, scale, self._bounds))
        self.control_table.object = view.once(("controls", seconds, *of), lambda: control_html(loop, seconds, d))
        self.news.object = events_html(loop.events, loop.sampling.dt)
        self.peaks.object = peaks_html(loop.workshop.change, scale, self.display.unit_label)

    def _legend(self, loop: LiveLoop, target: str) -> str:
        """Write what the lines of the figures are."""
        wanted = (target,) if target in TARGETS else TARGETS
        active = [name for name in loop.board.active() if name in self.controls.lines.value]
        names = [name for name in active if set(wanted) <= set(OBSERVERS[name].targets)]
        truth = [] if self.display.error else [TRUTH]
        bounds = [name for name in BOUNDS if self.display.running and target in self._bounds.get(name, ())]
        return legend({name: look(name).label for name in (*truth, *names, *bounds)}, self.display.dark)

    def _edit(self, loop: LiveLoop, target: str) -> None:
        """Lay the handles over the spectra of a simulation, whose settings they are."""
        if self.editor is None:
            if not self.display.editing:
                return
            store, session = self.store, self.store.session
            self.editor = SpectrumEditor(TARGETS[0], self.spectra.figure, store, self.display, Frames(session), Theory())
            self._spectra_room.append(self.editor.layer)
        self.editor.turn_to(target if loop.source.name == SIMULATION and target in TARGETS else None)
