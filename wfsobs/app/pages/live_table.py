"""What is known of every observer of a live loop, best first, and what has happened."""

from __future__ import annotations

import re
from collections.abc import Iterable
from html import escape
from math import inf, isnan

import numpy as np
from markupsafe import Markup

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.numerals import NOTHING, number
from wfsobs.app.render import Row, table
from wfsobs.app.style import look, swatch
from wfsobs.closed_loop.run import strehl
from wfsobs.evaluation.rows import row_label, target_title
from wfsobs.live.alarms import ALARM
from wfsobs.live.board import NEXT, SCORED
from wfsobs.live.finding import Bounds, PeakFinding
from wfsobs.live.loop import LiveLoop
from wfsobs.live.peaks import Change, moves_of
from wfsobs.live.view import LiveEvent, LiveView
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.observers.estimates import TOTAL
from wfsobs.typing import Array

SHOWN_EVENTS = 8
FAR_BEHIND = 2.0
"""Beyond this the observers do not catch up by themselves [s]."""
WHAT_RUNS = re.compile(
    r"^\S+(?= (?:on|off|has a new design)$)|(?<=error of )\S+(?= up|$)|(?<=identified for )\S+(?=:)|(?<= s for )\S+$"
)
"""The id of an observer or a controller in an event."""
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
        "error / bound": "the smallest bound of the two",
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
    rows += [
        Row(swatch(name, display.dark) + row_label(name), [number(scale * rms), *[NOTHING] * 5], {"name": name})
        for name, rms in of.items()
    ]
    return str(table("Live", columns, [("", rows)]))


def _row(loop: LiveLoop, name: str, rms: float, target: str, display: Display, scale: float, least: float) -> Row:
    counts = loop.board[name]
    whole = float(counts.rms(target)[display.column]) if target in SCORED else float("nan")
    lacks = [one for one in ((target,) if target in TARGETS else TARGETS) if one not in OBSERVERS[name].targets]
    cells = [
        Markup('<span title="it has no {}">{}</span>').format(lacks[0], NOTHING) if lacks else _number(scale * rms),
        _number(scale * whole),
        _number(rms / least),
        *(_number(1e6 * counts.latencies.quantile(share)) for share in (0.5, 0.999)),
        str(int(counts.late[0])),
    ]
    return Row(swatch(name, display.dark) + look(name).label, cells, {"name": name})


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
        return [*map(_number, (1e3 * now[column], mas * now[column], 1e3 * whole[column])), *ratios]

    order = sorted(found, key=lambda name: inf if isnan(found[name][0][column]) else found[name][0][column])
    rows = [Row(swatch(name, display.dark) + look(name).label, cells(*found[name]), {"controller": name}) for name in order]
    return str(table("Controllers of the live loop", columns, [("", rows)]))


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
        Row(number(p.frequency, 4), [_number(p.frequency_std), moved(p), _number(p.damping), number(scale * p.rms)])
        for p in change.peaks
    ]
    title = "Peaks of the last minute"
    return f'<div class="caption apart">{title}</div>{table(title, columns, [("", rows)])}'


def _number(x: float) -> str:
    return NOTHING if isnan(x) else number(x)


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
    lines = [f"<li>{event.frame * dt:.2f} s: {_event_html(event.line)}</li>" for event in latest]
    return f'<ul class="text" aria-label="Events">{"".join(lines)}</ul>' if lines else ""


def _event_html(line: str) -> str:
    """Write an event; an alarm stands out, and what runs has the name that it has everywhere on the page."""
    line = WHAT_RUNS.sub(lambda found: look(found[0]).label, line)
    return f"<strong>{escape(line)}</strong>" if line.startswith(ALARM) else escape(line)
