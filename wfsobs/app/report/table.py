"""The RMS errors of one state, in nm; the page's script turns a copy of them to other units."""

from __future__ import annotations

import math
from itertools import groupby
from typing import Any

from wfsobs.app.display import score_columns
from wfsobs.app.numbers import NOTHING
from wfsobs.app.report.data import State
from wfsobs.evaluation.rows import TIME, Row, can_be_best, is_non_causal, own_interval, row_label, scored_interval
from wfsobs.evaluation.scores import RESIDUAL


def state_table(state: State, name: str) -> dict[str, Any]:
    """Collect what the table of a state shows: a group per target and mode, best first, and what is missing."""
    groups = [list(rows) for _, rows in groupby(sorted(state.rows, key=_order(state.rows)), _group)]
    return {
        "name": name,
        "columns": score_columns("nm", "z" if any(row["target"] == RESIDUAL for row in state.rows) else "truth"),
        "groups": [_body(rows, state.grid.dt) for rows in groups],
        "reasons": state.reasons,
    }


def _group(row: Row) -> tuple[str, str]:
    return row["target"], row["mode"]


def _order(rows: list[Row]):
    """Targets and modes as they come, best first, those that stand apart last."""
    groups = list(dict.fromkeys(map(_group, rows)))
    return lambda row: (groups.index(_group(row)), row["apart"], row["rms_um"])


def _body(rows: list[Row], dt: float) -> dict[str, Any]:
    target, mode = _group(rows[0])
    best = min((row["rms_um"] for row in rows if can_be_best(row["observer"], row["apart"])), default=math.inf)
    return {
        "target": target,
        "mode": mode,
        "title": ", ".join((target.capitalize(), mode, *filter(None, [scored_interval(rows)]))),
        "rows": [
            {
                **row,
                "label": row_label(row["observer"]),
                "looks_ahead": is_non_causal(row["observer"]),
                "stretch": own_interval(row),
                "best": row["rms_um"] == best and can_be_best(row["observer"], row["apart"]),
                "lag": NOTHING if row["lag_s"] is None else f"{1e3 * row['lag_s']:.2f}".replace("-", "−"),
                "time": row[TIME],
                "factor": None if row[TIME] is None else 1e-6 * row[TIME] / dt,
            }
            for row in rows
        ],
    }
