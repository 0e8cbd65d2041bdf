"""The RMS errors of one state, in nm; the page's script turns a copy of them to other units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from wfsobs.app.display import AT_LIMIT, IN_MOST, OVER_SEEDS, score_columns
from wfsobs.app.render import NOTHING
from wfsobs.app.report.data import State
from wfsobs.evaluation.evidence import rank_observers
from wfsobs.evaluation.rows import (
    TIME,
    Row,
    above_bound,
    can_be_best,
    is_non_causal,
    own_bound,
    own_interval,
    row_label,
    scored_interval,
    target_title,
)
from wfsobs.evaluation.scores import BOUNDS, RESIDUAL


def state_table(state: State, name: str) -> dict[str, Any]:
    """Collect what the table of a state shows: a group per target and mode, best first, and what is missing."""
    groups = [list(rows) for _, rows in groupby(sorted(state.rows, key=_order(state.rows)), _group)]
    return {
        "name": name,
        "columns": score_columns("nm", "z" if any(row["target"] == RESIDUAL for row in state.rows) else "truth"),
        "groups": [_body(rows, state.grid.dt, state.seeds) for rows in groups],
        "reasons": state.reasons,
    }


def _group(row: Row) -> tuple[str, str]:
    return row["target"], row["mode"]


def _order(rows: list[Row]):
    """Targets and modes as they come, best first, those that stand apart last."""
    groups = list(dict.fromkeys(map(_group, rows)))
    return lambda row: (groups.index(_group(row)), row["apart"], row["rms_um"])


def _body(rows: list[Row], dt: float, seeds: Mapping[str, Any]) -> dict[str, Any]:
    target, mode = _group(rows[0])
    marks = _marks(rows, seeds.get("leaders", {}).get(f"{target}/{mode}", []))
    bounds = {row["observer"]: row["rms_um"] for row in rows if row["observer"] in BOUNDS}
    limits = {
        row["observer"]
        for row in rows
        if above_bound(row["rms_um"], row["interval_um"], bounds.get(own_bound(row["observer"]) or "")) == 0.0
    }
    over_seeds = f"{OVER_SEEDS}, {seeds.get('count', 1)} seeds"
    return {
        "target": target,
        "mode": mode,
        "title": ", ".join((target_title(target), mode, *filter(None, [scored_interval(rows)]))),
        "rows": [
            {
                **row,
                "label": row_label(row["observer"]),
                "looks_ahead": is_non_causal(row["observer"]),
                "stretch": own_interval(row),
                "mark": marks.get(row["observer"]),
                "at_limit": row["observer"] in limits and AT_LIMIT,
                "interval": row["interval_um"] if seeds or row["observer"] in BOUNDS else None,
                "meaning": IN_MOST if row["observer"] in BOUNDS else over_seeds,
                "lag": NOTHING if row["lag_s"] is None else f"{1e3 * row['lag_s']:z.2f}".replace("-", "−"),
                "time": row[TIME],
                "factor": None if row[TIME] is None else 1e-6 * row[TIME] / dt,
            }
            for row in rows
        ],
    }


def _marks(rows: list[Row], leaders: Sequence[str]) -> dict[str, str]:
    """Mark the best, which differs significantly from all others over the seeds, or those tied; of one record the smallest."""
    if leaders:
        return dict.fromkeys(leaders, "tied" if len(leaders) > 1 else "best")
    rivals = {row["observer"]: row["rms_um"] for row in rows if can_be_best(row["observer"], row["apart"])}
    return dict.fromkeys(rank_observers(rivals)[:1], "smallest")
