"""`wfsobs bench` and `wfsobs rt-check`: what takes how long."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import click
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from wfsobs.bench import tasks
from wfsobs.bench.measure import SHARE, RealTime, Row, machine, measure_realtime
from wfsobs.cli.options import FiniteRange, json_option, scenario_options
from wfsobs.cli.show import new_table, print_json, print_note, progress_bar, show_table
from wfsobs.observers.step import StepError
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError

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


def bench_table(rows: Sequence[Row], markdown: bool) -> Table:
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


@click.command(name="rt-check")
@scenario_options
@click.option("--observer", "name", default="kf-multi", metavar="ID", help="Observer or controller that runs.")
@click.option("--seconds", type=FiniteRange(0.01, 3600), default=5.0, metavar="S", help="Duration.")
@json_option()
def rt_check(scenario: Scenario, name: str, seconds: float, as_json: bool) -> None:
    """Tell what this machine can hold: how late a loop at the LGS rate wakes, and what a step takes in it."""
    rate = scenario.sensors.lgs_rate
    try:
        with threadpool_limits(1, user_api="blas"):
            found = measure_realtime(name, scenario, rate, seconds)
    except StepError as error:
        raise SettingError(str(error)) from None
    rows = _rows(found)
    if as_json:
        summary = {"observer": name, "rate_hz": rate, "late_share": found.late_share, "highest_rate_hz": found.highest_rate}
        print_json({**summary, "microseconds": dict(rows)})
        return
    table = new_table(("us",), ("p50", "p99", "p99.9", "max"), no_wrap=False, box=box.HEAVY_HEAD)
    for what, values in rows:
        table.add_row(what, *(f"{value:.1f}" for value in values))
    show_table(table)
    click.echo(machine())
    click.echo(_verdict(found))


def _rows(timing: RealTime) -> list[tuple[str, list[float]]]:
    """Percentiles [us] by what was timed."""
    named = {
        f"{timing.name}, step back to back": timing.alone.seconds,
        f"{timing.name}, step at {timing.rate:g} Hz": timing.step.seconds,
        "reference step at that rate": timing.reference.seconds,
        "wake-up after the frame was due": np.concatenate([timing.step.late, timing.reference.late]),
    }
    return [(what, (np.percentile(x, [50.0, 99.0, 99.9, 100.0]) * 1e6).tolist()) for what, x in named.items()]


def _verdict(timing: RealTime) -> str:
    """Return one line: what is held."""
    in_time = f"{100 * (1 - timing.late_share):.2f} % of the frames at {timing.rate:g} Hz are done before the next is due"
    held = f"{timing.highest_rate:g} Hz" if timing.highest_rate else "no rate"
    return f"{timing.name}: {in_time}; this machine holds {held} in {100 * SHARE:g} % of the frames"
