"""A loop that runs by the clock, with every observer beside it, and changes while it runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from html import escape
from math import inf, isnan
from time import monotonic
from typing import Any, Final

import numpy as np
import panel as pn
import panel_material_ui as pmui

from wfsobs.app.compared import name_of_difference
from wfsobs.app.display import Display
from wfsobs.app.downloads import Save
from wfsobs.app.jobs import FAILED, RUNNING
from wfsobs.app.live_work import live_job, record_saves
from wfsobs.app.pages.live_figures import MEASUREMENT, Pulse, RollingSpectra, RollingTraces, Stars, Waterfall
from wfsobs.app.pages.parts import (
    LinkedFields,
    Page,
    box,
    boxes,
    example,
    figure_with_caption,
    halves,
    legend,
    line,
    render_part,
    text,
    tick,
)
from wfsobs.app.render import NOTHING, render
from wfsobs.app.service import IDLE, BackgroundTask
from wfsobs.app.share import LIVE, CopiedTask
from wfsobs.app.sources import LoadedRecord
from wfsobs.app.store import Store
from wfsobs.app.style import bare, look, make_button, make_select
from wfsobs.app.views.spectrum_editor import Frames, SpectrumEditor
from wfsobs.app.views.switches import group
from wfsobs.app.views.traces import WINDOW_S
from wfsobs.app.work import TRUTH
from wfsobs.closed_loop.run import strehl
from wfsobs.evaluation.exact_errors import Theory
from wfsobs.evaluation.result import row_label, target_title
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.live.board import ADAPTIVE, NEXT, SHARED, SLOTS, LiveView
from wfsobs.live.checks import can_control, can_run, has_error, speed_of
from wfsobs.live.crew import SEATS, USUAL
from wfsobs.live.finding import Bounds, Change, moves_of
from wfsobs.live.loop import LiveLoop, LiveOrder
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.live.source import ALARM, SIMULATION, STREAM, LiveEvent, Replay
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.record import TOTAL
from wfsobs.settings.values import SettingError
from wfsobs.typing import Array

SHOWN_EVENTS = 40
FAR_BEHIND = 2.0
"""Beyond this the observers do not catch up by themselves [s]."""
QUANTITIES = {"Next measurement" if target == NEXT else target_title(target): target for target in (*TARGETS, TOTAL, NEXT)}
"""What errors are shown of."""


def ranking(view: LiveView, names: Iterable[str], target: str, column: int) -> list[tuple[str, float]]:
    """Return the observers with their rms errors over the view [um], best first; those without one last."""
    errors = [(name, float(view.rms(name, target)[column])) for name in names]
    return sorted(errors, key=lambda one: inf if isnan(one[1]) else one[1])


def live_html(loop: LiveLoop, view: LiveView, target: str, display: Display, scale: float, bounds: Bounds) -> str:
    """Write the table of all observers that run."""
    of = {name: by_target[target][display.column] for name, by_target in bounds.items() if target in by_target}
    return render_part(
        "live_observers",
        display,
        ranked=ranking(view, loop.board.active(), target, display.column),
        limits=of,
        least=min(of.values(), default=float("nan")),
        board=loop.board,
        observers=OBSERVERS,
        target=target,
        wanted=(target,) if target in TARGETS else TARGETS,
        seconds=view.n * view.dt,
        scale=scale,
        row_label=row_label,
    )


def control_html(loop: LiveLoop, seconds: float, display: Display, scale: float) -> str:
    """Write what every controller leaves, least first; nothing before one runs."""
    left = loop.control_view(seconds)
    if left is None or not loop.controllers:
        return ""
    wavelength = loop.scenario.control.wavelength
    found = [(name, left.rms(name), left.rms_since_start(name)) for name in loop.controllers]

    def strehl_text(rms: Array) -> str:
        return NOTHING if np.isnan(rms).any() else f"{strehl(rms.tolist(), wavelength):.4f}"

    return render_part(
        "live_controllers",
        display,
        found=sorted(found, key=lambda one: inf if isnan(one[1][display.column]) else one[1][display.column]),
        has_truth=loop.source.has_truth,
        seconds=seconds,
        scale=scale,
        strehl=strehl_text,
        wavelength=wavelength,
    )


def peaks_html(change: Change | None, scale: float, unit: str) -> str:
    """Write the peaks of the last identification, and how far each is from where the one before had it."""
    if change is None:
        return ""
    return render("pages/peaks.html", change=change, was={**change.same, **moves_of(change)}, scale=scale, unit=unit)


def status_line(loop: LiveLoop, view: LiveView) -> str:
    """Say how the loop goes, in one line."""
    if not loop.is_ready:
        return "The observers are being designed"
    state = "Running" if loop.is_playing else "Paused"
    behind = max(loop.newest - loop.count, 0) * loop.sampling.dt / loop.speed  # the two are read one after the other
    advice = ": more than this machine does, switch some off or run slower" if behind > FAR_BEHIND else ""
    parts = [
        f"{state} at {loop.speed:g} × real time",
        f"{view.dt * (view.first + view.n):.1f} s",
        f"{loop.delivery.frames} frames",
        f"{loop.delivery.losses} lost",
        f"{100.0 * loop.delivery.late_share:.2f} % later than 1 ms",
        f"observers {behind:.2f} s behind{advice}",
    ]
    return " · ".join([*parts, "recording"] if loop.recorder.is_on else parts)


def events_html(events: Iterable[LiveEvent], dt: float) -> str:
    """List the latest events, by time, the last one first."""
    latest = sorted(list(events)[-SHOWN_EVENTS:], key=lambda event: event.frame)[::-1]  # some are told late
    return render("pages/events.html", latest=latest, dt=dt, look=look, alarm=ALARM)


SPEEDS = {f"{speed:g} ×": speed for speed in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)}
WINDOWS = {f"{seconds:g} s": seconds for seconds in (2.0, 5.0, 10.0)}
ALL = "all"
"""Stands for all that run."""
LOSSES = {"none": 0.0, "1 % of frames": 0.01, "5 % of frames": 0.05, "20 % of frames": 0.2}
FIRST = ("kf-lgs", "kf-multi", "multirate", "multirate-multi", "gpr-online")
"""Observers that run first: as many as two cores keep up with beside the page."""
MAIN = ("kf-multi", "multirate-multi", "gpr-online")
"""Observers whose lines are shown first."""
LOOP_FIELDS = ("observers", "controllers", "speed")
"""Fields of a link that are of the loop; the others are of the page."""


def choice_of(label: str, names: Iterable[str], usual: Iterable[str]) -> pmui.MultiChoice:
    """Make a list of observers or controllers to choose from, as wide as the page, its label clear of the row above."""
    options = {look(name).label: name for name in names}
    return pmui.MultiChoice(label=label, options=options, value=list(usual), sizing_mode="stretch_width", margin=(10, 0, 4, 0))


class LiveControls:
    """The fields."""

    def __init__(self) -> None:
        self.speed: Final = make_select("Speed", SPEEDS, 1.0, 100)
        self.window: Final = make_select("Window", WINDOWS, 5.0, 100)
        self.target: Final = make_select("Errors of", QUANTITIES, TARGETS[0], 300)
        self.lasers, self.ngs = (pmui.Checkbox(label=name, value=True, size="small", margin=0) for name in ("Lasers", "NGS"))
        self.losses: Final = make_select("Frame loss", LOSSES, 0.0, 160)
        self.running: Final = choice_of("Observers", SLOTS, FIRST)
        self.controllers: Final = choice_of("Controllers", SEATS, USUAL)
        self.whose: Final = make_select("Redesign", {"All that run": ALL}, ALL, 230)
        for field in (self.running, self.controllers):
            field.param.watch(self._offer, "value")
        self._offer()
        waterfall = {"the measurement": MEASUREMENT} | {f"error of {label}": name for label, name in self.running.options.items()}
        self.waterfall: Final = make_select("Waterfall of", waterfall, MEASUREMENT, 260)
        self.lines: Final = choice_of("Lines", SLOTS, MAIN)
        linked = {"errors": self.target, "window": self.window, "observers": self.running}
        linked |= {"controllers": self.controllers, "speed": self.speed}
        self.link: Final = LinkedFields(linked, {"speed": lambda text: self._offer_speed(speed_of(text))})

    def tell(self, loop: LiveLoop) -> None:
        """Show what runs, and offer those fields alone that act: a simulation loses frames, a stream keeps its own clock."""
        source = loop.source
        self.running.value = loop.board.active()
        self._offer_speed(loop.speed)
        self.speed.value = loop.speed
        self.lines.value = choose_lines(self.lines.value, [name for name in self.running.value if has_error(name, source)])
        self.controllers.value = [name for name in SEATS if name in loop.controllers]
        for field in (self.lasers, self.ngs, self.losses):
            field.disabled = source.name != SIMULATION
        self.speed.disabled = source.name == STREAM
        if source.has_truth and self.target.disabled:
            self.target.value = TARGETS[0]
        if not source.has_truth:
            self.target.value = NEXT
        self.target.disabled = not source.has_truth

    def _offer_speed(self, speed: float) -> None:
        """Have a speed among the usual ones."""
        self.speed.options = dict(sorted({**SPEEDS, f"{speed:g} ×": speed}.items(), key=lambda one: one[1]))

    @property
    def names_to_design(self) -> list[str] | None:
        """Whose designs are made anew; None: of all that run."""
        return None if self.whose.value == ALL else [self.whose.value]

    def _offer(self, *_: object) -> None:
        """Have those at hand that run, for a new design."""
        names = [*self.running.value, *self.controllers.value]
        self.whose.value = self.whose.value if self.whose.value in names else ALL
        self.whose.options = {"All that run": ALL} | {look(name).label: name for name in names}


def choose_lines(choice: Sequence[str], running: Sequence[str]) -> list[str]:
    """Return whose lines are shown: those of the choice that run, others for those that do not, and the adaptive ones.

    >>> choose_lines(["kf-multi", "gpr-online"], ["kf-lgs", "gpr-online", "kf-adaptive"])
    ['gpr-online', 'kf-lgs', 'kf-adaptive']
    """
    kept = [name for name in choice if name in running]
    spare = [name for name in dict.fromkeys((*FIRST, *running)) if name in running and name not in (*kept, *ADAPTIVE)]
    adaptive = [name for name in ADAPTIVE if name in running and name not in kept]
    return [*kept, *spare[: len(choice) - len(kept)], *adaptive]


SLOW = 1.0
"""Between two tables [s]."""


class LiveRoom:
    """The figures and tables of one page."""

    def __init__(self, store: Store, display: Display, controls: LiveControls, pulse: Pulse):
        self.display = display
        self.store = store
        self.controls = controls
        self.pulse = pulse
        self.traces: Final = RollingTraces(pulse)
        self.spectra: Final = RollingSpectra(pulse)
        self.waterfall: Final = Waterfall()
        self.stars: Final = Stars(pulse)
        self.table, self.control_table, self.news, self.peaks, self.legend = (bare() for _ in range(5))
        self.editor: SpectrumEditor | None = None
        self._second = 0
        self._bounds: Bounds = {}
        self._spectra_room = figure_with_caption("Spectra", self.spectra.figure)

    def view(self) -> list[pn.Column]:
        """Return the boxes."""
        c = self.controls
        seconds = figure_with_caption("The last seconds", self.traces.figure)
        waterfall = figure_with_caption("Waterfall", self.waterfall.figure)
        waterfall.styles = {"grid-column": "1 / -1"}
        shown = [group(self.display, name) for name in ("show", "spectrum")]
        switches = line(c.window, c.target, *shown, c.waterfall, tick(self.display, "editing"))
        return [
            box("Now", switches, c.lines, self.legend, halves(seconds, self._spectra_room, waterfall)),
            box("Observers", self.table, self.peaks),
            box("Controllers on the same disturbance", c.controllers, self.control_table, self.stars.row),
            box("Events", self.news),
        ]

    def draw(self, loop: LiveLoop, view: LiveView) -> None:
        """Send the present."""
        display, dark = self.display, self.display.dark
        target = self.controls.target.value if loop.source.has_truth else NEXT  # without truth, of the next measurement
        scale = display.scale(loop.scenario)
        active = loop.board.active()
        names = [name for name in active if name in self.controls.lines.value]
        longer = view  # what comes before the window is in a running rms
        if display.running:
            longer = loop.readings.look(loop.view, view.n * view.dt + WINDOW_S, anew=not loop.is_playing)
        self.traces.draw(longer, view.n, target, names, display, scale, list(loop.events), self._bounds)
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
        self.pulse.flush()

    def _draw_tables(self, loop: LiveLoop, view: LiveView, target: str, scale: float) -> None:
        self._bounds = loop.workshop.bounds(loop.scenario)
        self.legend.html = self._legend(loop, target)
        self.table.html = live_html(loop, view, target, self.display, scale, self._bounds)
        self.control_table.html = control_html(loop, self.controls.window.value, self.display, scale)
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
        self.link = c.link
        c.link.left_alone = lambda: LOOP_FIELDS if self.loop else ()
        self.intro: Final = text(INTRO)
        self.status: Final = bare()
        self.room: Final = boxes()
        self.room.visible = False
        self.pulse: Final = Pulse(width=0, height=0, margin=0)
        self.picture: LiveRoom | None = None
        self._known_loop: LiveLoop | None = None
        self.repeat(self.tick, SHARED)
        does: dict[str, tuple[str, Callable[[LiveLoop], None]]] = {
            "Pause": ("pause", lambda loop: loop.pause() if loop.is_playing else loop.play()),
            "Step": ("skip_next", lambda loop: loop.step()),
            "Stop": ("stop", lambda _: self.work.cancel()),
            "Redesign now": ("build", lambda loop: loop.redesign(c.names_to_design)),
            "Identify": ("search", lambda loop: loop.identify(c.names_to_design)),
            "Record": ("fiber_manual_record", self._toggle_recording),
        }
        start = make_button("Start", self.start, icon="play_arrow", color="primary")
        self.buttons: Final = {"Start": start} | {
            name: make_button(name, partial(self._do, act), icon=icon, color="default") for name, (icon, act) in does.items()
        }
        c.speed.param.watch(lambda event: self._do(lambda loop: loop.set_speed(event.new)), "value")
        for field in (c.lasers, c.ngs, c.losses):
            field.param.watch(
                lambda _: self._do(lambda loop: loop.lose(lgs=c.lasers.value, ngs=c.ngs.value, loss=c.losses.value)), "value"
            )
        c.running.param.watch(partial(self._switch, LiveLoop.switch), "value")
        c.controllers.param.watch(partial(self._switch, LiveLoop.control), "value")
        self.work.param.watch(self._say, ["state", "place", "message", "latest"])
        store.param.watch(self._follow, "scenario")
        for field in (c.window, c.target, c.lines, c.waterfall):
            field.param.watch(self.redraw, "value")
        self._say()

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        b, c = self.buttons, self.controls
        run = line(b["Start"], b["Pause"], b["Step"], c.speed, b["Stop"])
        sensors, designs = line(c.lasers, c.ngs, c.losses, b["Record"]), line(c.whose, b["Redesign now"], b["Identify"])
        loop = box("Live loop", self.intro, run, sensors, designs, c.running, self.status, self.pulse)
        return boxes(loop, example("live", self.room), self.room)

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
            label, icon = ("Pause", "pause") if loop.is_playing else ("Play", "play_arrow")
            self.buttons["Pause"].param.update(label=label, icon=icon)
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
