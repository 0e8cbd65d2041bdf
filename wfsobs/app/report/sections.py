"""The tables and the words of a report: errors, error budgets, settings, and what the numbers mean."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Mapping
from functools import partial
from itertools import groupby, product
from typing import Any

from markupsafe import Markup

from wfsobs.app.display import score_columns
from wfsobs.app.render import number
from wfsobs.app.report.data import Report, State, window_of
from wfsobs.app.share import FILE, given_options, to_file
from wfsobs.app.style import BOUND_MARKS, TERM_COLOURS
from wfsobs.app.views.errors import ScoreWriter
from wfsobs.evaluation.budget import TERMS
from wfsobs.evaluation.result import Row, row_label, target_title
from wfsobs.evaluation.scores import BOUND, OF_STAR
from wfsobs.prior import GIVEN, IDENTIFIED, TRUE
from wfsobs.scenario.configfile import changed_settings, reference_preset
from wfsobs.scenario.names import setting_label, value_of


def state_table(state: State) -> dict[str, Any]:
    """Collect what the table of a state shows: groups by target, mode and prior knowledge, best first."""
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
    return {"columns": score_columns("nm", "z" if state.is_truthless else "truth"), "groups": groups}


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


def budget_groups(state: State) -> list[dict[str, Any]]:
    """Collect the budgets of a state by target and mode, least error first, with their bars and the marks of the bounds."""
    groups = []
    for (target, mode), of in groupby(state.budgets, _group):
        rows = sorted(of, key=lambda row: row["total_um2"])
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
        groups.append(
            {
                "target": target,
                "mode": mode,
                "title": f"{target_title(target)}, {mode}",
                "marks": [(*BOUND_MARKS[name][:2], f"{100.0 * (at - low) / span:.1f}") for name, at in bounds.items()],
                "rows": [row | _bar(row["terms_um2"], low, span) for row in rows],
            }
        )
    return groups


def _bar(terms: Mapping[str, float], low: float, span: float) -> dict[str, Any]:
    """Return the bar of an observer: the space before it and its pieces in percent, negative ones first."""
    shares = {name: 100.0 * terms[name] / span for name in TERMS}
    ordered = sorted(TERMS, key=lambda name: shares[name] >= 0)
    return {
        "space": f"{-100.0 * low / span + sum(x for x in shares.values() if x < 0):.1f}",
        "pieces": [(TERM_COLOURS[name], f"{abs(shares[name]):.1f}") for name in ordered if abs(shares[name]) >= LEAST],
    }


# --------------------------------------------------------------------------------------------------------- words


def state_names(report: Report) -> list[str]:
    """Name every state by the values of what varies."""
    names = []
    for state, values in zip(report.states, product(*(variation.values for variation in report.variations)), strict=True):
        parts = []
        for variation, value in zip(report.variations, values, strict=True):
            label, bracket, unit = setting_label(state.scenario, variation.path).partition(" [")
            parts.append(f"{label} {value_of(value)}{' ' + unit.rstrip(']') if bracket else ''}")
        names.append(", ".join(parts))
    return names


# ---------------------------------------------------------------------- sections


def scenario_values(report: Report) -> dict[str, Any]:
    """Collect what differs from the preset, every setting, how settings are written, and the command of the report."""
    preset = reference_preset(report.preset)
    before = changed_settings(preset, report.base)
    toml = to_file(report.base, report.preset)
    command, by_file = command_of(report)
    return {
        "changed": {path: (before[path], value) for path, value in changed_settings(report.base, preset).items()},
        "label": partial(setting_label, report.base),
        "value_of": value_of,
        "file": FILE,
        "toml": toml,
        "toml_base64": base64.b64encode(toml.encode()).decode(),
        "command": command,
        "by_file": by_file,
    }


def meaning_values(report: Report) -> dict[str, Any]:
    """Collect what the explanation of the numbers depends on.

    points : points kept of a trace, the fewest and the most of the states; none where every sample is
    """
    grids = [state.grid for state in report.states]
    counts = sorted({g.n if g.whole else 2 * g.bins + g.width for g in grids})
    return {
        "truthless": any(state.is_truthless for state in report.states),
        "of_star": OF_STAR,
        "bounded": any(row["observer"] == BOUND for state in report.states for row in state.rows),
        "seeds": n_seeds(report),
        "budgeted": any(state.budgets for state in report.states),
        "points": [] if all(g.whole for g in grids) else counts if len(counts) < 2 else [counts[0], counts[-1]],
        "window": window_of(report.states),
    }


def n_seeds(report: Report) -> int:
    """Return the number of seeds that the errors rest on."""
    return max((int(state.seeds.get("count", 1)) for state in report.states), default=1)


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
