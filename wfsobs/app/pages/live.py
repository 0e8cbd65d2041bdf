"""A loop that runs by the clock, with every observer beside it, and changes while it runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from html import escape

import panel as pn
import param

from wfsobs.app.change_names import name_of_difference
from wfsobs.app.copies import LIVE, CopiedTask
from wfsobs.app.display import Display
from wfsobs.app.downloads import Save
from wfsobs.app.jobs.job import FAILED, RUNNING
from wfsobs.app.jobs.task import IDLE
from wfsobs.app.live_order import LiveOrder
from wfsobs.app.live_work import LiveTask, record_saves
from wfsobs.app.pages.live_beat import Beat
from wfsobs.app.pages.live_controls import LiveControls, Pulse
from wfsobs.app.pages.live_room import LiveRoom
from wfsobs.app.pages.live_table import status_line
from wfsobs.app.pages.live_text import live_text
from wfsobs.app.pages.parts import WIDE, PageActions, box, text
from wfsobs.app.sources import LoadedRecord
from wfsobs.app.store import Store
from wfsobs.live.checks import can_control, can_run
from wfsobs.live.loop import LiveLoop
from wfsobs.live.replay import Replay
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.live.source import SIMULATION
from wfsobs.live.view import LiveView
from wfsobs.settings.errors import SettingError

APART = ":host { gap: 10px; }"
"""Style of boxes one below the other."""
LOOK_BACK = 120.0
"""What a recording has of the time before it [s]."""
INTRO = (
    "Simulates the scenario in the drawer by the clock, in a process of its own, or plays the record that is loaded; every "
    "observer follows it frame by frame in another. A change in the drawer, of wind or peaks or noise, fades in within a second; "
    "the observers keep their designs until they are designed anew."
)


class LivePage(PageActions):
    """The page. Nothing runs before it is asked for."""

    def __init__(self, store: Store, display: Display):
        self.store, self.display = store, display
        self.work = LiveTask(store.session)
        self.controls = c = LiveControls()
        self.inputs = (c.running, c.controllers, c.speed, c.target, c.window)
        self.buttons = c.buttons
        self.intro, self.status = text(INTRO), live_text()
        self.room = pn.Column(**WIDE, visible=False, stylesheets=[APART])
        self.pulse = Pulse(width=0, height=0, margin=0)
        self.visible = False
        self.picture: LiveRoom | None = None
        self._known_loop: LiveLoop | None = None
        self._beat = Beat(store.session.post, self.tick) if pn.state.curdoc else None
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
            field.param.watch(lambda _: self.draw(), "value")
        self.display.param.watch(lambda _: self.draw(), ["mode", "unit", "dark", "show", "spectrum", "editing"])

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        return pn.Column(
            box(
                "Live loop",
                self.intro,
                *self.controls.view(),
                self.status,
                self.pulse,
            ),
            self.room,
            **WIDE,
            stylesheets=[APART],
        )

    def show(self, visible: bool) -> None:
        """Draw while visible; the loop goes on when the page is left."""
        self.visible = visible
        shared = self.store.session.service.live
        if visible and shared is not None and self.work.state == IDLE:
            self.work.begin(shared)
        self._say()
        self.draw()

    def start(self) -> None:
        """Run the scenario of the drawer, or the record that is loaded, or say in one line why not."""
        scenario = self.store.scenario
        try:
            self.store.validate(scenario)
        except SettingError as error:
            self.work.refuse(str(error))
            return
        self.work.begin(self._order())

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

    def link_fields(self) -> dict[str, str]:
        """Return what of the loop a link has beside the settings."""
        return self.controls.link_fields()

    def open_link(self, fields: Mapping[str, str]) -> list[str]:
        """Choose what a link has; return a line for each field refused. A loop that runs is left alone."""
        return self.controls.open_link(fields, runs=self.loop is not None)

    def follow_link(self, act: Callable[..., object]) -> None:
        """Call a function after every change of what a link has."""
        for field in self.inputs:
            field.param.watch(act, "value")

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
            self.status.object = f'<p class="text" role="status">{escape(status_line(loop, view))}</p>'
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

    def _switch(self, act: Callable[[LiveLoop, str, bool], None], event: param.parameterized.Event) -> None:
        runs = set() if self.loop is None else set(self.loop.running_ids())
        for names, on in ((set(event.new) - set(event.old) - runs, True), (set(event.old) - set(event.new), False)):
            for name in names:
                self._do(lambda loop, name=name, on=on: act(loop, name, on))

    def _follow(self, event: param.parameterized.Event) -> None:
        """Change the loop as the settings in the drawer have changed."""

        def become(loop: LiveLoop) -> None:
            if (wanted := event.new) != (before := loop.programme.scenario):
                loop.become(wanted, name_of_difference(before, wanted))

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
            self.status.object = f'<p class="{"failure" if work.state == FAILED else "text"}" role="status">{escape(said)}</p>'
        if self._beat is not None:
            self.store.session.post(self._pace)  # once the page stands: what comes before that does not reach it

    def _pace(self) -> None:
        """Draw again and again while there is something to see."""
        if self._beat is not None:
            (self._beat.start if self.visible and self.loop is not None else self._beat.stop)()
