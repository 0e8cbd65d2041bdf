"""Scores as a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import numpy as np
from rich.table import Table

from wfsobs.evaluation.evidence import seeds_interval
from wfsobs.evaluation.rows import (
    NOT_OBSERVERS,
    TIME,
    Row,
    above_bound,
    interval_text,
    is_non_causal,
    own_bound,
    own_interval,
    row_label,
    scored_interval,
)
from wfsobs.evaluation.scores import PREDICTION, RESIDUAL, SCORED


def score_table(rows: Sequence[Row]) -> Table:
    """Return the RMS table, of errors or, without truth, of predictions.

    Errors are means over the seeds, with their intervals at 95 % confidence, all else medians. The bound of the LGS has the
    interval of an optimal observer's error in 95 % of records, and observers may state their standard deviation. The caption
    gives the interval of the scored samples.
    """
    several = len({r["seed"] for r in rows}) > 1
    unknown = any(r["target"] == RESIDUAL for r in rows)
    title, base = ("One-step prediction error of z, and residual,", "z") if unknown else ("RMS error", "truth")
    table = Table(title=f"{title} after warm-up" + (", mean over seeds" if several else ""), caption=_caption(rows))
    for name in ("Target", "Mode", "Observer", "Prior knowledge"):
        table.add_column(name, no_wrap=True)
    bounds = {_group(r): r["rms_um"] for r in rows if r["observer"] in NOT_OBSERVERS}
    bounded = ("to limit",) if any(own_bound(r["observer"]) in {name for *_, name in bounds} for r in rows) else ()
    stated = ("sigma, nm",) if any(r["sd_um"] for r in rows) else ()
    for name in ("error, nm", "95 %, nm", *bounded, *stated, f"{base}, nm", f"error / {base}", "lag, ms", "us / step"):
        table.add_column(name, justify="right", no_wrap=True)
    last = None
    for target, mode, observer in sorted({_group(r) for r in rows}, key=_order(rows)):
        same = [r for r in rows if _group(r) == (target, mode, observer)]
        error, interval = _mean_and_interval(same)
        above = above_bound(error, interval, bounds.get((target, mode, own_bound(observer) or "")))
        if last not in (None, (target, mode)):
            table.add_section()
        last = (target, mode)
        table.add_row(
            target,
            mode,
            row_label(observer) + (" (looks ahead)" if is_non_causal(observer) else "") + _own(same),
            same[0]["needs"],
            f"{error * 1e3:.2f}",
            interval_text(interval, 1e3),
            *(("-" if above is None else f"{100.0 * above:+.0f} %" if above else "at",) if bounded else ()),
            *((_number(same, "sd_um", 1e3, 2),) if stated else ()),
            f"{median(r['truth_rms_um'] for r in same) * 1e3:.2f}",
            _number(same, "normalised_rms", 1.0, 3),
            _number(same, "lag_s", 1e3, 2),
            _number(same, TIME, 1.0, 2),
        )
    return table


def _group(row: Row) -> tuple[str, str, str]:
    return row["target"], row["mode"], row["observer"]


def _mean_and_interval(same: Sequence[Row]) -> tuple[float, Sequence[float] | None]:
    """Return the mean error over the seeds and its interval [um]; of one seed, or of a bound, those of the row."""
    errors = np.array([r["rms_um"] for r in same])
    alone = errors.size == 1 or same[0]["observer"] in NOT_OBSERVERS
    return float(errors.mean()), same[0]["interval_um"] if alone else seeds_interval(errors)


def _own(same: Sequence[Row]) -> str:
    """Return the remark on an observer that stands apart, for some seeds or all."""
    return f" ({own_interval(own[0])})" if (own := [r for r in same if r["apart"]]) else ""


def _caption(rows: Sequence[Row]) -> str:
    """Return the interval of the scored samples, target by target where they differ."""
    found = {
        target: scored_interval(r for r in rows if r["target"] == target) for target in dict.fromkeys(r["target"] for r in rows)
    }
    spans = {span for span in found.values() if span}
    if len(spans) > 1:
        return "Scored: " + "; ".join(f"{target} {span}" for target, span in found.items() if span)
    return f"Scored: {spans.pop()}" if spans else ""


def _number(same: Sequence[Row], key: str, scale: float, digits: int) -> str:
    values = [r[key] * scale for r in same if r[key] is not None]
    return f"{median(values):.{digits}f}" if values else "-"


def _order(rows: Sequence[Row]):
    """Turbulence, vibration, then both together; modes as they come, best observer first, those that stand apart last."""
    modes = list(dict.fromkeys(r["mode"] for r in rows))
    targets = (*SCORED, PREDICTION, RESIDUAL)

    def key(group: tuple[str, str, str]) -> tuple:
        same = [r for r in rows if _group(r) == group]
        return targets.index(group[0]), modes.index(group[1]), any(r["apart"] for r in same), _mean_and_interval(same)[0]

    return key
