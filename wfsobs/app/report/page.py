"""A report as one file of HTML: everything in it, nothing fetched.

The policy in its head forbids every request, and every script but those whose checksums it names.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable
from datetime import datetime
from html import escape
from typing import Any

from bokeh.document import Document
from bokeh.resources import Resources

from wfsobs import __version__
from wfsobs.app.display import CUMULATIVE, ERROR, NO_ANGLE, PSD, SIGNAL, UNITS, per_micrometre
from wfsobs.app.report.data import Pool, Report, State, coded, window_of
from wfsobs.app.report.figures import SHADES, SPECTRUM, SWEEP, TRACE, WARM_UP, WINDOW, all_figures
from wfsobs.app.report.loop import loop_section
from wfsobs.app.report.table import state_table
from wfsobs.app.report.text import (
    meaning_section,
    name_of,
    origin_section,
    scenario_section,
    state_name,
    summary,
    value_of,
)
from wfsobs.app.style import PRIMARY, asset, look, observers_of
from wfsobs.app.views.plots import MODEL, PEAKS, marked_peaks
from wfsobs.app.work import TRUTH
from wfsobs.evaluation.scores import BOUND
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS, VIBRATION
from wfsobs.sensors.modes import TIP_TILT

START = 'document.documentElement.classList.add("js")'
"""Run before anything is drawn: what is for scripts alone may show."""

MARKS = (
    f'<span class="mark" style="border-left:2px solid {PEAKS}">peaks</span>'
    f'<span class="mark" style="border-left:2px dashed {MODEL}">peak in the Kalman filters</span>'
)


def page(report: Report, made: datetime) -> str:
    """The whole file; made: now, in the zone to write it in."""
    document = Document()
    for figure in all_figures(bool(_sweeps(report))).values():
        document.add_root(figure)
    roots = {root.id: str(root.name) for root in document.roots}
    figures = {"document": document.to_json(deferred=False), "roots": roots}
    bokeh = "\n".join(Resources(mode="inline", components=["bokeh"], minified=True, log_level="warn").js_raw)
    script = f"{asset('strip.js')}\n{asset('report.js')}"
    title = escape(f"wfsobs report: preset {report.preset}, seed {report.base.run.seed}")
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_policy(START, bokeh, script)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n<meta name="color-scheme" content="light dark">\n'
        f'<meta name="generator" content="wfsobs {__version__}">\n<title>{title}</title>\n'
        f"<style>\n{asset('style.css')}{asset('strip.css')}{_colours()}{asset('report.css')}</style>\n"
        f"<script>{START}</script>\n</head>\n<body>\n{_symbols()}\n"
        f"<header><h1>wfsobs report</h1><p>{summary(report, made)}</p></header>\n<main>\n{_body(report, made)}</main>\n"
        f"{_embedded('rows', _rows(report))}{_embedded('data', _data(report))}{_embedded('figures', figures)}"
        f'<script>{bokeh}</script>\n<script type="module">{script}</script>\n</body>\n</html>\n'
    )


# ---------------------------------------------------------------------- sections


def _body(report: Report, made: datetime) -> str:
    """The sections from the top."""
    sections: list[tuple[str, str, Callable[[], str]]] = [
        ("", "controls script-only", lambda: _controls(report)),
        *((target.capitalize(), "script-only", lambda target=target: _target(report, target)) for target in TARGETS),
        *([("RMS error over a setting", "script-only", lambda: _sweep(report))] if _sweeps(report) else []),
        ("RMS errors", "", lambda: _tables(report)),
        *([("Closed loop", "", lambda: loop_section(report))] if any(state.loop for state in report.states) else []),
        ("Scenario", "", lambda: scenario_section(report)),
        ("What the numbers mean", "text", lambda: meaning_section(report)),
        ("Made with", "", lambda: origin_section(report, made)),
    ]
    return "".join(_section(title, kind, content()) for title, kind, content in sections)


def _section(title: str, kind: str, content: str) -> str:
    heading = f"<h2>{escape(title)}</h2>" if title else '<h2 class="hidden">Controls</h2>'
    return f'<section class="box {kind}">{heading}\n{content}</section>\n'


def _controls(report: Report) -> str:
    """A slider for every variation, and the switches."""
    sliders = "".join(
        f'<div class="slider"><label for="vary-{i}">{escape(name_of(report.base, v.path))} <code>{escape(v.path)}</code></label>'
        f'<input type="range" id="vary-{i}" min="0" max="{len(v.values) - 1}" value="0" step="1" autocomplete="off">'
        f'<output for="vary-{i}"></output></div>'
        for i, v in enumerate(report.variations)
    )
    modes = {name: name[0].upper() + name[1:] for name in _modes(report)}
    switches = "".join(
        (
            (_switch if len(modes) <= len(TIP_TILT) else _list)("mode", "Mode", modes),
            _switch("unit", "Unit", UNITS),
            _switch("show", "Show", {SIGNAL: "Signal", ERROR: "Error"}),
            _switch("spectrum", "Spectrum", {PSD: "PSD", CUMULATIVE: "Cumulative rms"}),
            _switch("zoom", "Time window", {"whole": "Whole record", "2": "2 s", "0.5": "0.5 s"}),
        )
    )
    sliders = f'<div class="sliders">{sliders}</div>' if sliders else ""
    return f'{sliders}<div class="switches">{switches}</div><p id="fault" role="alert" hidden></p>'


def _switch(name: str, title: str, options: Any) -> str:
    buttons = "".join(
        f'<label><input type="radio" name="{name}" value="{escape(value)}" autocomplete="off"{" checked" * (i == 0)}>'
        f"<span>{escape(label)}</span></label>"
        for i, (value, label) in enumerate(options.items())
    )
    return f'<fieldset class="switch"><legend class="hidden">{title}</legend>{buttons}</fieldset>'


def _list(name: str, title: str, options: Any) -> str:
    items = "".join(f'<option value="{escape(value)}">{escape(label)}</option>' for value, label in options.items())
    return f'<label class="list">{title} <select name="{name}" autocomplete="off">{items}</select></label>'


def _modes(report: Report) -> list[str]:
    """The modes of the states, by name; those with fewer have the first of them."""
    return [mode.name for mode in max((state.scenario.modes for state in report.states), key=len)]


def _target(report: Report, target: str) -> str:
    """The cards and the two figures of one target."""
    shades = _shade("warm-up", WARM_UP) + (_shade("every sample", WINDOW) if window_of(report.states) else "")
    figures = "".join(
        f'<figure><figcaption class="caption">{title}{marks}</figcaption><div id="{kind}-{target}"></div></figure>'
        for kind, title, marks in ((TRACE, "Time trace", shades), (SPECTRUM, "Spectrum", MARKS if target == VIBRATION else ""))
    )
    return f'<div id="cards-{target}"></div><div class="figures">{figures}</div>'


def _sweep(report: Report) -> str:
    """Errors over a setting that varies, the others where their sliders stand."""
    paths = {str(i): name_of(report.base, report.variations[i].path) for i in _sweeps(report)}
    choice = f'<div class="switches">{_list("over", "Over", paths)}</div>' if len(paths) > 1 else ""
    figures = "".join(
        f'<figure><figcaption class="caption">{target.capitalize()}</figcaption><div id="{SWEEP}-{target}"></div></figure>'
        for target in TARGETS
    )
    return f'{choice}<div class="figures even">{figures}</div>'


def _sweeps(report: Report) -> list[int]:
    """Which variations are of several numbers."""
    return [i for i, v in enumerate(report.variations) if len(v.values) > 1 and all(map(_is_number, v.values))]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _shade(title: str, name: str) -> str:
    return f'<span class="mark shade" style="--shade:{SHADES[name]}">{title}</span>'


def _tables(report: Report) -> str:
    """The table of the state shown, for scripts, and that of every state."""
    several = len(report.states) > 1
    names = [state_name(report, state, i) or "All modes" for i, state in enumerate(report.states)]
    tables = "".join(
        f"<details{' open' * (i == report.start)}><summary>{escape(name)}</summary>"
        f'<div data-state="{i}">{state_table(state, name)}</div></details>'
        for i, (name, state) in enumerate(zip(names, report.states, strict=True))
    )
    heading = f"<h3>Every variation</h3>{tables}" if several else tables
    return (
        '<p class="no-script">The figures need JavaScript; the numbers are here.</p>'
        f'<div id="table" class="script-only"></div><div{"" if several else " class=no-script"}>{heading}</div>'
    )


# ---------------------------------------------------------------------- for the script


def _rows(report: Report) -> list[dict[str, Any]]:
    """What varies and the rows of every state: those of `wfsobs run --json`, with the computing time."""
    return [{"state": state_name(report, state, i), "rows": state.rows} for i, state in enumerate(report.states)]


def _data(report: Report) -> dict[str, Any]:
    """Looks, states and lines."""
    pool = Pool()
    states = [_state(state, pool) for state in report.states]
    return {
        "looks": {
            name: {"label": look(name).label, "light": look(name).light, "dark": look(name).dark, "dash": look(name).dash}
            for name in _drawn()
        },
        "names": {target: [TRUTH, *observers_of(target)] for target in TARGETS},
        "modes": _modes(report),
        "tilts": [m.name for m in TIP_TILT],
        "angles": NO_ANGLE,
        "units": UNITS,
        "start": report.start,
        "variations": [[value_of(value) for value in v.values] for v in report.variations],
        "sweeps": {i: [name_of(report.base, report.variations[i].path), report.variations[i].values] for i in _sweeps(report)},
        "window": window_of(report.states),
        "states": states,
        "arrays": [base64.b64encode(array).decode() for array in pool.all()],
    }


def _state(state: State, pool: Pool) -> dict[str, Any]:
    scenario, grid = state.scenario, state.grid
    lines = {
        name: coded(line, pool, logarithmic=name.startswith(("psd", "cumulative")))
        for name, line in state.lines.items()
        if "/" in name
    }
    axes = {"time": grid.times(), **{name: line for name, line in state.lines.items() if "/" not in name}}
    return {
        "scale": {unit: per_micrometre(unit, scenario.telescope.diameter) for unit in UNITS},
        "dt": grid.dt,
        "length": grid.n * grid.dt,
        "warm_up": scenario.run.warm_up,
        "lines": lines,
        "axes": {name: pool.add(axis.astype("<f4").tobytes()) for name, axis in axes.items()},
        "peaks": [[p.frequency, f"peak {p.frequency:.5g} Hz, damping {p.damping:.3g}"] for p in marked_peaks(scenario)],
        "model": [[scenario.kalman.frequency, f"model of the Kalman filters {scenario.kalman.frequency:.5g} Hz"]],
    }


def _embedded(name: str, content: Any) -> str:
    """Data for the script, which no text in it can end."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f'<script type="application/json" id="{name}">{text}</script>\n'


# ---------------------------------------------------------------------- head


def _policy(*scripts: str) -> str:
    """What the page may do: show itself and run these scripts."""
    sums = " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in scripts)
    return (
        f"default-src 'none'; script-src {sums}; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; "
        "form-action 'none'"
    )


def _colours() -> str:
    """The colour of every line in light and dark mode, as variables."""

    def of(dark: bool) -> str:
        return "".join(f"--line-{name}:{look(name).colour(dark)};" for name in _drawn())

    return f":root{{--primary:{PRIMARY};{of(False)}}}\n@media screen and (prefers-color-scheme:dark){{:root{{{of(True)}}}}}\n"


def _symbols() -> str:
    """The lines' swatches, each once."""
    lines = "".join(
        f'<symbol id="line-{name}" viewBox="0 0 26 8"><line x1="0" y1="4" x2="26" y2="4" stroke="var(--line-{name})" '
        f'stroke-width="2.5" stroke-dasharray="{" ".join(map(str, look(name).dash))}"/></symbol>'
        for name in _drawn()
    )
    return f'<svg width="0" height="0" class="symbols" aria-hidden="true">{lines}</svg>'


def _drawn() -> list[str]:
    return [TRUTH, *OBSERVERS, BOUND]
