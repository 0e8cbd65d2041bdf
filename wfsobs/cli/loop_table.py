"""The residual of the closed loop as a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import mean, median

import numpy as np
from rich.table import Table

from wfsobs.closed_loop.rows import LIMITED, NOT_APPLICABLE, label, linear
from wfsobs.evaluation.evidence import seeds_interval
from wfsobs.evaluation.rows import Row, interval_text


def loop_table(rows: Sequence[Row]) -> Table:
    """Return the residual table, best controller first; residuals are means over seeds with intervals, all else medians."""
    several = len({r["seed"] for r in rows}) > 1
    out = Table(title="Residual in closed loop after warm-up" + (", mean over seeds" if several else ""))
    for name in ("Mode", "Controller", "Prior knowledge"):
        out.add_column(name, no_wrap=True)
    spread = ("95 %, nm",) if several else ()
    for name in ("rms, nm", *spread, "mas", "Strehl", "theory, nm", "gain", "margins", "delay, ms", "at limit, %"):
        out.add_column(name, justify="right", no_wrap=True)
    last = None
    for mode, controller in sorted({(r["mode"], r["controller"]) for r in rows}, key=_order(rows)):
        same = [r for r in rows if (r["mode"], r["controller"]) == (mode, controller)]
        if last not in (None, mode):
            out.add_section()
        last = mode
        stable = all(r["stable"] for r in same)
        left = [r["residual_rms_nm"] for r in same if r["residual_rms_nm"] is not None]
        shown = f"{mean(left):.2f}" if left else "unstable" if not stable else "-"
        if all(r["stable"] is None for r in same):
            shown = "none"
        out.add_row(
            mode,
            label(controller),
            same[0]["needs"],
            shown,
            *((interval_text(seeds_interval(np.array(left)), 1.0),) if several else ()),
            _number(same, "residual_rms_mas", 3),
            _number(same, "strehl", 4),
            linear(same, _number(same, "predicted_rms_nm", 2)),
            _number(same, "gain", 3),
            linear(same, _margins(same[0])),
            linear(same, _number(same, "delay_margin_ms", 2)),
            _share(same),
        )
    if any(r["limited"] for r in rows):
        out.caption = f"{NOT_APPLICABLE}: {LIMITED}"
    return out


def _share(same: Sequence[Row]) -> str:
    """Share of the limited steps in per cent, the median over seeds."""
    shares = [100.0 * r["limited"] for r in same if r["limited"] is not None]
    return f"{median(shares):.2f}" if shares else "-"


def _margins(row: Row) -> str:
    gain, phase = row["gain_margin_db"], row["phase_margin_deg"]
    return "-" if phase is None else f"{'-' if gain is None else f'{gain:.1f}'} dB, {phase:.0f}°"


def _number(same: Sequence[Row], key: str, digits: int) -> str:
    values = [r[key] for r in same if r[key] is not None]
    return f"{median(values):.{digits}f}" if values else "-"


def _order(rows: Sequence[Row]):
    """Modes as they come, least residual first, what has none last."""
    modes = list(dict.fromkeys(r["mode"] for r in rows))

    def key(group: tuple[str, str]) -> tuple:
        left = [r["residual_rms_nm"] for r in rows if (r["mode"], r["controller"]) == group]
        return modes.index(group[0]), mean(float("inf") if x is None else x for x in left)

    return key
