"""`wfsobs sweep`: errors over one or two settings."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import click
from rich.table import Table

from wfsobs.campaign.sweep import MOST_SEEDS, SweepResults, parse_axis, plan_sweep, run_sweep
from wfsobs.cli.options import observer_option, scenario_options
from wfsobs.cli.show import new_table, print_note, progress_bar, show_table
from wfsobs.evaluation.evidence import FEWEST
from wfsobs.evaluation.rows import row_label
from wfsobs.files import check_writable, write_text
from wfsobs.scenario import Scenario


@click.command()
@scenario_options
@click.option(
    "--over",
    "axes",
    multiple=True,
    required=True,
    metavar="NAME=VALUES",
    help="Setting and its values: low:high:number, low:high:number:log or v1,v2,v3; repeated for a map over two settings.",
)
@click.option(
    "--seeds",
    type=click.IntRange(1, MOST_SEEDS),
    default=4,
    metavar="N",
    help=f"Seeds of every scenario; no difference is significant with fewer than {FEWEST}.",
)
@observer_option
@click.option("--csv", "csv_file", metavar="FILE", help="Save the errors of all observers.")
def sweep(
    scenario: Scenario,
    axes: tuple[str, ...],
    seeds: int,
    observers: tuple[str, ...],
    csv_file: str | None,
) -> None:
    """Run a scenario over the values of one or two settings and print the best observer in each (docs/sweeps.md)."""
    plan = plan_sweep(scenario, [parse_axis(text) for text in axes], seeds, observers or None)
    if csv_file:
        check_writable(csv_file)
    print_note(f"{len(plan.cells)} scenarios x {seeds} seeds = {plan.n_runs} runs, about {plan.seconds:.2g} s")
    with progress_bar("runs") as watch:
        results = run_sweep(plan, watch)
    if csv_file:
        write_text(csv_file, _csv(results.rows()))
    show_table(_winners(results))
    for cell, reason in results.failures.items():
        print_note(f"{_settings(results, cell)}: {reason}")


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue()


def _settings(results: SweepResults, cell: int) -> str:
    return ", ".join(f"{path} = {value}" for path, value in results.sweep.cells[cell].items())


def _winners(results: SweepResults) -> Table:
    """Return a table with one row per scenario, target and mode."""
    caption = f"~: another is not significantly worse, or fewer than {FEWEST} seeds"
    out = new_table(
        ("Settings", "Target", "Mode", "Best"),
        ("mean rms, nm", "before the next, %"),
        no_wrap=False,
        title="Best observers",
        caption=caption,
    )
    out.add_column("Equal to")
    groups = list(dict.fromkeys(key[1:] for key in results.known_keys()))
    for cell in range(len(results.sweep.cells)):
        for target, mode in groups:
            best = results.winner(cell, target, mode)
            if best is not None:
                margin = "" if best.margin is None else f"{'' if best.is_significant else '~'}{100 * best.margin:.1f}"
                tied = ", ".join(map(row_label, best.ties))
                out.add_row(_settings(results, cell), target, mode, row_label(best.name), f"{1e3 * best.rms:.2f}", margin, tied)
    return out
