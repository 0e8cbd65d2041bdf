"""Timings as a table for people."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.table import Table

from wfsobs.bench.measure import Row


def bench_table(rows: Sequence[Row], markdown: bool = False) -> Table:
    """Return the table of the rows; `markdown` draws it as Markdown."""
    table = Table(box=box.MARKDOWN if markdown else box.HEAVY_HEAD)
    memory = any(r["peak_memory_mb"] is not None for r in rows)
    for name in ("Task", "Size", "Variant"):
        table.add_column(name, no_wrap=True)
    numbers = (
        "steps",
        "median, ms",
        "us / step",
        "99 %, us",
        "99.9 %, us",
        "max, us",
        "ready, us",
        "ratio to ours",
        "error / std",
    )
    for name in (*numbers, *(("peak, MB",) if memory else ())):
        table.add_column(name, justify="right", no_wrap=True)
    last = None
    for r in rows:
        if not markdown and last not in (None, r["task"]):
            table.add_section()
        last = r["task"]
        table.add_row(
            r["task"],
            r["size"],
            r["variant"],
            "-" if r["steps"] is None else str(r["steps"]),
            _number(r["median_s"] * 1e3),
            _number(r["per_step_us"]),
            _number(r["p99_us"]),
            _number(r["p999_us"]),
            _number(r["max_us"]),
            _number(r["ready_us"]),
            _number(r["ratio_to_ours"]),
            "-" if r["max_error_over_std"] is None else f"{r['max_error_over_std']:.0e}",
            *((_number(r["peak_memory_mb"]),) if memory else ()),
        )
    return table


def _number(value: float | None) -> str:
    """Three significant digits, never fewer than those before the point."""
    if value is None:
        return "-"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
