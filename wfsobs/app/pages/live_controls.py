"""The buttons, fields and tables of the live loop."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from math import inf, isnan
from typing import Any, Final

import numpy as np
import panel_material_ui as pmui
from markupsafe import Markup

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.pages.live_figures import MEASUREMENT
from wfsobs.app.pages.parts import WIDE, LinkedFields, line
from wfsobs.app.render import NOTHING, Row, number, table
from wfsobs.app.style import look, make_select, named_row
from wfsobs.closed_loop.rows import strehl
from wfsobs.evaluation.rows import row_label, target_title
from wfsobs.live.board import ADAPTIVE, NEXT, SCORED, SLOTS
from wfsobs.live.checks import has_error, speed_of
from wfsobs.live.crew import SEATS, USUAL
from wfsobs.live.finding import Bounds, Change, PeakFinding, moves_of
from wfsobs.live.loop import LiveLoop
from wfsobs.live.source import ALARM, SIMULATION, STREAM, LiveEvent, LiveSource
from wfsobs.live.view import LiveView
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.observers.estimates import TOTAL
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
    unit, seconds = display.unit_label, view.n * view.dt
    columns = {
        "Observer": "",
        f"RMS error [{unit}]": f"over the last {seconds:.1f} s",
        f"Since its start [{unit}]": "after its warm-up",
        "Error / limit": "the lower theoretical limit of the two",
        "Step, median [µs]": "update and estimate of all modes",
        "99.9 % [µs]": "",
        "Longer than a frame": "steps",
    }
    of = {name: by_target[target][display.column] for name, by_target in bounds.items() if target in by_target}
    least = min(of.values(), default=float("nan"))
    rows = [
        _row(loop, name, rms, target, display, scale, least)
        for name, rms in ranking(view, loop.board.active(), target, display.column)
    ]
    rows += [named_row(name, row_label(name), display.dark, [number(scale * rms), *[NOTHING] * 5]) for name, rms in of.items()]
    return table("Live", columns, rows)


def _row(loop: LiveLoop, name: str, rms: float, target: str, display: Display, scale: float, least: float) -> Row:
    counts = loop.board[name]
    whole = float(counts.rms(target)[display.column]) if target in SCORED else float("nan")
    lacks = [one for one in ((target,) if target in TARGETS else TARGETS) if one not in OBSERVERS[name].targets]
    cells = [
        Markup('<span title="it has no {}">{}</span>').format(lacks[0], NOTHING) if lacks else number(scale * rms),
        number(scale * whole),
        number(rms / least),
        *(number(1e6 * counts.latencies.quantile(share)) for share in (0.5, 0.999)),
        str(int(counts.late[0])),
    ]
    return named_row(name, look(name).label, display.dark, cells)


def control_html(loop: LiveLoop, seconds: float, display: Display) -> str:
    """Write what every controller leaves, least first; nothing before one runs."""
    left = loop.control_view(seconds)
    if left is None or not loop.controllers:
        return ""
    c, diameter, column = loop.scenario.control, loop.scenario.telescope.diameter, display.column
    of = "the disturbance" if loop.source.has_truth else "what its sensor would see, with its noise"
    columns = {
        "Controller": "",
        "Residual [nm]": f"rms of {of}, over the last {seconds:g} s, in the mode shown",
        "Residual [mas]": "the same; tip and tilt alone",
        "Since its start [nm]": "after its warm-up",
        f"Strehl at {c.wavelength:g} µm": f"of all modes together, over the last {seconds:g} s",
        "Strehl since its start": "after its warm-up",
    }
    mas = per_micrometre("mas", diameter) if loop.scenario.modes[column].radial_order == 1 else float("nan")
    found = {name: (left.rms(name), left.rms_since_start(name)) for name in loop.controllers}

    def cells(now: Array, whole: Array) -> list[str]:
        ratios = [NOTHING if np.isnan(rms).any() else f"{strehl(rms.tolist(), c.wavelength):.4f}" for rms in (now, whole)]
        return [*map(number, (1e3 * now[column], mas * now[column], 1e3 * whole[column])), *ratios]

    order = sorted(found, key=lambda name: inf if isnan(found[name][0][column]) else found[name][0][column])
    rows = [named_row(name, look(name).label, display.dark, cells(*found[name]), "controller") for name in order]
    return table("Controllers of the live loop", columns, rows)


def peaks_html(change: Change | None, scale: float, unit: str) -> str:
    """Write the peaks of the last identification, and how far each is from where the one before had it."""
    if change is None:
        return ""
    columns = {
        "Peak [Hz]": "",
        "± [Hz]": "standard deviation",
        "Moved by [Hz]": "since the identification before; nothing where that did not find it",
        "Damping": "",
        f"RMS [{unit}]": "of the mode that has most of it",
    }
    was = {**change.same, **moves_of(change)}

    def moved(peak: PeakFinding) -> str:
        if peak not in was:
            return "new" if peak in change.new else NOTHING
        by = round(peak.frequency - was[peak].frequency, 2)
        return f"{by:+.2f}".replace("-", "−") if by else "0"

    rows = [
        Row(number(p.frequency, 4), [number(p.frequency_std), moved(p), number(p.damping), number(scale * p.rms)])
        for p in change.peaks
    ]
    title = "Peaks of the last minute"
    return f'<div class="caption apart">{title}</div>{table(title, columns, rows)}'


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
    lines = [f"<li>{event.frame * dt:.2f} s: {_event_html(event)}</li>" for event in latest]
    return f'<ul class="text" tabindex="0" aria-label="Events">{"".join(lines)}</ul>' if lines else ""


def _event_html(event: LiveEvent) -> str:
    """Write an event; an alarm stands out, and what runs has the name that it has everywhere on the page."""
    line = escape(event.text(look(event.about).label if event.about else ""))
    return f"<strong>{line}</strong>" if event.kind == ALARM else line


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


class LiveControls:
    """Buttons and fields."""

    def __init__(self) -> None:
        self.buttons: Final = {
            name: pmui.Button(label=name, icon=icon, color="primary" if name == "Start" else "default", size="small", margin=0)
            for name, icon in BUTTONS.items()
        }
        self.speed: Final = make_select("Speed", SPEEDS, 1.0, 100)
        self.window: Final = make_select("Window", WINDOWS, 5.0, 100)
        self.target: Final = make_select("Errors of", QUANTITIES, TARGETS[0], 300)
        self.lasers, self.ngs = (pmui.Checkbox(label=name, value=True, size="small", margin=0) for name in ("Lasers", "NGS"))
        self.losses: Final = make_select("Frame loss", LOSSES, 0.0, 160)
        self.running: Final = pmui.MultiChoice(
            label="Observers", options={look(name).label: name for name in SLOTS}, value=list(FIRST), **APART
        )
        self.controllers: Final = pmui.MultiChoice(
            label="Controllers", options={look(name).label: name for name in SEATS}, value=list(USUAL), **APART
        )
        self.whose: Final = make_select("Redesign", {"All that run": ALL}, ALL, 230)
        for field in (self.running, self.controllers):
            field.param.watch(self._offer, "value")
        self._offer()
        waterfall = {"the measurement": MEASUREMENT} | {f"error of {label}": name for label, name in self.running.options.items()}
        self.waterfall: Final = make_select("Waterfall of", waterfall, MEASUREMENT, 260)
        self.lines: Final = pmui.MultiChoice(label="Lines", options=self.running.options, value=list(MAIN), **APART)

        linked = {"errors": self.target, "window": self.window}
        linked |= {"observers": self.running, "controllers": self.controllers, "speed": self.speed}
        self.link: Final = LinkedFields(linked, {"speed": lambda text: self._offer_speed(speed_of(text))})

    def tell(self, loop: LiveLoop) -> None:
        """Show what runs."""
        self.running.value = loop.board.active()
        self._offer_speed(loop.speed)
        self.speed.value = loop.speed
        self.lines.value = choose_lines(self.lines.value, [name for name in self.running.value if has_error(name, loop.source)])
        self.controllers.value = [name for name in SEATS if name in loop.controllers]
        self._allow(loop.source)

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


def choose_lines(choice: Sequence[str], running: Sequence[str]) -> list[str]:
    """Return whose lines are shown: those of the choice that run, others for those that do not, and the adaptive ones.

    >>> choose_lines(["kf-multi", "gpr-online"], ["kf-lgs", "gpr-online", "kf-adaptive"])
    ['gpr-online', 'kf-lgs', 'kf-adaptive']
    """
    kept = [name for name in choice if name in running]
    spare = [name for name in dict.fromkeys((*FIRST, *running)) if name in running and name not in (*kept, *ADAPTIVE)]
    adaptive = [name for name in ADAPTIVE if name in running and name not in kept]
    return [*kept, *spare[: len(choice) - len(kept)], *adaptive]
