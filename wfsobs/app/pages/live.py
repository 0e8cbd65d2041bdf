"""A loop that runs by the clock, with every observer beside it, and changes while it runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from html import escape
from time import monotonic

import panel as pn
import param

from wfsobs.app.change_names import name_of_difference
from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.downloads import Save
from wfsobs.app.jobs.job import FAILED, RUNNING
from wfsobs.app.jobs.task import IDLE
from wfsobs.app.live_order import LiveOrder
from wfsobs.app.live_work import LiveTask, record_saves
from wfsobs.app.pages.live_controls import LiveControls, Pulse
from wfsobs.app.pages.live_figures import Detector, LatencyHistogram, RollingSpectra, RollingTraces
from wfsobs.app.pages.live_table import Bounds, events_html, live_html, peaks_html, ranking, status_line
from wfsobs.app.pages.parts import WIDE, PageActions, box, figure_with_caption, html, line, text
from wfsobs.app.store import Store
from wfsobs.live.board import NEXT
from wfsobs.live.finding import bounds_of
from wfsobs.live.loop import LiveLoop
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.live.view import LiveView
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError

PERIOD = 200
"""Between two pictures [ms]."""
SLOW = 1.0
"""Between two tables [s]."""
LOOK_BACK = 120.0
"""What a recording has of the time before it [s]."""
GRID = """
:host { display: grid !important; grid-template-columns: minmax(0, 1fr) minmax(0, 1fr); gap: 10px; }
@media (max-width: 1000px) { :host { grid-template-columns: minmax(0, 1fr); } }
"""
INTRO = (
    "Simulates the scenario in the drawer by the clock, in a process of its own; every observer follows it frame by frame in "
    "another. A change in the drawer, of wind or peaks or noise, fades in within a second; the observers keep their designs "
    "until they are designed anew."
)


class LivePage(PageActions):
    """The page. Nothing runs before it is asked for."""

    def __init__(self, store: Store, display: Display):
        self.store, self.display = store, display
        self.work = LiveTask(store.session)
        self.controls = c = LiveControls()
        self.buttons, self.lines, self.target, self.window = c.buttons, c.lines, c.target, c.window
        self.status, self.table, self.news, self.peaks = html(), html(), html(), html()
        self.room = pn.Column(**WIDE, visible=False)
        self.pulse = Pulse(width=0, height=0, margin=0)
        self.visible, self._table_time = False, 0.0
        self._figures: tuple[RollingTraces, RollingSpectra, LatencyHistogram, Detector] | None = None
        self._bounds: Bounds = {}
        self._bounds_of: Scenario | None = None
        self._callback = pn.state.add_periodic_callback(self.tick, PERIOD, start=False) if pn.state.curdoc else None
        self._watch()
        self._say()

    def _watch(self) -> None:
        c = self.controls
        does: dict[str, Callable[[LiveLoop], None]] = {
            "Pause": lambda loop: loop.pause() if loop.is_playing else loop.play(),
            "Step": lambda loop: loop.step(),
            "Stop": lambda _: self.work.cancel(),
            "Design anew": lambda loop: loop.redesign(),
            "Identify": lambda loop: loop.identify(),
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
        self.controls.running.param.watch(self._switch, "value")
        self.work.param.watch(self._say, ["state", "place", "message", "latest"])
        self.store.param.watch(self._follow, "scenario")
        for owner, name in ((self.window, "value"), (self.target, "value"), (self.lines, "value")):
            owner.param.watch(lambda _: self.draw(), name)
        self.display.param.watch(lambda _: self.draw(), ["mode", "unit", "dark", "show"])

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        return pn.Column(
            box(
                "Live loop",
                text(INTRO),
                *self.controls.view(),
                self.status,
                self.pulse,
            ),
            self.room,
            **WIDE,
            stylesheets=[":host { gap: 10px; }"],
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
        """Run the scenario of the drawer, or say in one line why not."""
        scenario = self.store.scenario.before_events
        try:
            self.store.validate(scenario)
        except SettingError as error:
            self.work.refuse(str(error))
            return
        self.work.begin(
            LiveOrder(SimulatedLoop(scenario), scenario, tuple(self.controls.running.value), self.controls.speed.value)
        )

    @property
    def loop(self) -> LiveLoop | None:
        """The loop while it runs."""
        return self.work.latest if self.work.state == RUNNING else None

    def tick(self) -> None:
        """Draw if the browser has painted the picture before."""
        if self.pulse.is_free and self.draw():
            self.pulse.beat()

    def draw(self) -> bool:
        """Send the present; return whether there was something to send."""
        loop = self.loop
        if loop is None or not self.visible:
            return False
        view = loop.view(self.window.value)
        with pn.io.hold():
            self.status.object = f'<p class="text" role="status">{escape(status_line(loop, view))}</p>'
            self.buttons["Pause"].label = "Pause" if loop.is_playing else "Play"
            if view.n > 1:
                self._draw_figures(loop, view)
                if monotonic() - self._table_time > SLOW or not loop.is_playing:
                    self._draw_table(loop, view)
        return True

    def _draw_figures(self, loop: LiveLoop, view: LiveView) -> None:
        if self._figures is None:
            self._figures = self._make_figures()
        traces, spectra, latencies, star = self._figures
        diameter = loop.scenario.telescope.diameter
        scale = per_micrometre(self.display.unit, diameter)
        active = loop.board.active()
        names = [name for name in active if name in self.lines.value]
        traces.draw(view, self._target(loop), names, self.display, scale, list(loop.events))
        spectra.draw(view, self._target(loop), names, self.display, scale)
        latencies.draw(loop.board, names, loop.sampling.dt, self.display.dark)
        both = [name for name in active if len(loop.targets(name)) > 1]
        if both:
            star.draw(view, ranking(view, both, "next", 0)[0][0], diameter, self.display.dark)

    def _make_figures(self) -> tuple[RollingTraces, RollingSpectra, LatencyHistogram, Detector]:
        """Make the figures when there is something to show."""
        made = RollingTraces(), RollingSpectra(), LatencyHistogram(), Detector()
        titles = "The last seconds", "Spectra", "Latencies", "Star, as it comes (grey) and corrected by the best of both targets"
        figures = [figure_with_caption(title, drawn.figure) for title, drawn in zip(titles, made, strict=True)]
        grid = pn.Column(*figures, **WIDE, stylesheets=[GRID])
        known = box("Observers", self.table, self.news, self.peaks)
        self.room[:] = [box("Now", line(self.window, self.target), self.lines, grid), known]
        self.room.visible = True
        return made

    def _target(self, loop: LiveLoop) -> str:
        """Return what errors are shown of: without truth, of the next measurement."""
        return self.target.value if loop.source.has_truth else NEXT

    def _draw_table(self, loop: LiveLoop, view: LiveView) -> None:
        self._table_time = monotonic()
        if self._bounds_of is not loop.scenario:
            self._bounds_of, self._bounds = loop.scenario, {}
            loop.workshop.do(bounds_of, loop.scenario.to_dict(), then=partial(setattr, self, "_bounds"))
        scale = per_micrometre(self.display.unit, loop.scenario.telescope.diameter)
        self.table.object = live_html(loop, view, self._target(loop), self.display, scale, self._bounds)
        self.news.object = events_html(loop.events, loop.sampling.dt)
        self.peaks.object = peaks_html(loop.workshop.finding, scale, self.display.unit_label)

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

    def _switch(self, event: param.parameterized.Event) -> None:
        for names, on in ((set(event.new) - set(event.old), True), (set(event.old) - set(event.new), False)):
            for name in names:
                self._do(lambda loop, name=name, on=on: loop.switch(name, on))

    def _follow(self, event: param.parameterized.Event) -> None:
        """Change the loop as the settings in the drawer have changed."""
        self._do(lambda loop: loop.become(event.new.before_events, name_of_difference(loop.scenario, event.new)))

    def _say(self, *_: object) -> None:
        """Enable what can be done, and describe what the job does."""
        work, runs = self.work, self.loop is not None
        for name, button in self.buttons.items():
            button.disabled = (work.state == RUNNING) if name == "Start" else not runs
        self.buttons["Stop"].disabled = work.state != RUNNING
        waiting = work.line() if work.place else "Starting …"
        said = {RUNNING: waiting, FAILED: work.message}.get(work.state, "Stopped" if self._figures else "")
        if not runs:
            self.status.object = f'<p class="{"failure" if work.state == FAILED else "text"}" role="status">{escape(said)}</p>'
        if self._callback is not None:
            self.store.session.post(self._pace)  # once the page stands: what comes before that does not reach it

    def _pace(self) -> None:
        """Draw again and again while there is something to see."""
        wanted = self.visible and self.loop is not None
        if self._callback is not None and wanted != self._callback.running:
            (self._callback.start if wanted else self._callback.stop)()
