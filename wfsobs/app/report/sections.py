"""The tables and the words of a report: errors, error budgets, closed loop, settings, and what the numbers mean."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Mapping
from datetime import datetime
from functools import partial
from itertools import groupby, product
from typing import Any

from markupsafe import Markup

from wfsobs.app.display import score_columns
from wfsobs.app.render import NOTHING, number
from wfsobs.app.report.data import Report, State, window_of
from wfsobs.app.share import FILE, given_options, to_file
from wfsobs.app.style import BOUND_MARKS, TERM_COLOURS
from wfsobs.app.views.errors import ScoreWriter
from wfsobs.bench.measure import machine
from wfsobs.closed_loop.run import NOT_APPLICABLE, label
from wfsobs.evaluation.budget import TERMS
from wfsobs.evaluation.result import Row, row_label, target_title
from wfsobs.evaluation.scores import BOUND, OF_STAR, RESIDUAL
from wfsobs.prior import GIVEN, IDENTIFIED, TRUE
from wfsobs.scenario.configfile import changed_settings, reference_preset
from wfsobs.scenario.names import setting_label, value_of
from wfsobs.version import __version__


def state_table(state: State, name: str) -> dict[str, Any]:
    """Collect what the table of a state shows: groups by target, mode and prior knowledge, best first, and what is missing."""
    words = {word for row in state.rows for word in row["needs"].split()}
    source = IDENTIFIED if IDENTIFIED in words else GIVEN if GIVEN in words else TRUE
    unit = Markup('<span class="unit">nm</span>')
    writer = ScoreWriter(_length, unit, _head, state.grid.dt, state.seeds.get("count", 1), source)
    groups: list[dict[str, Any]] = []
    for target, mode in dict.fromkeys(map(_group, state.rows)):
        rows = {row["observer"]: row for row in state.rows if _group(row) == (target, mode)}
        leaders = state.seeds.get("leaders", {}).get(f"{target}/{mode}", [])
        for title, of in writer.groups(target, [target_title(target), mode], rows, leaders):
            groups.append({"target": target, "mode": mode, "title": title, "rows": of})
    is_truthless = any(row["target"] == RESIDUAL for row in state.rows)
    return {
        "name": name,
        "columns": score_columns("nm", "z" if is_truthless else "truth"),
        "groups": groups,
        "reasons": state.reasons,
    }


def _group(row: Row) -> tuple[str, str]:
    return row["target"], row["mode"]


def _length(um: float) -> Markup:
    """Write a length in nm; the script writes it in another unit."""
    return Markup('<span data-um="{}">{}</span>').format(um, number(1e3 * um))


def _head(name: str) -> Markup:
    symbol = '<svg class="swatch" width="26" height="8" aria-hidden="true"><use href="#line-{}"/></svg>{}'
    return Markup(symbol).format(name, row_label(name))


# ------------------------------------------------------------------------------------------------- error budgets


LEAST = 0.05
"""Share of a bar that is drawn [%]."""


ROUNDING = 1e-6
"""Share of the error below which a term is 0."""


def budget_key() -> dict[str, list[tuple[str, str]]]:
    """Return the colours of the terms and of the bounds, with their labels."""
    terms = [(TERM_COLOURS[name], label) for name, label in TERMS.items()]
    return {"terms": terms, "bounds": [(f"2px {dash} {colour}", label) for colour, dash, label in BOUND_MARKS.values()]}


def budget_state_table(state: State, name: str) -> dict[str, Any]:
    """Collect what the table of a state shows: a group per target and mode, least error first."""
    groups = groupby(state.budgets, _group)
    return {"name": name, "groups": [_budget_group(state, target, mode, list(rows)) for (target, mode), rows in groups]}


def _budget_group(state: State, target: str, mode: str, rows: list[Row]) -> dict[str, Any]:
    bounds = {
        row["observer"]: row["rms_um"] ** 2
        for row in state.rows
        if _group(row) == (target, mode) and row["observer"] in BOUND_MARKS
    }
    low, high = (
        limit([*bounds.values(), *(sum(limit(x, 0.0) for x in row["terms_um2"].values()) for row in rows)])
        for limit in (min, max)
    )
    span = high - low or 1.0
    marks = [(*BOUND_MARKS[name][:2], f"{100.0 * (at - low) / span:.1f}") for name, at in bounds.items()]
    return {
        "target": target,
        "mode": mode,
        "title": f"{target_title(target)}, {mode}",
        "marks": marks,
        "rows": [_budget_row(row, low, span) for row in sorted(rows, key=lambda row: row["total_um2"])],
    }


def _budget_row(row: Row, low: float, span: float) -> dict[str, Any]:
    """Return the cells of an observer, and its bar: the space before it and its pieces in percent, negative ones first."""
    terms: Mapping[str, float] = row["terms_um2"]
    shares = {name: 100.0 * terms[name] / span for name in TERMS}
    negative = sum(-x for x in shares.values() if x < 0)
    ordered = sorted(TERMS, key=lambda name: shares[name] >= 0)
    return {
        "observer": row["observer"],
        "label": row_label(row["observer"]),
        "space": f"{100.0 * -low / span - negative:.1f}",
        "pieces": [(TERM_COLOURS[name], f"{abs(shares[name]):.1f}") for name in ordered if abs(shares[name]) >= LEAST],
        "total": number(1e6 * row["total_um2"]),
        "cells": [_term_cell(terms[name], row["total_um2"]) for name in TERMS],
    }


def _term_cell(term: float, total: float) -> tuple[str, str]:
    """Write a term [nm^2] and its share [%]; as 0 where rounding would show more than the cause."""
    share = round(100.0 * term / total) if total else 0
    return number(1e6 * term if abs(term) > ROUNDING * total else 0.0), f"{share}".replace("-", "−")


# --------------------------------------------------------------------------------------------------- closed loop


def loop_state_table(state: State, name: str) -> dict[str, Any]:
    """Collect what the table of a state shows: a group per mode, least residual first."""
    modes = list(dict.fromkeys(row["mode"] for row in state.loop))

    def order(row: Row) -> tuple[int, bool, float]:
        residual = row["residual_rms_nm"]
        return modes.index(row["mode"]), residual is None, residual or 0.0

    return {
        "name": name,
        "columns": (
            "Controller",
            "Residual [nm]",
            "Residual [mas]",
            f"Strehl at {state.scenario.control.wavelength:g} µm",
            "Theory [nm]",
            "Gain",
            "Gain margin [dB]",
            "Phase margin [°]",
            "Delay margin [ms]",
            "At a limit [%]",
            "Prior knowledge",
        ),
        "groups": [
            {"mode": mode, "title": mode[0].upper() + mode[1:], "rows": [_loop_row(row) for row in rows]}
            for mode, rows in groupby(sorted(state.loop, key=order), key=lambda row: row["mode"])
        ],
    }


def _loop_row(row: Row) -> dict[str, Any]:
    linear = ("predicted_rms_nm", "gain", "gain_margin_db", "phase_margin_deg", "delay_margin_ms")
    cells = [
        number(row["residual_rms_nm"]),
        number(row["residual_rms_mas"]),
        NOTHING if row["strehl"] is None else f"{row['strehl']:.4f}",
        *(NOT_APPLICABLE if row["limited"] and key != "gain" else number(row[key]) for key in linear),
        NOTHING if row["limited"] is None else number(100.0 * row["limited"], 2),
        row["needs"],
    ]
    return {
        "controller": row["controller"],
        "label": label(row["controller"]),
        "unstable": row["stable"] is False,
        "cells": cells,
    }


# --------------------------------------------------------------------------------------------------------- words


def summary(report: Report, date: datetime) -> str:
    """Say in one line what this is."""
    base, count = report.base, len(changed_settings(report.base, reference_preset(report.preset)))
    grid = report.states[0].grid
    parts = [
        f"Preset {report.preset}" + (f", {count} setting{'s' * (count > 1)} changed" if count else ""),
        f"{grid.n * grid.dt:g} s at {1.0 / grid.dt:.6g} Hz",
        "of a loaded record" if report.is_recorded else f"seed {base.run.seed}",
        *([f"{len(report.states)} variations"] if len(report.states) > 1 else []),
        f"made {date:%Y-%m-%d %H:%M %Z}".rstrip() + f" with wfsobs {__version__}",
    ]
    return " · ".join(parts)


def state_name(report: Report, state: State, index: int) -> str:
    """Name a state by the values of what varies."""
    parts = []
    for variation, value in zip(report.variations, values_of(report, index), strict=True):
        label, bracket, unit = setting_label(state.scenario, variation.path).partition(" [")
        parts.append(f"{label} {value_of(value)}{' ' + unit.rstrip(']') if bracket else ''}")
    return ", ".join(parts)


def values_of(report: Report, index: int) -> list[Any]:
    """List the value of every variation in a state."""
    return list([*product(*(variation.values for variation in report.variations))][index])


# ---------------------------------------------------------------------- sections


def scenario_values(report: Report) -> dict[str, Any]:
    """Collect what differs from the preset, every setting, and how settings are written."""
    preset = reference_preset(report.preset)
    before = changed_settings(preset, report.base)
    toml = to_file(report.base, report.preset)
    return {
        "changed": {path: (before[path], value) for path, value in changed_settings(report.base, preset).items()},
        "label": partial(setting_label, report.base),
        "value_of": value_of,
        "file": FILE,
        "toml": toml,
        "toml_base64": base64.b64encode(toml.encode()).decode(),
    }


def meaning_values(report: Report) -> dict[str, Any]:
    """Collect what the explanation of the numbers depends on.

    matched : what the Kalman filters are given that a real one has to estimate
    points  : points kept of a trace, the fewest and the most of the states; none where every sample is
    """
    rows = [row for state in report.states for row in state.rows]
    kalman, grids = report.base.kalman, [state.grid for state in report.states]
    noises = {"disturbances": kalman.process_noise, "sensor noise": kalman.measurement_noise}
    counts = sorted({g.n if g.whole else 2 * g.bins + g.width for g in grids})
    return {
        "warm_up": f"{report.base.run.warm_up:g}",
        "truthless": any(row["target"] == RESIDUAL for row in rows),
        "of_star": OF_STAR,
        "bounded": any(row["observer"] == BOUND for row in rows),
        "seeds": n_seeds(report),
        "budgeted": any(state.budgets for state in report.states),
        "matched": [what for what, how in noises.items() if how == "matched"],
        "points": [] if all(g.whole for g in grids) else counts if len(counts) < 2 else [counts[0], counts[-1]],
        "window": window_of(report.states),
    }


def n_seeds(report: Report) -> int:
    """Return the number of seeds that the errors rest on."""
    return max((int(state.seeds.get("count", 1)) for state in report.states), default=1)


def origin_values(report: Report, date: datetime) -> dict[str, Any]:
    """Collect versions, date, seed, and the command that makes the report again."""
    command, by_file = command_of(report)
    facts = {"Program": f"wfsobs {__version__}, {machine(('bokeh',))}", "Made": f"{date:%Y-%m-%d %H:%M:%S %Z}".rstrip()}
    if not report.is_recorded:
        facts["Seed"] = str(report.base.run.seed)
    return {"facts": facts, "command": command, "by_file": by_file}


def command_of(report: Report) -> tuple[str, bool]:
    """Write the command line of a report; say whether it takes its settings from FILE, being too long otherwise."""
    if report.is_recorded:
        command = report.command or f"wfsobs observe RECORD --config {FILE}"
        return command, f"--config {FILE}" in command
    given, seeds = given_options(report.base, report.preset, FILE), n_seeds(report)
    chosen = [word for name in report.observers for word in ("--observer", name)]
    varied = [word for variation in report.variations for word in ("--vary", str(variation))]
    words = [*given, *chosen, *varied, *(["--seeds", str(seeds)] if seeds > 1 else [])]
    return shlex.join(["wfsobs", "export", "report.html", *words]), FILE in given
