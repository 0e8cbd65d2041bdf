"""Results as rows for machines and as a table for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import median
from typing import Any

from rich.table import Table

from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import SPECTRA
from wfsobs.scores import BOUND, LOOP, RESIDUAL, Score

Row = dict[str, Any]

TIME = "time_per_step_us"
"""Computing time per step and mode [us]: in the table, but not part of the result, which the seed fixes."""


NOT_OBSERVERS = {LOOP: "Recorded loop", BOUND: "Bound, LGS alone"}
"""Labels of rows that stand among the observers' and are none."""


def rows(scores: Iterable[Score], seed: int | None) -> list[Row]:
    """One plain dictionary per score: the keys of `wfsobs run --json`, and TIME."""
    return [
        {
            "observer": s.observer, "target": s.target, "mode": s.mode, "rms_um": s.rms, "truth_rms_um": s.truth_rms,
            "normalised_rms": s.normalised_rms, "lag_s": s.lag, "needs": needs_of(s.observer), "seed": seed,
            TIME: None if s.observer in NOT_OBSERVERS else s.seconds_per_step * 1e6,
        }
        for s in scores
    ]


def score_table(rows: Sequence[Row]) -> Table:
    """The RMS table, of errors or, without truth, of predictions; over several seeds the medians, with the spread (smallest
    to largest) of the error."""
    several = len({r["seed"] for r in rows}) > 1
    unknown = any(r["target"] == RESIDUAL for r in rows)
    title, base = ("One-step prediction error of z, and residual,", "z") if unknown else ("RMS error", "truth")
    table = Table(title=f"{title} after warm-up" + (", median over seeds" if several else ""))
    for name in ("Target", "Mode", "Observer", "Needs"):
        table.add_column(name, no_wrap=True)
    for name in ("error, nm", *(("spread, nm",) if several else ()), f"{base}, nm", f"error / {base}", "lag, ms", "us / step"):
        table.add_column(name, justify="right", no_wrap=True)
    last = None
    for target, mode, observer in sorted({(r["target"], r["mode"], r["observer"]) for r in rows}, key=_order(rows)):
        same = [r for r in rows if (r["target"], r["mode"], r["observer"]) == (target, mode, observer)]
        errors = [r["rms_um"] * 1e3 for r in same]
        if last not in (None, (target, mode)):
            table.add_section()
        last = (target, mode)
        table.add_row(
            target, mode, label_of(observer) + (" (looks ahead)" if looks_ahead(observer) else ""),
            needs_of(observer), f"{median(errors):.2f}",
            *((f"{min(errors):.2f} - {max(errors):.2f}",) if several else ()),
            f"{median(r['truth_rms_um'] for r in same) * 1e3:.2f}", _number(same, "normalised_rms", 1.0, 3),
            _number(same, "lag_s", 1e3, 2), _number(same, TIME, 1.0, 2),
        )
    return table


def label_of(observer: str) -> str:
    """What a row is called."""
    return NOT_OBSERVERS.get(observer) or OBSERVERS[observer].label


def needs_of(observer: str) -> str:
    """What a row has to be given beside measurements: the bound the true spectra."""
    if observer in NOT_OBSERVERS:
        return SPECTRA if observer == BOUND else ""
    return OBSERVERS[observer].told


def competes(observer: str) -> bool:
    """Whether a row can be the best: not the bound, nor what looks ahead."""
    return observer not in NOT_OBSERVERS and OBSERVERS[observer].causal


def looks_ahead(observer: str) -> bool:
    """Whether an estimate uses later samples."""
    return observer not in NOT_OBSERVERS and not OBSERVERS[observer].causal


def _number(same: Sequence[Row], key: str, scale: float, digits: int) -> str:
    values = [r[key] * scale for r in same if r[key] is not None]
    return f"{median(values):.{digits}f}" if values else "-"


def _order(rows: Sequence[Row]):
    """Turbulence before vibration, modes as they come, best observer first."""
    modes = list(dict.fromkeys(r["mode"] for r in rows))

    def key(group: tuple[str, str, str]) -> tuple:
        errors = [r["rms_um"] for r in rows if (r["target"], r["mode"], r["observer"]) == group]
        return group[0], modes.index(group[1]), median(errors)

    return key
