"""A report as one file of HTML: everything in it, nothing fetched.

The policy in its head forbids every request, and every script but those whose checksums it names.
"""

from __future__ import annotations

import base64
import hashlib
from datetime import datetime
from typing import Any

from bokeh.document import Document
from bokeh.resources import Resources
from markupsafe import Markup

from wfsobs import __version__
from wfsobs.app.display import NO_ANGLE, UNITS, per_micrometre
from wfsobs.app.render import render
from wfsobs.app.report.budget import budget_key, budget_state_table
from wfsobs.app.report.data import Report, State, window_of
from wfsobs.app.report.encoding import Pool, encode
from wfsobs.app.report.figures import SHADES, all_figures
from wfsobs.app.report.loop import loop_state_table
from wfsobs.app.report.table import state_table
from wfsobs.app.report.text import meaning_values, origin_values, scenario_values, setting_label, state_name, summary, value_of
from wfsobs.app.style import PRIMARY, asset, look, observers_of
from wfsobs.app.views.plots import MODEL, PEAKS, marked_peaks
from wfsobs.app.work import TRUTH
from wfsobs.closed_loop.rows import LIMITED, NOT_APPLICABLE
from wfsobs.evaluation.budget import TERMS
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.sensors.modes import TIP_TILT

START = 'document.documentElement.classList.add("js")'
"""Run before anything is drawn: what is for scripts alone may show."""


def page(report: Report, date: datetime) -> str:
    """Write the whole file; date: now, in the zone to write it in."""
    bokeh = "\n".join(Resources(mode="inline", components=["bokeh"], minified=True, log_level="warn").js_raw)
    scripts = {"start": START, "bokeh": bokeh, "page": f"{asset('patch.js')}\n{asset('strip.js')}\n{asset('report.js')}"}
    names = [state_name(report, state, i) or "All modes" for i, state in enumerate(report.states)]
    states = list(zip(report.states, names, strict=True))
    return render(
        "report/page.html",
        version=__version__,
        report=report,
        summary=summary(report, date),
        policy=_policy(*scripts.values()),
        scripts={name: Markup(script) for name, script in scripts.items()},
        sheets={"shared": Markup(asset("style.css") + asset("strip.css")), "own": Markup(asset("report.css"))},
        primary=PRIMARY,
        looks={name: look(name) for name in _line_names()},
        marks=(PEAKS, MODEL),
        shades=SHADES,
        targets=TARGETS,
        modes={name: name[0].upper() + name[1:] for name in _modes(report)},
        units=UNITS,
        sweeps={i: setting_label(report.base, report.variations[i].path) for i in _sweeps(report)},
        errors=[state_table(state, name) for state, name in states],
        loops=[loop_state_table(state, name) for state, name in states] if any(state.loop for state in report.states) else [],
        budgets=[budget_state_table(state, name) for state, name in states]
        if any(state.budgets for state in report.states)
        else [],
        budget_key=budget_key(),
        terms=TERMS,
        not_applicable=NOT_APPLICABLE,
        limited=LIMITED,
        embedded={"rows": _rows(report), "data": _data(report), "figures": _figures(report)},
        **scenario_values(report),
        **meaning_values(report),
        **origin_values(report, date),
    )


def _policy(*scripts: str) -> str:
    """Write the content security policy: the page may show itself and run these scripts."""
    sums = " ".join(f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in scripts)
    return (
        f"default-src 'none'; script-src {sums}; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; "
        "form-action 'none'"
    )


def _modes(report: Report) -> list[str]:
    """List the modes of the states, by name; states with fewer have the first of them."""
    return [mode.name for mode in max((state.scenario.modes for state in report.states), key=len)]


def _sweeps(report: Report) -> list[int]:
    """Which variations are of several numbers."""
    return [i for i, v in enumerate(report.variations) if len(v.values) > 1 and all(map(_is_number, v.values))]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _line_names() -> list[str]:
    return [TRUTH, *OBSERVERS, *BOUNDS]


# ---------------------------------------------------------------------- for the script


def _figures(report: Report) -> dict[str, Any]:
    """Collect the figures without data, and where each is drawn."""
    document = Document()
    parts = report.sweep["lines"] if report.sweep else ()
    for figure in all_figures(bool(_sweeps(report)), parts).values():
        document.add_root(figure)
    return {"document": document.to_json(deferred=False), "roots": {root.id: str(root.name) for root in document.roots}}


def _rows(report: Report) -> list[dict[str, Any]]:
    """Collect what varies and the rows of every state: those of `wfsobs run --json`, with the computing time."""
    return [{"state": state_name(report, state, i), "rows": state.rows} for i, state in enumerate(report.states)]


def _data(report: Report) -> dict[str, Any]:
    """Collect looks, states and lines."""
    pool = Pool()
    states = [_state(state, pool) for state in report.states]
    return {
        "looks": {
            name: {"label": look(name).label, "light": look(name).light, "dark": look(name).dark, "dash": look(name).dash}
            for name in _line_names()
        },
        "hidden": {
            target: [name for name in observers_of(target) if name not in report.states[report.start].main[target]]
            for target in TARGETS
        },
        "names": {target: [TRUTH, *observers_of(target)] for target in TARGETS},
        "modes": _modes(report),
        "tilts": [m.name for m in TIP_TILT],
        "angles": NO_ANGLE,
        "units": UNITS,
        "start": report.start,
        "variations": [[value_of(value) for value in v.values] for v in report.variations],
        "sweeps": {
            i: [setting_label(report.base, report.variations[i].path), report.variations[i].values] for i in _sweeps(report)
        },
        "window": window_of(report.states),
        "states": states,
        "arrays": [base64.b64encode(array).decode() for array in pool.all()],
    }


def _state(state: State, pool: Pool) -> dict[str, Any]:
    scenario, grid = state.scenario, state.grid
    lines = {
        name: encode(line, pool, logarithmic=name.startswith(("psd", "cumulative")))
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
        "intervals": state.seeds.get("intervals", {}),
        "model": [[scenario.kalman.frequency, f"model of the Kalman filters {scenario.kalman.frequency:.5g} Hz"]],
    }
