"""`wfsobs campaign` and `wfsobs sweep`: errors over settings and seeds, on many processes or machines."""

from __future__ import annotations

import csv
import io
import math
import re
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, fields
from pathlib import Path
from time import perf_counter
from types import FrameType
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from wfsobs.campaign.compare import QUANTILES, Comparison, compare
from wfsobs.campaign.follow import CampaignFolder, TogetherRow, standings
from wfsobs.campaign.plan import Campaign, cells_where, load_plan
from wfsobs.campaign.pools import DaskCluster, Processes, usable_processors
from wfsobs.campaign.run import BATCH, run_campaign, run_cost, run_rows
from wfsobs.campaign.store import (
    RESULTS,
    add_settings,
    check_apart,
    finished_runs,
    folder_plan,
    need_pyarrow,
    present_rows,
    read_results,
)
from wfsobs.campaign.sweep import MOST_SEEDS, SweepResults, parse_axis, plan_sweep, run_sweep
from wfsobs.cli.options import check_output, json_option, observer_option, scenario_options
from wfsobs.cli.show import new_table, print_json, print_note, progress_bar, show_table
from wfsobs.evaluation.evidence import FEWEST
from wfsobs.evaluation.result import NOT_OBSERVERS, row_label
from wfsobs.evaluation.scores import COMMON_BOUNDS, SCORED
from wfsobs.files import write_text
from wfsobs.observers import OBSERVERS
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError

if TYPE_CHECKING:
    import pyarrow


SPREAD = f"{', '.join(f'{q * 100:g}' for q in QUANTILES)} % of seeds"
"""Heading of the quantiles."""

CHUNK = 10_000
"""Rows that are Python objects at a time: these take far more memory than a table."""


def select_rows(plan: Campaign, table: pyarrow.Table, only: Sequence[str], target: str | None, mode: str | None) -> pyarrow.Table:
    """Return the rows of some scenarios, a target and a mode, and of runs without an estimate. Raises SettingError."""
    import pyarrow.compute as pc

    cells = cells_of(plan, only)
    for option, wanted in (("target", target), ("mode", mode)):
        known = sorted(filter(None, table[option].unique().to_pylist()))
        if check_known(option, wanted, known):
            table = table.filter((pc.field(option) == wanted) | (pc.field("target") == ""))
    return table.filter(pc.field("cell").isin(cells)) if only else table


def cells_of(plan: Campaign, only: Sequence[str]) -> list[int]:
    """Return the scenarios of --only. Raises SettingError."""
    try:
        return cells_where(plan, only).tolist()
    except SettingError as error:
        raise SettingError(f"--only {error}") from None


def check_known(option: str, text: str | None, names: Iterable[str]) -> bool:
    """Return whether an option is given. Raises SettingError where it is none of what there are results of."""
    if text is not None and text not in names:
        listed = ", ".join(names)
        raise SettingError(f"--{option} {text}: {f'takes one of {listed}' if listed else 'there are no results yet'}")
    return text is not None


def print_csv(plan: Campaign, table: pyarrow.Table) -> None:
    """Print rows, with the settings of their scenarios; numbers with all their digits."""
    out = csv.writer(sys.stdout, lineterminator="\n")
    columns, axes = list(RESULTS), plan.axes
    out.writerow([*columns, *axes])
    for part in table.to_batches(max_chunksize=CHUNK):
        for row in part.to_pylist():
            changes = plan.cells[row["cell"]].changes if row["cell"] < len(plan.cells) else {}
            out.writerow([row[c] for c in columns] + [changes.get(path) for path in axes])


def summary_table(plan: Campaign, rows: object, title: str) -> Table:
    """Return a table with one row per scenario, target, mode and observer."""
    texts, numbers = ("Scenario", "Settings", "Target", "Mode", "Name"), ("rms, nm", SPREAD, "above the best, nm", "seeds")
    caption = (
        f"+-: interval of {100 * plan.level:.3g} % of one paired difference from a best of the same data; ~: not significant"
    )
    out = new_table(texts, numbers, no_wrap=False, title=title, caption=caption)
    targets, modes = (*SCORED, "residual"), [m.name for m in plan.cells[0].scenario().modes]

    def place(one: Comparison) -> tuple[int, int, int, str]:
        """Order scenarios, targets and modes as the dashboard does; modes that the first scenario has not come last."""
        return one.cell, targets.index(one.target), modes.index(one.mode) if one.mode in modes else len(modes), one.mode

    before = None
    for one in sorted(compare(rows, plan.level), key=place):
        key = (one.cell, one.target, one.mode)
        settings = ", ".join(f"{path.split('.')[-1]} = {value}" for path, value in plan.cells[one.cell].changes.items())
        new = key != before
        around = "" if one.half_width is None else f" +- {one.half_width:.2f}"
        above = "" if one.difference is None else f"{'~' if one.is_tie else ''}{one.difference:.2f}{around}"
        label = NOT_OBSERVERS.get(one.name, one.name)
        failed = f" ({one.failures} failed)" if one.failures else ""
        out.add_row(
            *((one.scenario, settings, one.target, one.mode) if new else ("",) * 4),
            label,
            f"{one.rms:.2f}",
            " ".join(f"{q:.2f}" for q in one.quantiles),
            above,
            f"{one.seeds}{failed}",
        )
        before = key
    return out


def failure_lines(failures: Mapping[tuple[str, str], int]) -> list[str]:
    """Write a line for each observer or controller without errors in some runs; failures : (name, reason) -> in how many runs.

    Of several reasons, which may have numbers of their run in them, the most frequent.

    >>> failure_lines({("ridge-30", "ridge-30 left out: too short"): 2, ("mine", "no model at 3 Hz"): 1, ("mine", "singular"): 2})
    ['mine, 3 runs, of which 2: singular', 'ridge-30, 2 runs: left out: too short']
    """
    reasons: dict[str, Counter[str]] = {}
    for (name, why), n in sorted(failures.items()):
        reasons.setdefault(name, Counter())[why.removeprefix(f"{name} ")] += n
    lines = []
    for name, of in reasons.items():
        (why, n), total = of.most_common(1)[0], of.total()
        lines.append(f"{name}, {total} run{'s' * (total > 1)}{f', of which {n}' * (n < total)}: {why}")
    return lines


NUMBERS = ("rms, nm", "rms / limit", "95 %", "above the best, %", "rank", "wins", "records", "failed")


def print_together(folder: Path, only: Sequence[str], target: str | None, mode: str | None, as_csv: bool) -> None:
    """Print the rows of some scenarios, a target and a mode, as a table or as CSV with all digits. Raises SettingError."""
    state = CampaignFolder(folder).read()
    cells = cells_of(state.plan, only)
    check_known("target", target, sorted({key[0] for key in state.errors}))
    check_known("mode", mode, sorted({key[1] for key in state.errors}))
    keys = [key for key in state.errors if target in (None, key[0]) and mode in (None, key[1])]
    rows = [row for key in keys for row in standings(state, *key, cells)]
    if as_csv:
        out = csv.writer(sys.stdout, lineterminator="\n")
        out.writerow([field.name for field in fields(TogetherRow)])
        out.writerows([["" if value != value else value for value in astuple(row)] for row in rows])  # NaN is not known
        return
    title = f"{state.plan.name}: {state.n_done} of {state.plan.n_runs} runs, {len(cells)} of {len(state.plan.cells)} scenarios"
    level = f"interval of {100 * state.plan.level:.3g} % of one difference from a best of the same data"
    caption = f"above the best: {level}; wins: scenarios with the smallest error, and how many of them are significant"
    out = new_table(("Target", "Mode", "Name"), NUMBERS, no_wrap=False, title=title, caption=caption)
    before = None
    for row in rows:
        key = row.target, row.mode
        out.add_row(
            *(key if key != before else ("", "")),
            NOT_OBSERVERS.get(row.name, row.name),
            f"{row.rms_nm:.2f}",
            "" if math.isnan(row.over_bound) else f"{row.over_bound:.2f}",
            "" if math.isnan(row.over_bound_low) else f"{row.over_bound_low:.2f} to {row.over_bound_high:.2f}",
            _above(row),
            row.rank,
            "" if row.wins is None else f"{row.wins} ({row.decided_wins})",
            str(row.records),
            "" if row.failures is None else str(row.failures),
        )
        before = key
    show_table(out)


def _above(row: TogetherRow) -> str:
    if math.isnan(row.above):
        return ""
    around = "" if math.isnan(row.above_low) else f" ({100 * row.above_low:.1f} to {100 * row.above_high:.1f})"
    return f"{100 * row.above:.1f}{around}"


KEY_BYTES, ROW_BYTES, FILE_BYTES = 34, 12, 6_000
"""Measured size of a key, which all rows of an observer on a record share, of the rest of a row, and of a file without rows."""

LONG = 60.0
"""Expected time of a run that is not tried for a plan [s]."""

STOPPED = 143
"""Exit status after SIGTERM, as the shell has it."""


@click.group()
def campaign() -> None:
    """Run many scenarios and seeds, on many processes or machines (docs/campaigns.md)."""
    need_pyarrow()


@campaign.command("plan")
@click.argument("plan_file", metavar="PLAN")
@click.option(
    "--workers",
    type=click.IntRange(1, 100_000),
    metavar="N",
    help="Batches side by side; by default the processors.",
)
def print_plan(plan_file: str, workers: int | None) -> None:
    """Say how many runs, hours and bytes a campaign takes."""
    plan, side_by_side = load_plan(plan_file), workers or usable_processors()
    hours, measured, failures = _try_first_run(plan)
    rows = rows_of_a_run(plan) * plan.n_runs
    batches = max(1.0, hours * 3600 / BATCH)
    click.echo(f"{plan.name}: {len(plan.cells)} scenarios x {len(plan.seeds)} seeds = {plan.n_runs} runs")
    click.echo(f"observers: {', '.join(plan.observers) or 'none'}; controllers: {', '.join(plan.controllers) or 'none'}")
    for path in plan.axes:
        values = list(dict.fromkeys(repr(c.changes[path]) for c in plan.cells if path in c.changes))
        click.echo(f"  {path}: {', '.join(values[:6])}{f' ... ({len(values)} values)' if len(values) > 6 else ''}")
    click.echo(f"{_span(hours)} of one processor{measured}")
    click.echo(f"{_span(hours / side_by_side)} on {side_by_side} workers, in about {batches:.0f} batches")
    click.echo(f"{rows} rows, about {stored_bytes(plan, batches) / 1e6:.3g} MB")
    for line in failure_lines(failures):
        click.echo(f"without errors: {line}")


def stored_bytes(plan: Campaign, batches: float) -> float:
    """Return about how many bytes the rows of a plan take in so many files."""
    keys = len(plan.observers) + len(plan.controllers) + len(COMMON_BOUNDS)
    return plan.n_runs * (keys * KEY_BYTES + rows_of_a_run(plan) * ROW_BYTES) + batches * FILE_BYTES


def _span(hours: float) -> str:
    """Return a time for people."""
    return f"{hours:.3g} h" if hours >= 1 else f"{hours * 60:.2g} min" if hours >= 0.05 else f"{hours * 3600:.2g} s"


def _try_first_run(plan: Campaign) -> tuple[float, str, Counter[tuple[str, str]]]:
    """Return the time of all runs [h], how it was found (by the first one here, unless that is LONG), and what failed in it."""
    step = max(1, len(plan.cells) // 200)  # of many scenarios some
    costs = [run_cost(plan, cell) for cell in range(0, len(plan.cells), step)]
    mean, how, rows = sum(costs) / len(costs), "", []
    if costs[0] < LONG:
        times = [perf_counter()]
        for _ in range(2):
            rows = run_rows(plan.cells[0], plan.seeds[0], plan.observers, plan.controllers)
            times.append(perf_counter())
        first, again = times[1] - times[0], times[2] - times[1]
        mean = mean * again / costs[0] + max(first - again, 0.0) / len(plan.seeds)  # designs and bounds, once for all seeds
        how = f" (the first run took {again:.2g} s here)"
    return mean * plan.n_runs / 3600, how, Counter({(row["name"], row["note"]) for row in rows if row["rms_nm"] is None})


def rows_of_a_run(plan: Campaign) -> int:
    """Return the rows of a run: of every observer its targets, and their sum where it has both; of every bound all three."""
    of_observers = [len(OBSERVERS[name].targets) for name in plan.observers]
    rows = sum(n + (n > 1) for n in of_observers) + 3 * len(COMMON_BOUNDS) * bool(of_observers)
    rows += (len(plan.controllers) + len(COMMON_BOUNDS)) * bool(plan.controllers)
    return rows * len(plan.cells[0].scenario().modes)


@campaign.command()
@click.argument("plan_file", metavar="PLAN")
@click.option("--out", required=True, metavar="DIR", help="Folder of the results; the same command again resumes.")
@click.option(
    "--workers",
    type=click.IntRange(1, 1024),
    metavar="N",
    help="Processes on this machine; by default one per processor.",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Run on a Dask cluster, such as tcp://head:8786; its workers see DIR under the same path.",
)
@click.option("--shard", metavar="K/N", help="Run the K-th of N shares, for job arrays.")
@json_option("Print what was done as JSON.")
def run(plan_file: str, out: str, workers: int | None, scheduler: str | None, shard: str | None, as_json: bool) -> None:
    """Run what is missing of a campaign."""
    if workers and scheduler:
        raise SettingError("--workers: only for this machine, not with --scheduler")
    plan, share = load_plan(plan_file), _shard(shard)
    stop = _stop_signals()
    with _bar(plan.name) as bar:
        place = DaskCluster(scheduler, print_note) if scheduler else Processes(workers or usable_processors())
        task = bar.add_task("runs", total=None)
        state = run_campaign(
            plan,
            Path(out),
            place,
            shard=share,
            report=lambda it: bar.update(task, completed=it.n_done, total=it.total),
            must_stop=stop,
        )
    if as_json:
        print_json(
            {"total": state.total, "done": state.n_done, "before": state.before, "runs": state.runs, "breaks": state.breaks}
        )
    else:
        lost = f"; workers or their scheduler were lost {state.breaks} times, and their batches ran again" if state.breaks else ""
        print_note(f"{out}: {state.n_done} of {state.total} runs are done, {state.runs} of them now{lost}")
    if stop() and state.n_done < state.total:
        print_note("stopped; the same command resumes")
        sys.exit(STOPPED)


def _stop_signals() -> Callable[[], bool]:
    """Return what tells whether SIGTERM or the first Ctrl-C has come: batches that run are finished."""
    wishes: list[int] = []

    def take(number: int, _frame: FrameType | None) -> None:
        wishes.append(number)
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)  # a second one ends at once

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, take)
    return lambda: bool(wishes)


def _bar(title: str) -> Progress:
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left:"),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console, disable=not console.is_terminal)


def _shard(text: str | None) -> tuple[int, int]:
    if text is None:
        return 1, 1
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise SettingError(f"--shard {text}: takes K/N, such as 3/10, with K from 1 to N")
    return int(match[1]), int(match[2])


@campaign.command("table")
@click.argument("folder", metavar="DIR")
@click.option(
    "--only",
    multiple=True,
    metavar="NAME=VALUE",
    help="Only scenarios with this value, such as turbulence.wind_speed=20, or NAME=LOW..HIGH; can be repeated.",
)
@click.option("--target", metavar="TARGET", help="Only errors of this target.")
@click.option("--mode", metavar="MODE", help="Only errors of this mode.")
@click.option("--together", is_flag=True, help="One row per observer over all scenarios, as the page of the dashboard has it.")
@click.option(
    "--csv", "as_csv", is_flag=True, help="Print all rows, sorted by key, without times and hosts; or --together as CSV."
)
@click.option("--parquet", metavar="FILE", help="Write all rows with their settings to one Parquet file.")
def print_table(
    folder: str, only: tuple[str, ...], target: str | None, mode: str | None, together: bool, as_csv: bool, parquet: str | None
) -> None:
    """Print the results of a campaign: errors over the seeds and paired differences from the best."""
    import pyarrow.compute as pc

    if together and parquet:
        raise SettingError("--parquet: takes all rows, not --together")
    if parquet:
        check_output(parquet)
        check_apart(Path(parquet), Path(folder))
    plan = folder_plan(Path(folder))
    if together:
        print_together(Path(folder), only, target, mode, as_csv)
        return
    rows = select_rows(plan, present_rows(plan, read_results(Path(folder))), only, target, mode)
    if parquet:
        import pyarrow.parquet as pq

        from wfsobs.files import write_whole

        write_whole(parquet, lambda file: pq.write_table(add_settings(plan, rows), file))
        return
    if as_csv:
        print_csv(plan, rows)
        return
    done = int(finished_runs(plan, Path(folder)).sum())
    show_table(summary_table(plan, rows, f"{plan.name}: {done} of {plan.n_runs} runs"))
    failed = rows.filter(pc.field("rms_nm").is_null()).group_by(["name", "note"]).aggregate([("key", "count_distinct")])
    for line in failure_lines({(it["name"], it["note"]): it["key_count_distinct"] for it in failed.to_pylist()}):
        print_note(f"without errors: {line}")


@campaign.command()
@click.argument("folder", metavar="DIR")
@click.option("--out", metavar="FILE", help="HTML file; by default report.html in DIR.")
def report(folder: str, out: str | None) -> None:
    """Write the results of a campaign as one HTML file: maps of winners, ranks, all comparisons."""
    from wfsobs.campaign.report import write_report

    path = Path(out) if out else Path(folder) / "report.html"
    check_output(str(path))
    check_apart(path, Path(folder))
    write_report(Path(folder), path)
    print_note(f"{path}: written")


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
        check_output(csv_file)
    print_note(f"{len(plan.cells)} scenarios x {seeds} seeds = {plan.n_runs} runs, about {plan.seconds:.2g} s")
    with progress_bar("runs") as watch:
        results = run_sweep(plan, watch)
    show_table(_winners(results))
    for cell, reason in results.failures.items():
        print_note(f"{_settings(results, cell)}: {reason}")
    if csv_file:
        write_text(csv_file, _csv(results.rows()))


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
