"""The error budgets of a report: why every linear observer has the error that it has."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby
from typing import Any

from wfsobs.app.render import number
from wfsobs.app.report.data import State
from wfsobs.app.style import BOUND_MARKS, TERM_COLOURS
from wfsobs.evaluation.budget import TERMS
from wfsobs.evaluation.rows import Row, row_label, target_title

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
    groups = groupby(state.budgets, key=lambda row: (row["target"], row["mode"]))
    return {"name": name, "groups": [_group(state, target, mode, list(rows)) for (target, mode), rows in groups]}


def _group(state: State, target: str, mode: str, rows: list[Row]) -> dict[str, Any]:
    bounds = {
        row["observer"]: row["rms_um"] ** 2
        for row in state.rows
        if (row["target"], row["mode"]) == (target, mode) and row["observer"] in BOUND_MARKS
    }
    ends = [(sum(min(x, 0.0) for x in terms.values()), sum(max(x, 0.0) for x in terms.values())) for terms in _all_terms(rows)]
    low, high = min(low for low, _ in ends), max([*(high for _, high in ends), *bounds.values()])
    span = high - low or 1.0
    marks = [(*BOUND_MARKS[name][:2], f"{100.0 * (at - low) / span:.1f}") for name, at in bounds.items()]
    return {
        "target": target,
        "mode": mode,
        "title": f"{target_title(target)}, {mode}",
        "marks": marks,
        "rows": [_row(row, low, span) for row in sorted(rows, key=lambda row: row["total_um2"])],
    }


def _all_terms(rows: list[Row]) -> list[Mapping[str, float]]:
    return [row["terms_um2"] for row in rows]


def _row(row: Row, low: float, span: float) -> dict[str, Any]:
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
        "cells": [_cell(terms[name], row["total_um2"]) for name in TERMS],
    }


def _cell(term: float, total: float) -> tuple[str, str]:
    """Write a term [nm^2] and its share [%]; as 0 where rounding would show more than the cause."""
    share = round(100.0 * term / total) if total else 0
    return number(1e6 * term if abs(term) > ROUNDING * total else 0.0), f"{share}".replace("-", "−")
