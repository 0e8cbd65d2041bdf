"""`wfsobs bench`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import click
from rich import box
from rich.console import Console
from rich.table import Table

from wfsobs.bench import tasks
from wfsobs.bench.measure import Row, machine
from wfsobs.cli.options import json_option
from wfsobs.cli.show import new_table, print_json, print_note, progress_bar

HEADS = {
    "steps": "steps",
    "median_s": "median, ms",
    "per_step_us": "us / step",
    "p99_us": "99 %, us",
    "p999_us": "99.9 %, us",
    "max_us": "max, us",
    "ready_us": "ready, us",
    "ratio_to_ours": "ratio to ours",
    "max_error_over_std": "error / std",
    "peak_memory_mb": "peak, MB",
}
"""Field of a row -> head of its column."""


@click.command()
@click.option("--full", is_flag=True, help="Include m up to 2048, d up to 1000 and a run of 60 s.")
@json_option("Print a list of rows instead of a table.")
@click.pass_obj
def bench(libraries: Mapping[str, tasks.Library] | None, full: bool, as_json: bool) -> None:
    """Time the observers beside textbook versions."""
    if libraries is None:
        print_note("bench: without scikit-learn, filterpy and statsmodels; python -m benchmarks, in the repository, has them")
    with progress_bar("benchmarks") as watch:
        measured = tasks.measure_all(replace(tasks.FULL if full else tasks.QUICK, libraries=libraries or {}), watch.progress)
    if as_json:
        print_json(measured)
        return
    console = Console()
    table = bench_table(measured, markdown=not console.is_terminal)
    (console if console.is_terminal else Console(width=240)).print(table)
    click.echo(machine(libraries or ()))


def bench_table(rows: Sequence[Row], markdown: bool = False) -> Table:
    """Return the table of the rows; `markdown` draws it as Markdown."""
    fields = [name for name in HEADS if name != "peak_memory_mb" or any(r[name] is not None for r in rows)]
    heads = [HEADS[name] for name in fields]
    table = new_table(("Task", "Size", "Variant"), heads, box=box.MARKDOWN if markdown else box.HEAVY_HEAD)
    last = None
    for r in rows:
        if not markdown and last != r["task"]:
            table.add_section()
        last = r["task"]
        table.add_row(r["task"], r["size"], r["variant"], *(_cell(name, r[name]) for name in fields))
    return table


def _cell(name: str, value: float | None) -> str:
    """Three significant digits, never fewer than those before the point; one of an error."""
    if value is None:
        return "-"
    if name in ("steps", "max_error_over_std"):
        return str(value) if name == "steps" else f"{value:.0e}"
    value *= 1e3 if name == "median_s" else 1.0
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"
