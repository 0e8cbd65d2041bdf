"""A loop that runs by the clock, with every observer beside it, and changes while it runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from html import escape
from time import monotonic
from typing import Any, Final

import panel as pn

from wfsobs.app.compared import name_of_difference
from wfsobs.app.display import Display
from wfsobs.app.downloads import Save
from wfsobs.app.jobs import FAILED, RUNNING
from wfsobs.app.live_work import live_job, record_saves
from wfsobs.app.pages.live_controls import (
    LOOP_FIELDS,
    LiveControls,
    control_html,
    events_html,
    live_html,
    peaks_html,
    status_line,
)
from wfsobs.app.pages.live_figures import (
    MEASUREMENT,
    Painter,
    Pulse,
    RollingSpectra,
    RollingTraces,
    Stars,
    Waterfall,
)
from wfsobs.app.pages.parts import HALVES, WIDE, Page, box, boxes, example, figure_with_caption, group, legend, line, text, tick
from wfsobs.app.service import IDLE, BackgroundTask
from wfsobs.app.share import LIVE, CopiedTask
from wfsobs.app.sources import LoadedRecord
from wfsobs.app.store import Store
from wfsobs.app.style import bare, look
from wfsobs.app.views.spectrum_editor import Frames, SpectrumEditor
from wfsobs.app.work import TRUTH
from wfsobs.evaluation.error_spectra import Theory
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.live.board import NEXT
from wfsobs.live.checks import can_control, can_run
from wfsobs.live.finding import Bounds
from wfsobs.live.loop import LiveLoop, LiveOrder
from wfsobs.live.replay import Replay
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.live.source import SIMULATION
from wfsobs.live.view import SHARED, LiveView
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.settings.errors import SettingError

SLOW = 1.0
"""Between two tables [s]."""


class LiveRoom:
    """The figures and tables of one page."""

    def __init__(self, store: Store, display: Display, controls: LiveControls, pulse: Pulse):
        self.display = display
        self.store = store
        self.controls = controls
        self._painter = painter = Painter(pulse)
        self.traces: Final = RollingTraces(painter)
        self.spectra: Final = RollingSpectra(painter)
        self.waterfall: Final = Waterfall()
        self.stars: Final = Stars(painter)
        self.table, self.control_table, self.news, self.peaks = (bare() for _ in range(4))
        self.editor: SpectrumEditor | None = None
        self.legend: Final = bare()
        self._second = 0
        self._bounds: Bounds = {}
        self._spectra_room = figure_with_caption("Spectra", self.spectra.figure)

    def view(self) -> list[pn.Column]:
        """Return the boxes."""
        c = self.controls
        seconds, waterfall = (
            figure_with_caption(title, of.figure)
            for title, of in (("The last seconds", self.traces), ("Waterfall", self.waterfall))
        )
        figures = [seconds, self._spectra_room, pn.Column(waterfall, **WIDE, styles={"grid-column": "1 / -1"})]
        shown = [group(self.display, name) for name in ("show", "spectrum")]
        switches = line(c.window, c.target, *shown, c.waterfall, tick(self.display, "editing"))
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
        scale = display.scale(loop.scenario)
        active = loop.board.active()
        names = [name for name in active if name in self.controls.lines.value]
        run_in = RollingTraces.run_in(display)
        longer = view.n * view.dt + run_in
        before = loop.readings.look(loop.view, longer, anew=not loop.is_playing) if run_in else view
        self.traces.draw(before, view.n, target, names, display, scale, list(loop.events), self._bounds)
        self.spectra.draw(view, target, names, display, loop.scenario)
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
        self._painter.send()

    def _target(self, loop: LiveLoop) -> str:
        """Return what errors are shown of: without truth, of the next measurement."""
        return self.controls.target.value if loop.source.has_truth else NEXT

    def _draw_tables(self, loop: LiveLoop, view: LiveView, target: str, scale: float) -> None:
        self._bounds = loop.workshop.bounds(loop.scenario)
        self.legend.html = self._legend(loop, target)
        self.table.html = live_html(loop, view, target, self.display, scale, self._bounds)
        self.control_table.html = control_html(loop, self.controls.window.value, self.display)
        self.news.html = events_html(loop.events, loop.sampling.dt)
        self.peaks.html = peaks_html(loop.workshop.change, scale, self.display.unit_label)

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


LOOK_BACK = 120.0
"""What a recording has of the time before it [s]."""
INTRO = (
    "Runs the scenario, or the loaded record, in real time with every observer frame by frame. A changed setting of the "
    "disturbance fades in within a second; the observers keep their designs until they are redesigned."
)


class LivePage(Page):
    """The page. Nothing runs before it is asked for."""

    def __init__(self, store: Store, display: Display):
        super().__init__(store, display, "mode", "unit", "dark", "show", "spectrum", "editing")
        self.work: Final = BackgroundTask(store.session)
        self.controls = c = LiveControls()
        self.buttons: Final = c.buttons
        self.link = c.link
        self.intro: Final = text(INTRO)
        self.status: Final = bare()
        self.room: Final = boxes()
        self.room.visible = False
        self.pulse: Final = Pulse(width=0, height=0, margin=0)
        self.picture: LiveRoom | None = None
        self._known_loop: LiveLoop | None = None
        self.repeat(self.tick, SHARED)
        self._watch()
        self._say()

    def _watch(self) -> None:
        c = self.controls
        does: dict[str, Callable[[LiveLoop], None]] = {
            "Pause": lambda loop: loop.pause() if loop.is_playing else loop.play(),
            "Step": lambda loop: loop.step(),
            "Stop": lambda _: self.work.cancel(),
            "Redesign now": lambda loop: loop.redesign(c.names_to_design),
            "Identify": lambda loop: loop.identify(c.names_to_design),
            "Record": self._toggle_recording,
        }
        self.buttons["Start"].on_click(lambda _event: self.start())
        for name, act in does.items():
            self.buttons[name].on_click(lambda _event, act=act: self._do(act))
        self.controls.speed.param.watch(lambda event: self._do(lambda loop: loop.set_speed(event.new)), "value")
        for field in (c.lasers, c.ngs, c.losses):
            field.param.watch(
                lambda _: self._do(lambda loop: loop.lose(lgs=c.lasers.value, ngs=c.ngs.value, loss=c.losses.value)), "value"
            )
        c.running.param.watch(partial(self._switch, LiveLoop.switch), "value")
        c.controllers.param.watch(partial(self._switch, LiveLoop.control), "value")
        self.work.param.watch(self._say, ["state", "place", "message", "latest"])
        self.store.param.watch(self._follow, "scenario")
        for field in (c.window, c.target, c.lines, c.waterfall):
            field.param.watch(self.redraw, "value")

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        return boxes(
            box("Live loop", self.intro, *self.controls.view(), self.status, self.pulse), example("live", self.room), self.room
        )

    def show(self, visible: bool) -> None:
        """Draw while visible; the loop goes on when the page is left."""
        self.visible = visible
        shared = self.store.session.service.live
        if visible and shared is not None and self.work.state == IDLE:
            self._begin(shared)
        self._say()
        self.draw()

    def start(self) -> None:
        """Run the scenario of the drawer, or the record that is loaded, or say in one line why not."""
        if self.work.attempt(lambda: self.store.validate(self.store.scenario)):
            self._begin(self._order())

    def _begin(self, order: LiveOrder) -> None:
        """Run a loop, in place of the one before."""
        self.work.attempt(lambda: self.work.start(live_job(order, self.store.session.service)))

    def _order(self) -> LiveOrder:
        """Return the loop that the page asks for: the one that all pages show, or that of the drawer or of the record loaded."""
        scenario, loaded, shared, c = self.store.scenario, self.store.source, self.store.session.service.live, self.controls
        source, options = (SimulatedLoop(scenario), ()) if shared is None else (shared.source, shared.options)
        if isinstance(loaded, LoadedRecord):
            source, options = Replay(loaded.record), ()
        elif source.name == SIMULATION:
            source = SimulatedLoop(scenario)
        names = tuple(name for name in c.running.value if can_run(name, source, scenario))
        controllers = tuple(name for name in c.controllers.value if can_control(name, source))
        return LiveOrder(source, scenario, names, c.speed.value, controllers, options=options)

    @property
    def task(self) -> CopiedTask:
        """To run the loop."""
        return CopiedTask(LIVE, {"order": self._order()})

    def open_link(self, texts: Mapping[str, str]) -> list[str]:
        """Choose what an address has. A loop that runs is left alone."""
        return self.controls.link.open(texts, leave=LOOP_FIELDS if self.loop else ())

    @property
    def loop(self) -> LiveLoop | None:
        """The loop while it runs."""
        return self.work.latest if self.work.state == RUNNING else None

    def tick(self) -> None:
        """Draw when the browser has painted the picture before."""
        self.pulse.when_free(self._send)

    def _send(self) -> None:
        self.store.session.service.note_wish()  # no page of a visitor to come is made meanwhile: it takes a second
        with pn.io.hold():  # one message
            if self.draw():
                self.pulse.beat()

    def draw(self) -> bool:
        """Send the present; return whether there was something to send."""
        loop = self.loop
        if loop is None or not self.visible:
            return False
        if loop is not self._known_loop and loop.is_ready:  # another page may have started it
            self._known_loop = loop
            self.controls.tell(loop)
        view = loop.readings.look(loop.view, self.controls.window.value, anew=not loop.is_playing)
        with pn.io.hold():
            self.status.html = f'<p class="text" role="status">{escape(status_line(loop, view))}</p>'
            self.buttons["Pause"].label = "Pause" if loop.is_playing else "Play"
            if view.n > 1:
                self._draw_room(loop, view)
        return True

    def _draw_room(self, loop: LiveLoop, view: LiveView) -> None:
        picture = self.picture or LiveRoom(self.store, self.display, self.controls, self.pulse)
        picture.draw(loop, view)
        if self.picture is None:
            self.picture = picture
            self.room[:] = picture.view()
            self.room.visible = True
            self.store.session.post(self.store.session.service.keep_page)

    def _toggle_recording(self, loop: LiveLoop) -> None:
        """Keep every frame, and the last two minutes; or end that."""
        if loop.recorder.is_on:
            loop.recorder.stop(loop.scenario)
        else:
            loop.recorder.start(LOOK_BACK)
        self.buttons["Record"].label = "End the recording" if loop.recorder.is_on else "Record"

    def saves(self) -> Mapping[str, Save | None]:
        """Offer the recording, and the last two minutes."""
        return record_saves(self.loop, LOOK_BACK)

    def _do(self, act: Callable[[LiveLoop], None]) -> None:
        """Do something with the loop, or say in one line why not."""
        if (loop := self.loop) is not None:
            try:
                act(loop)
            except SettingError as error:
                loop.say(str(error))
            self.draw()

    def _switch(self, act: Callable[[LiveLoop, str, bool], None], event: Any) -> None:
        runs = set() if self.loop is None else set(self.loop.running_ids())
        for names, on in ((set(event.new) - set(event.old) - runs, True), (set(event.old) - set(event.new), False)):
            for name in names:
                self._do(lambda loop, name=name, on=on: act(loop, name, on))

    def _follow(self, event: Any) -> None:
        """Change the loop as the settings in the drawer have changed."""

        def become(loop: LiveLoop) -> None:
            if event.new != loop.programme.scenario:
                loop.become(event.new, name_of_difference(loop.programme.scenario, event.new))

        self._do(become)

    def _say(self, *_: object) -> None:
        """Enable what can be done, and describe what the job does."""
        work, runs = self.work, self.loop is not None
        for name, button in self.buttons.items():
            button.disabled = (work.state == RUNNING) if name == "Start" else not runs
        self.buttons["Stop"].disabled = work.state != RUNNING
        self.intro.visible = work.state != RUNNING  # room for the figures
        waiting = work.line() if work.place else "Starting …"
        said = {RUNNING: waiting, FAILED: work.message}.get(work.state, "Stopped" if self.picture else "")
        if not runs:
            self.status.html = f'<p class="{"failure" if work.state == FAILED else "text"}" role="status">{escape(said)}</p>'
        self.pace()

    @property
    def goes_on(self) -> bool:
        """Whether there is something to see."""
        return self.visible and self.loop is not None
