"""The buttons and fields of the live loop, and what tells that a picture has been painted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import monotonic
from typing import Any

import panel_material_ui as pmui
import param

from wfsobs.app.component import Component
from wfsobs.app.pages.live_table import QUANTITIES
from wfsobs.app.pages.live_waterfall import MEASUREMENT
from wfsobs.app.pages.parts import WIDE, line
from wfsobs.app.style import asset, look
from wfsobs.live.board import ADAPTIVE, NEXT, SLOTS
from wfsobs.live.checks import has_error, speed_of
from wfsobs.live.control_crew import SEATS, USUAL
from wfsobs.live.loop import LiveLoop
from wfsobs.live.source import SIMULATION, STREAM, LiveSource
from wfsobs.observers.base import TARGETS
from wfsobs.settings.group import SettingError

PATIENCE = 10.0
"""Time after which a picture that the browser has not answered is given up [s]."""
SPEEDS = {f"{speed:g} ×": speed for speed in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)}
WINDOWS = {f"{seconds:g} s": seconds for seconds in (2.0, 5.0, 10.0)}
ALL = "all"
"""Stands for all that run."""
LOSSES = {"none": 0.0, "1 % of frames": 0.01, "5 % of frames": 0.05, "20 % of frames": 0.2}
FIRST = ("kf-lgs", "kf-multi", "multirate", "multirate-multi", "gpr-online")
"""Observers that run first: as many as two cores keep up with beside the page."""
MAIN = ("kf-multi", "multirate-multi", "gpr-online")
"""Observers whose lines are shown first."""
OBSERVERS, CONTROLLERS, SPEED, ERRORS, WINDOW = "observers", "controllers", "speed", "errors", "window"
"""Fields of a link."""
APART: dict[str, Any] = {**WIDE, "margin": (10, 0, 4, 0)}
"""As wide as the page, its label clear of the row above."""
BUTTONS = {
    "Start": "play_arrow",
    "Pause": "pause",
    "Step": "skip_next",
    "Stop": "stop",
    "Redesign now": "build",
    "Identify": "search",
    "Record": "fiber_manual_record",
}
"""Button -> its icon."""


class Pulse(Component):
    """Tells when a picture has been painted."""

    picture = param.Integer(0, doc="Number of the last one.")
    changes = param.List([], doc="What a Painter changes with it.")
    _esm = asset("pulse.js")

    def __init__(self, **params: Any):
        self.answer, self._time = -1, 0.0
        self._waiting: Callable[[], None] | None = None
        super().__init__(self._take, **params)

    def _update_model(self, events: Any, msg: dict[str, Any], root: Any, model: Any, doc: Any, comm: Any) -> None:
        """Send what changes alone: the usual way looks at all that a component may have, which takes as long as a figure."""
        if not set(msg) <= {"picture", "changes"}:
            super()._update_model(events, msg, root, model, doc, comm)
            return
        ref = root.ref["id"]
        self._changing[ref] = list(msg)  # it comes from here, not from the browser
        try:
            model.data.update(**msg)
        finally:
            self._changing.pop(ref, None)

    def _take(self, data: dict[str, Any]) -> None:
        if isinstance(number := data.get("painted"), int):
            self.answer = number
            if self._waiting is not None and self.is_free:
                self.when_free(self._waiting)

    @property
    def is_seen(self) -> bool:
        """Whether the browser has drawn the page."""
        return self.answer >= 0

    @property
    def is_free(self) -> bool:
        """Whether the browser is ready for another; for the first once it has drawn the page."""
        return self.answer >= self.picture or (self.answer >= 0 and monotonic() - self._time > PATIENCE)

    def when_free(self, act: Callable[[], None]) -> None:
        """Do something, or have it done as soon as the browser is ready: else a picture that it is a little late for is lost."""
        self._waiting = None if self.is_free else act
        if self._waiting is None:
            act()

    def beat(self) -> None:
        """Ask for an answer to the picture that has been sent."""
        self._time = monotonic()
        self.picture += 1


class LiveControls:
    """Buttons and fields."""

    def __init__(self) -> None:
        self.buttons = {
            name: pmui.Button(label=name, icon=icon, color="primary" if name == "Start" else "default", size="small", margin=0)
            for name, icon in BUTTONS.items()
        }
        select = {"size": "small", "margin": 0}
        self.speed = pmui.Select(label="Speed", options=SPEEDS, value=1.0, width=100, **select)
        self.window = pmui.Select(label="Window", options=WINDOWS, value=5.0, width=100, **select)
        self.target = pmui.Select(label="Errors of", options=QUANTITIES, value=TARGETS[0], width=300, **select)
        self.lasers = pmui.Checkbox(label="Lasers", value=True, **select)
        self.ngs = pmui.Checkbox(label="NGS", value=True, **select)
        self.losses = pmui.Select(label="Frame loss", options=LOSSES, value=0.0, width=160, **select)
        self.running = pmui.MultiChoice(
            label="Observers", options={look(name).label: name for name in SLOTS}, value=list(FIRST), **APART
        )
        self.controllers = pmui.MultiChoice(
            label="Controllers", options={look(name).label: name for name in SEATS}, value=list(USUAL), **APART
        )
        self.whose = pmui.Select(label="Redesign", options={"All that run": ALL}, value=ALL, width=230, **select)
        for field in (self.running, self.controllers):
            field.param.watch(self._offer, "value")
        self._offer()
        waterfall = {"the measurement": MEASUREMENT} | {f"error of {label}": name for label, name in self.running.options.items()}
        self.waterfall = pmui.Select(label="Waterfall of", options=waterfall, value=MEASUREMENT, width=260, **select)
        self.lines = pmui.MultiChoice(label="Lines", options=self.running.options, value=list(MAIN), **APART)

    def tell(self, loop: LiveLoop) -> None:
        """Show what runs."""
        self.running.value = loop.board.active()
        self._choose_speed(loop.speed)
        self.lines.value = choose_lines(self.lines.value, [name for name in self.running.value if has_error(name, loop.source)])
        self.controllers.value = [name for name in SEATS if name in loop.controllers]
        self._allow(loop.source)

    def _choose_speed(self, speed: float) -> None:
        """Choose a speed, also one that is not among the usual ones."""
        self.speed.options = dict(sorted({**SPEEDS, f"{speed:g} ×": speed}.items(), key=lambda one: one[1]))
        self.speed.value = speed

    @property
    def names_to_design(self) -> list[str] | None:
        """Whose designs are made anew; None: of all that run."""
        return None if self.whose.value == ALL else [self.whose.value]

    def _offer(self, *_: object) -> None:
        """Have those at hand that run, for a new design."""
        names = [*self.running.value, *self.controllers.value]
        if self.whose.value not in names:
            self.whose.value = ALL
        self.whose.options = {"All that run": ALL} | {look(name).label: name for name in names}

    def _allow(self, source: LiveSource) -> None:
        """Have those alone at hand that the source has: a simulation loses frames, a stream keeps its own clock."""
        for field in (self.lasers, self.ngs, self.losses):
            field.disabled = source.name != SIMULATION
        self.speed.disabled = source.name == STREAM
        if source.has_truth and self.target.disabled:
            self.target.value = TARGETS[0]
        if not source.has_truth:
            self.target.value = NEXT
        self.target.disabled = not source.has_truth

    def view(self) -> list[Any]:
        """Return the rows of controls; those of the figures stand by them."""
        b = self.buttons
        return [
            line(b["Start"], b["Pause"], b["Step"], self.speed, b["Stop"]),
            line(self.lasers, self.ngs, self.losses, b["Record"]),
            line(self.whose, b["Redesign now"], b["Identify"]),
            self.running,
        ]

    def link_fields(self) -> dict[str, str]:
        """Return what of the loop differs from what is usual, as a link has it."""
        chosen = {OBSERVERS: (self.running.value, FIRST), CONTROLLERS: (self.controllers.value, USUAL)}
        fields = {name: ",".join(now) for name, (now, usual) in chosen.items() if tuple(now) != tuple(usual)}
        fields |= {} if self.speed.value == 1.0 else {SPEED: f"{self.speed.value:g}"}
        return fields | {name: _text(field.value) for name, field, usual in self._choices if field.value != usual}

    @property
    def _choices(self) -> list[tuple[str, Any, Any]]:
        """Fields that take one of a list: name in a link, field, what is usual."""
        errors = [] if self.target.disabled else [(ERRORS, self.target, TARGETS[0])]
        return [*errors, (WINDOW, self.window, 5.0)]

    def open_link(self, fields: Mapping[str, str], *, runs: bool) -> list[str]:
        """Choose what a link has, or what is usual; return a line for each field refused. runs : a loop, which is left alone."""
        known_fields = (OBSERVERS, CONTROLLERS, SPEED, ERRORS, WINDOW)
        refused = [f"{name}: there is no such part of a view" for name in fields if name not in known_fields]
        for name, select, usual in self._choices:
            of = {_text(value): value for value in select.options.values()}
            select.value = of.get(text := fields.get(name, _text(usual)), usual)
            refused += [] if text in of else [f"{name} = {text[:80]}: takes one of {', '.join(of)}"]
        return refused if runs else [*refused, *self._open_loop(fields)]

    def _open_loop(self, fields: Mapping[str, str]) -> list[str]:
        refused = []
        for name, field, usual in ((OBSERVERS, self.running, FIRST), (CONTROLLERS, self.controllers, USUAL)):
            names, known = fields[name].split(",") if fields.get(name) else [], set(field.options.values())
            field.value = [one for one in names if one in known] if name in fields else list(usual)
            refused += [f"{name} = {one[:80]}: there is none of that name" for one in names if one not in known]
        try:
            self._choose_speed(speed_of(fields.get(SPEED, "1")))
        except SettingError as error:
            refused.append(str(error))
            self._choose_speed(1.0)
        return refused


def choose_lines(choice: Sequence[str], running: Sequence[str]) -> list[str]:
    """Return whose lines are shown: those of the choice that run, others for those that do not, and the adaptive ones.

    >>> choose_lines(["kf-multi", "gpr-online"], ["kf-lgs", "gpr-online", "kf-adaptive"])
    ['gpr-online', 'kf-lgs', 'kf-adaptive']
    """
    kept = [name for name in choice if name in running]
    spare = [name for name in dict.fromkeys((*FIRST, *running)) if name in running and name not in (*kept, *ADAPTIVE)]
    adaptive = [name for name in ADAPTIVE if name in running and name not in kept]
    return [*kept, *spare[: len(choice) - len(kept)], *adaptive]


def _text(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:g}"
