"""Results as rows for machines and as a table for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import median
from typing import Any

from rich.table import Table

from wfsobs.evaluation.scores import BOUND, LOOP, RESIDUAL, Score
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import SPECTRA

Row = dict[str, Any]

TIME = "time_per_step_us"
"""Computing time per step and mode [us]: in the table, but not part of the result, which the seed fixes."""


NOT_OBSERVERS = {LOOP: "Recorded loop", BOUND: "Bound, mean of the LGS"}
"""Labels of rows that stand among the observers' and are none."""


def rows(scores: Iterable[Score], seed: int | None) -> list[Row]:
    """One plain dictionary per score: the keys of `wfsobs run --json`, and TIME."""
    return [
        {
            "observer": s.observer, "target": s.target, "mode": s.mode, "rms_um": s.rms, "truth_rms_um": s.truth_rms,
            "normalised_rms": s.normalised_rms, "lag_s": s.lag, "start_s": s.start, "stop_s": s.stop, "apart": s.apart,
            "needs": needs_of(s.observer), "interval_um": None if s.interval is None else list(s.interval), "seed": seed,
            TIME: None if s.observer in NOT_OBSERVERS else s.seconds_per_step * 1e6,
        }
        for s in scores
    ]


def score_table(rows: Sequence[Row]) -> Table:
    """The RMS table, of errors or, without truth, of predictions; over several seeds the medians, with the spread (smallest
    to largest) of the error. The bound has the interval in which an optimal observer's error lies in 95 % of records. Its
    caption says which samples were scored."""
    several = len({r["seed"] for r in rows}) > 1
    unknown = any(r["target"] == RESIDUAL for r in rows)
    title, base = ("One-step prediction error of z, and residual,", "z") if unknown else ("RMS error", "truth")
    table = Table(title=f"{title} after warm-up" + (", median over seeds" if several else ""), caption=_caption(rows))
    for name in ("Target", "Mode", "Observer", "Needs"):
        table.add_column(name, no_wrap=True)
    bounded = ("95 %, nm",) if any(r["interval_um"] for r in rows) else ()
    spread = ("spread, nm",) if several else ()
    for name in ("error, nm", *spread, *bounded, f"{base}, nm", f"error / {base}", "lag, ms", "us / step"):
        table.add_column(name, justify="right", no_wrap=True)
    last = None
    for target, mode, observer in sorted({(r["target"], r["mode"], r["observer"]) for r in rows}, key=_order(rows)):
        same = [r for r in rows if (r["target"], r["mode"], r["observer"]) == (target, mode, observer)]
        errors = [r["rms_um"] * 1e3 for r in same]
        if last not in (None, (target, mode)):
            table.add_section()
        last = (target, mode)
        table.add_row(
            target, mode, label_of(observer) + (" (looks ahead)" if looks_ahead(observer) else "") + _own(same),
            needs_of(observer), f"{median(errors):.2f}",
            *((f"{min(errors):.2f} - {max(errors):.2f}",) if several else ()),
            *((interval_text(same[0]["interval_um"], 1e3),) if bounded else ()),
            f"{median(r['truth_rms_um'] for r in same) * 1e3:.2f}", _number(same, "normalised_rms", 1.0, 3),
            _number(same, "lag_s", 1e3, 2), _number(same, TIME, 1.0, 2),
        )
    return table


def interval_text(interval: Sequence[float] | None, scale: float) -> str:
    """Where the rms of an optimal observer lies in 95 % of records, "low - high"; "-" for rows that have none."""
    return "-" if interval is None else f"{interval[0] * scale:.2f} - {interval[1] * scale:.2f}"


def label_of(observer: str) -> str:
    """What a row is called."""
    return NOT_OBSERVERS.get(observer) or OBSERVERS[observer].label


def needs_of(observer: str) -> str:
    """What a row has to be given beside measurements: the bound the true spectra."""
    if observer in NOT_OBSERVERS:
        return SPECTRA if observer == BOUND else ""
    return OBSERVERS[observer].told


def competes(observer: str, apart: bool) -> bool:
    """Whether a row can be the best: not the bound, nor what looks ahead or was scored on samples of its own."""
    return observer not in NOT_OBSERVERS and not looks_ahead(observer) and not apart


def stretch_of(rows: Iterable[Row]) -> str:
    """What was scored of rows that can be compared, from the earliest to the latest, nothing where there are none.

    >>> stretch_of([{"start_s": 4.001, "stop_s": 9.999, "apart": False}, {"start_s": None, "stop_s": None, "apart": False}])
    '4.00 to 10.00 s'
    """
    return _span([r for r in rows if not r["apart"]])


def own_stretch(row: Row) -> str:
    """What was scored of a row that stands apart, nothing of any other."""
    return f"{_span([row])} only" if row["apart"] else ""


def _span(rows: Sequence[Row]) -> str:
    known = [(r["start_s"], r["stop_s"]) for r in rows if r["start_s"] is not None]
    return f"{min(start for start, _ in known):.2f} to {max(stop for _, stop in known):.2f} s" if known else ""


def _own(same: Sequence[Row]) -> str:
    """What is said of an observer that stands apart, for some seeds or all."""
    return f" ({own_stretch(own[0])})" if (own := [r for r in same if r["apart"]]) else ""


def _caption(rows: Sequence[Row]) -> str:
    """What was scored, target by target where they differ."""
    found = {target: stretch_of(r for r in rows if r["target"] == target) for target in dict.fromkeys(r["target"] for r in rows)}
    spans = {span for span in found.values() if span}
    if len(spans) > 1:
        return "Scored: " + "; ".join(f"{target} {span}" for target, span in found.items() if span)
    return f"Scored: {spans.pop()}" if spans else ""


def looks_ahead(observer: str) -> bool:
    """Whether an estimate uses later samples."""
    return observer not in NOT_OBSERVERS and not OBSERVERS[observer].causal


def _number(same: Sequence[Row], key: str, scale: float, digits: int) -> str:
    values = [r[key] * scale for r in same if r[key] is not None]
    return f"{median(values):.{digits}f}" if values else "-"


def _order(rows: Sequence[Row]):
    """Turbulence before vibration, modes as they come, best observer first, those that stand apart last."""
    modes = list(dict.fromkeys(r["mode"] for r in rows))

    def key(group: tuple[str, str, str]) -> tuple:
        same = [r for r in rows if (r["target"], r["mode"], r["observer"]) == group]
        return group[0], modes.index(group[1]), any(r["apart"] for r in same), median(r["rms_um"] for r in same)

    return key
