"""Scores as a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from rich.table import Table

from wfsobs.evaluation.rows import TIME, Row, interval_text, is_non_causal, own_interval, row_label, scored_interval
from wfsobs.evaluation.scores import PREDICTION, RESIDUAL, SCORED


def score_table(rows: Sequence[Row]) -> Table:
    """Return the RMS table, of errors or, without truth, of predictions.

    Over several seeds the medians, with the smallest and the largest error. The bound has the interval of an optimal observer's
    error in 95 % of records,
    and observers may state their standard deviation. The caption gives the interval of the scored samples.
    """
    several = len({r["seed"] for r in rows}) > 1
    unknown = any(r["target"] == RESIDUAL for r in rows)
    title, base = ("One-step prediction error of z, and residual,", "z") if unknown else ("RMS error", "truth")
    table = Table(title=f"{title} after warm-up" + (", median over seeds" if several else ""), caption=_caption(rows))
    for name in ("Target", "Mode", "Observer", "Needs"):
        table.add_column(name, no_wrap=True)
    bounded = ("95 %, nm",) if any(r["interval_um"] for r in rows) else ()
    stated = ("stated, nm",) if any(r["sd_um"] for r in rows) else ()
    spread = ("spread, nm",) if several else ()
    for name in ("error, nm", *spread, *bounded, *stated, f"{base}, nm", f"error / {base}", "lag, ms", "us / step"):
        table.add_column(name, justify="right", no_wrap=True)
    last = None
    for target, mode, observer in sorted({(r["target"], r["mode"], r["observer"]) for r in rows}, key=_order(rows)):
        same = [r for r in rows if (r["target"], r["mode"], r["observer"]) == (target, mode, observer)]
        errors = [r["rms_um"] * 1e3 for r in same]
        if last not in (None, (target, mode)):
            table.add_section()
        last = (target, mode)
        table.add_row(
            target,
            mode,
            row_label(observer) + (" (looks ahead)" if is_non_causal(observer) else "") + _own(same),
            same[0]["needs"],
            f"{median(errors):.2f}",
            *((f"{min(errors):.2f} - {max(errors):.2f}",) if several else ()),
            *((interval_text(same[0]["interval_um"], 1e3),) if bounded else ()),
            *((_number(same, "sd_um", 1e3, 2),) if stated else ()),
            f"{median(r['truth_rms_um'] for r in same) * 1e3:.2f}",
            _number(same, "normalised_rms", 1.0, 3),
            _number(same, "lag_s", 1e3, 2),
            _number(same, TIME, 1.0, 2),
        )
    return table


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
        same = [r for r in rows if (r["target"], r["mode"], r["observer"]) == group]
        return targets.index(group[0]), modes.index(group[1]), any(r["apart"] for r in same), median(r["rms_um"] for r in same)

    return key
