"""A report as one file of HTML: everything in it, nothing fetched.

The policy in its head forbids every request, and every script but those whose checksums it names.
"""

from __future__ import annotations

import base64
import hashlib
import zlib
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.models import (
    BoxAnnotation,
    ColumnDataSource,
    CrosshairTool,
    DataRange1d,
    Range1d,
    Span,
    VSpan,
)
from bokeh.plotting import figure
from bokeh.util.paths import bokehjs_path
from markupsafe import Markup
from numpy.typing import ArrayLike

from wfsobs.app.display import NO_ANGLE, UNITS, per_micrometre
from wfsobs.app.glossary import sentence_on
from wfsobs.app.pages.sweep_views import SweepLines
from wfsobs.app.render import render
from wfsobs.app.report.data import Report, State, state_of, window_of
from wfsobs.app.report.sections import budget_groups, meaning_values, scenario_values, state_names, state_table
from wfsobs.app.style import BOUND_MARKS, PRIMARY, TERM_COLOURS, asset, look, observers_of, sheets
from wfsobs.app.views.plots import MODEL, PEAKS, add_line, add_marks, model_mark, new_figure, new_spectrum, peak_marks
from wfsobs.app.views.traces import EVENT, EVENTS, add_event_marks, event_columns
from wfsobs.app.work import TRUTH, RunResults
from wfsobs.bench.measure import machine
from wfsobs.closed_loop.run import LIMITED, NOT_APPLICABLE, label
from wfsobs.evaluation.budget import TERMS
from wfsobs.evaluation.evidence import Evidence, gather_evidence
from wfsobs.evaluation.result import Result, row_label
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.files import check_writable, write_whole
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS, VIBRATION
from wfsobs.pipeline import run
from wfsobs.progress import QUIET, Watch
from wfsobs.registry import name_list
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import Variation, scenarios
from wfsobs.scenario.names import setting_label, value_of
from wfsobs.sensors.zernike import TIP_TILT
from wfsobs.settings.values import check_kind
from wfsobs.version import __version__

START = 'document.documentElement.classList.add("js")'
"""Run before anything is drawn: what is for scripts alone may show."""


def page(report: Report, date: datetime) -> str:
    """Write the whole file; date: now, in the zone to write it in."""
    bokeh = (bokehjs_path() / "js/bokeh.min.js").read_text(encoding="utf-8") + "\nBokeh.set_log_level('warn')"
    scripts = {"start": START, "bokeh": bokeh, "page": asset("report.js")}
    names = state_names(report)
    # what varies, and the rows of `wfsobs run --json` with the computing time
    rows = [{"state": name, "rows": state.rows} for name, state in zip(names, report.states, strict=True)]
    return render(
        "report/page.html",
        version=__version__,
        report=report,
        machine=machine(("bokeh",)),
        date=date,
        # checksums of the scripts, which alone may run
        sums=[base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts.values()],
        scripts={name: Markup(script) for name, script in scripts.items()},
        sheets={"shared": Markup("".join(sheets("base", "style"))), "own": Markup(asset("report.css"))},
        primary=PRIMARY,
        looks={name: look(name) for name in _line_names()} | {EVENTS: EVENT},
        lines=_lines(report),
        main=report.states[report.start].main,
        about=sentence_on,
        marks=(PEAKS if any(map(_drawn_peaks, report.states)) else "", MODEL),
        shades=SHADES,
        targets=TARGETS,
        modes={name: name[0].upper() + name[1:] for name in _modes(report)},
        units=UNITS,
        sweeps={i: setting_label(report.base, report.variations[i].path) for i in _sweeps(report)},
        names=[name or "All modes" for name in names],
        errors=[state_table(state) for state in report.states],
        budgets=[budget_groups(state) for state in report.states],
        term_colours=TERM_COLOURS,
        bound_marks=BOUND_MARKS,
        observer_label=row_label,
        controller_label=label,
        terms=TERMS,
        not_applicable=NOT_APPLICABLE,
        limited=LIMITED,
        embedded={"rows": rows, "data": _data(report), "figures": _figures(report)},
        **scenario_values(report),
        **meaning_values(report),
    )


def _modes(report: Report) -> list[str]:
    """List the modes of the states, by name; states with fewer have the first of them."""
    return [mode.name for mode in max((state.scenario.modes for state in report.states), key=len)]


def _sweeps(report: Report) -> list[int]:
    """Which variations are of several numbers."""
    return [
        i for i, v in enumerate(report.variations) if len(v.values) > 1 and all(type(value) in (int, float) for value in v.values)
    ]


def _line_names() -> list[str]:
    return [TRUTH, *OBSERVERS, *BOUNDS]


def _lines(report: Report) -> dict[str, list[str]]:
    """Which observers have a line in some state, and the truth, by target."""
    drawn = {tuple(name.split("/")[1:3]) for state in report.states for name in state.lines}
    return {target: [name for name in (TRUTH, *observers_of(target)) if (target, name) in drawn] for target in TARGETS}


# ---------------------------------------------------------------------- for the script


def _figures(report: Report) -> dict[str, Any]:
    """Collect the figures without data, and where each is drawn."""
    document = Document()
    parts = report.sweep["lines"] if report.sweep else ()
    for fig in all_figures(_lines(report), bool(_sweeps(report)), parts).values():
        document.add_root(fig)
    return {"document": document.to_json(deferred=False), "roots": {root.id: str(root.name) for root in document.roots}}


def _data(report: Report) -> dict[str, Any]:
    """Collect looks, states and lines."""
    pool = Pool()
    states = [_state(state, pool, report.is_recorded) for state in report.states]
    return {
        "names": _line_names(),
        "targets": TARGETS,
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
        **pool.write(),
    }


def _state(state: State, pool: Pool, is_recorded: bool) -> dict[str, Any]:
    scenario, grid = state.scenario, state.grid
    events = [] if is_recorded else sorted(scenario.events, key=lambda e: e.start)
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
        "peaks": _drawn_peaks(state),
        "model": [model_mark(scenario)],
        "events": event_columns(events, scenario),
    }


def _drawn_peaks(state: State) -> list[tuple[float, str]]:
    """List the marked peaks; none of a record without truth, whose peaks are not those of the settings."""
    return peak_marks(state.scenario) if any(name.startswith(f"signal/{VIBRATION}/{TRUTH}/") for name in state.lines) else []


# ------------------------------------------------------------------------------------------------------- figures


TRACE, SPECTRUM, SWEEP, PART = "trace", "spectrum", "sweep", "part"

WARM_UP, WINDOW = "warm-up", "window"
NOW = "now"
SHADES = {WARM_UP: "#808080", WINDOW: "#2B8AB3"}
"""Stretches of a trace that are shaded."""


def all_figures(lines: Mapping[str, Sequence[str]], sweeps: bool, parts: Sequence[Mapping[str, Any]] = ()) -> dict[str, figure]:
    """Make all figures by name, as in "trace-turbulence"; the traces share their time axis, the spectra their frequencies.

    lines : names of the lines by target; sweeps : with those of errors over a setting that varies; parts : errors of a sweep over
    one setting, which have their data
    """
    times, frequencies = Range1d(start=0.0, end=10.0), Range1d(start=0.5, end=500.0)
    crosshair = CrosshairTool(dimensions="height", overlay=Span(dimension="height", line_alpha=0.4, line_width=1))
    made = {f"{TRACE}-{target}": _trace(names, times, crosshair) for target, names in lines.items()}
    made |= {f"{SPECTRUM}-{target}": _spectrum(target, names, frequencies) for target, names in lines.items()}
    if sweeps:
        values = DataRange1d()
        made |= {f"{SWEEP}-{target}": _sweep(names, values) for target, names in lines.items()}
    made |= {f"{PART}-{i}": _part(part) for i, part in enumerate(parts)}
    for name, fig in made.items():  # see-through from the start: a white ground leaves its edge behind in dark mode
        fig.update(name=name, background_fill_alpha=0.0, border_fill_alpha=0.0)
    return made


def _trace(names: Sequence[str], times: Range1d, crosshair: CrosshairTool) -> figure:
    """Time traces of the truth and the estimates; warm-up and the stretch of every sample shaded."""
    fig = new_figure(times, (-1.0, 1.0), "time [s]")
    fig.add_tools(crosshair)
    for name, colour in SHADES.items():
        fig.add_layout(
            BoxAnnotation(left=0, right=0, fill_color=colour, fill_alpha=0.10, line_width=0, level="underlay", name=name)
        )
    _add_lines(fig, names)
    add_event_marks(fig)
    return fig


def _spectrum(target: str, names: Sequence[str], frequencies: Range1d) -> figure:
    """Spectra, log-log, the peaks of the vibration and of the Kalman filters' model marked."""
    fig = new_spectrum(frequencies)
    if target == VIBRATION:
        add_marks(fig)
    _add_lines(fig, names)
    return fig


def _sweep(names: Sequence[str], values: DataRange1d) -> figure:
    """RMS errors over the values of a setting, a dot for every run; the present one marked."""
    fig = new_figure(values, DataRange1d(start=0.0, only_visible=True))
    fig.add_glyph(ColumnDataSource({"x": []}), VSpan(x="x", line_color=PEAKS, line_alpha=0.6, line_width=1.5), name=NOW)
    errors = [name for name in names if name != TRUTH]
    source = _add_lines(fig, errors, (0.0, 1.0))
    for name in errors:
        fig.scatter("x", name, source=source, size=5, color=look(name).light, name=name)
    return fig


def _part(part: Mapping[str, Any]) -> figure:
    """Errors of a sweep over its one setting, as on the page of sweeps."""
    lines = SweepLines(part)
    lines.draw(part)
    return lines.figure


def _add_lines(fig: figure, names: Sequence[str], start: Sequence[float] = ()) -> ColumnDataSource:
    """Add lines that the page fills in. start : their points until then, of which axes that fit themselves need some."""
    source = ColumnDataSource({name: [*start] for name in ("x", *names)})
    for name in names:
        add_line(fig, name, source, name)
    return source


# -------------------------------------------------------------------------------------------------------- arrays

LEVELS = 65_534
"""Most steps between the lowest and the highest point of a line; one number more stands for none."""

STEP, DECADES = 2e-3, 1e-3
"""Step of a line over the spread of the middle half of its points, and of a logarithm: finer than a pixel."""


class Pool:
    """Arrays in the file, each once however many states share it."""

    def __init__(self) -> None:
        self.number: dict[bytes, int] = {}

    def add(self, content: bytes) -> int:
        """Add the bytes of an array; return its number."""
        return self.number.setdefault(content, len(self.number))

    def write(self) -> dict[str, Any]:
        """Return the length of every array [bytes], and all of them compressed."""
        return {
            "lengths": [len(content) for content in self.number],
            "arrays": base64.b64encode(zlib.compress(b"".join(self.number), 9)).decode(),
        }


def encode(line: ArrayLike, pool: Pool, logarithmic: bool = False) -> list[float]:
    """Write a line as differences of levels: [number in the pool, lowest, step]; of its decimal logarithm if asked for.

    A difference, modulo 2^16, is small: -1, 1, -2, ... are 1, 2, 3, ..., and the low bytes of all come before the high ones.
    """
    x = np.asarray(line, dtype=np.float64)
    if logarithmic:
        x = np.log10(np.where(x > 0, x, np.nan))
    known = np.isfinite(x)
    low, high = (float(x[known].min()), float(x[known].max())) if known.any() else (0.0, 0.0)
    fine = DECADES if logarithmic or not known.any() else STEP * float(np.subtract(*np.percentile(x[known], (75, 25))))
    step = max((high - low) / LEVELS, fine) or 1.0
    levels = np.full(x.size, LEVELS + 1, dtype=np.uint16)
    levels[known] = np.round((x[known] - low) / step).astype(np.uint16)
    changes = np.diff(levels, prepend=np.uint16(0)).view(np.int16)
    folded = ((changes << 1) ^ (changes >> 15)).astype("<i2").view(np.uint8).reshape(-1, 2)
    return [pool.add(folded.T.tobytes()), low, step]


def export(
    path: str | Path,
    scenario: Scenario,
    *,
    observers: Sequence[str] | None = None,
    vary: Sequence[Variation] = (),
    preset: str = "paper",
    seeds: int = 1,
    watch: Watch = QUIET,
    on_result: Callable[[Result], None] | None = None,
) -> None:
    """Run a scenario and write a report: one HTML file with figures and numbers that opens without a network.

    Parameters
    ----------
    path : str or Path
        File to write.
    scenario : Scenario
        Settings of the run.
    observers : sequence of str, optional
        Ids of the observers; by default all that the scenario has something for.
    vary : sequence of Variation, optional
        Settings and their values (`wfsobs.scenario.configfile.parse_variation`); every combination is run.
    preset : str
        Preset that the report compares the settings with.
    seeds : int
        Number of seeds of every state, `run.seed` and those after it; figures and budgets are of the first, errors have
        intervals over all.
    watch : Watch, optional
        Receives the progress, and is asked at every block of work whether to stop.
    on_result : callable, optional
        Receives every result.

    Raises
    ------
    SettingError
        Two settings exclude each other.
    OSError
        The file cannot be written.
    Cancelled
        `watch` asks to stop.
    """
    check_kind("export", scenario, Scenario)
    chosen, observers = scenarios(scenario, vary), name_list(observers)
    check_writable(path, endings=(".html", ".htm"))
    kept = []
    for i, one in enumerate(chosen):
        of = []
        for number in range(seeds):
            done, scenario_of_seed = i + number / seeds, one.replace({"run.seed": one.run.seed + number}) if number else one
            inner = Watch(lambda f, done=done: watch.progress((done + f / seeds) / len(chosen)), watch.is_cancelled)
            of.append(run(scenario_of_seed, observers=observers, watch=inner))
        if on_result is not None:
            on_result(of[0])
        evidence = gather_evidence([result.scores for result in of]) if seeds > 1 else None
        kept.append(state_of(of[0], len(chosen), evidence=evidence, observers=observers))
    report = Report(preset, scenario, tuple(vary), tuple(kept), observers=observers or ())
    content = page(report, datetime.now().astimezone()).encode()
    write_whole(path, lambda file: file.write(content))


def make(
    results: RunResults,
    preset: str,
    watch: Watch,
    _tell: object = None,
    command: str = "",
    sweep: Mapping[str, Any] | None = None,
    evidence: Evidence | None = None,
    comparison: Mapping[str, Any] | None = None,
) -> bytes:
    """Make the file of the results shown; takes a second or two, so call it in a job. Raises Cancelled.

    command : what makes the estimates again, of a record that is not the simulation of the settings; sweep, comparison : what
    `Report` has of a sweep and of compared runs; evidence : what further seeds say
    """
    state = state_of(results.result, is_simulated=not results.is_recorded, evidence=evidence)
    watch.check()
    report = Report(preset, results.scenario, (), (state,), results.is_recorded, command, sweep, comparison)
    return page(report, datetime.now().astimezone()).encode()
