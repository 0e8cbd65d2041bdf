"""What commands print: tables, JSON, warnings, a progress bar."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from wfsobs.cli.budget_table import budget_table
from wfsobs.cli.recovery_tables import OverTime
from wfsobs.cli.tables import score_table
from wfsobs.evaluation.budget import Budget, budget_row, error_budget
from wfsobs.evaluation.evidence import Evidence
from wfsobs.evaluation.result import Result
from wfsobs.evaluation.rows import TIME, Row
from wfsobs.evaluation.scores import PREDICTION
from wfsobs.evaluation.verdict import explain_harm, verdict
from wfsobs.observers.base import TARGETS
from wfsobs.progress import Watch


def show(all_rows: list[Row], as_json: bool) -> None:
    """Print rows to standard output, as JSON or as a table."""
    if as_json:
        click.echo(json.dumps([{k: v for k, v in row.items() if k != TIME} for row in all_rows], allow_nan=False))
    else:
        show_table(score_table(all_rows))


def show_over_time(history: OverTime, as_json: bool) -> None:
    """Print the error against time, as JSON or as a table."""
    if as_json:
        click.echo(json.dumps(history.rows, allow_nan=False))
    else:
        show_table(history.table())


def show_table(table: Table) -> None:
    """Print a table as wide as the terminal, or where there is none as wide as a page."""
    console = Console()
    (console if console.is_terminal else Console(width=195)).print(table)


def show_verdicts(
    result: Result, budgets: Sequence[Budget] = (), evidence: Evidence | None = None, *, is_simulated: bool
) -> None:
    """Print what the table of a record says, a paragraph per target and mode.

    budgets : those that are known;  evidence : what further seeds say;  is_simulated : whether the record is of the scenario
    """
    of = dict.fromkeys((s.target, s.mode) for s in result.scores if s.target in (*TARGETS, PREDICTION))
    known = [*explain_harm(result), *budgets] if is_simulated else []
    simulation = result.scenario if is_simulated else None
    given = result.scenario, result.record, result.estimates, result.scores
    found = (verdict(*given, *key, simulation=simulation, budgets=known, evidence=evidence) for key in of)
    for it in found:
        if it is not None:
            click.echo("\n" + "\n".join(f"{'  ' * bool(i)}{line}" for i, line in enumerate(it.sentences())))


def find_budgets(result: Result, observers: Sequence[str] | None) -> list[Budget]:
    """Return the error budgets of a run, under a progress bar."""
    with progress_bar("error budget") as update:
        return error_budget(result, observers=observers, watch=Watch(progress=update))


def add_budgets(all_rows: list[Row], budgets: Sequence[Budget]) -> list[Row]:
    """Return the rows of one run with their error budgets, where there are any."""
    found = {(b.observer, b.target, b.mode): budget_row(b) for b in budgets}
    return [row | {"budget": found.get((row["observer"], row["target"], row["mode"]))} for row in all_rows] if found else all_rows


def show_budgets(budgets: Sequence[Budget]) -> None:
    """Print error budgets as a table."""
    if budgets:
        click.echo()
        show_table(budget_table(budgets))


def warn(result: Result) -> None:
    """Say which observers were left out, and why."""
    for failure in result.failures:
        click.echo(f"wfsobs: {failure.reason}", err=True)


@contextmanager
def progress_bar(what: str = "observers") -> Iterator[Callable[[float], None]]:
    """Show a progress bar on standard error where that is a terminal; yield the function that moves it."""
    console = Console(stderr=True)
    columns = (TextColumn(what), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("", total=1.0)
        yield lambda fraction: progress.update(task, completed=fraction)
