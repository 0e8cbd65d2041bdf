"""What commands print: tables, errors against time, JSON, warnings, a progress bar."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from math import inf, isnan, sqrt
from statistics import median
from typing import Any

import click
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from wfsobs.evaluation.budget import TERMS, Budget
from wfsobs.evaluation.evidence import Evidence, seeds_interval
from wfsobs.evaluation.result import (
    NOT_OBSERVERS,
    TIME,
    Result,
    Row,
    above_bound,
    interval_text,
    is_non_causal,
    own_bound,
    own_interval,
    row_label,
    scored_interval,
)
from wfsobs.evaluation.scores import PREDICTION, RESIDUAL, SCORED, PooledRms, Recovery, recovery, running_rms
from wfsobs.evaluation.verdict import explain_harm, verdict
from wfsobs.observers.base import TARGETS
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError

MOST_TIMES = 8
"""Columns of times in a table."""


class OverTime:
    """Error against time of runs of one scenario that differ in their seeds.

    window : of the running rms [s];  rows : of every run, at the end of every window, the keys of `wfsobs run --over-time --json`
    """

    scenario: Scenario
    window: float

    def __init__(self, scenario: Scenario, window: float):
        if not scenario.dt <= window < scenario.run.duration:
            raise SettingError(
                f"--over-time {window:g}: takes a number of seconds from {scenario.dt:g}, one step, to below "
                f"run.duration = {scenario.run.duration:g}"
            )
        self.scenario, self.window = scenario, window
        self.rows: list[Row] = []
        self._pools: dict[tuple[str, str], PooledRms] = {}

    def add(self, result: Result, seed: int) -> None:
        """One more run."""
        every = max(round(self.window / result.record.dt), 1)
        for e in result.estimates:
            running = running_rms(result.record, e, self.window)
            self._pools.setdefault((e.observer, e.target), PooledRms()).add(running)
            for mode, column in zip(self.scenario.modes, running[every - 1 :: every].T, strict=False):
                self.rows += [
                    {
                        "observer": e.observer,
                        "target": e.target,
                        "mode": mode.name,
                        "time_s": round((i + 1) * every * result.record.dt, 9),
                        "rms_um": None if np.isnan(value) else float(value),
                        "seed": seed,
                    }
                    for i, value in enumerate(column)
                ]

    def table(self) -> Table:
        """Return the table of recoveries after events; without events, the error at some times."""
        return self._recoveries() if self.scenario.events else self._times()

    def _series(self) -> list[tuple[str, str, str, np.ndarray]]:
        """(target, mode, observer, pooled running rms (n_steps,)) in the order of targets and modes."""
        found = [
            (target, i, observer, pool.rms[:, i])
            for (observer, target), pool in self._pools.items()
            for i in range(pool.rms.shape[1])
        ]
        modes = self.scenario.modes
        return [(target, modes[i].name, observer, x) for target, i, observer, x in sorted(found, key=lambda f: f[:2])]

    def _title(self, text: str) -> str:
        seeds = len({r["seed"] for r in self.rows})
        return f"{text}, rms over {self.window:g} s" + (f", {seeds} seeds together" if seeds > 1 else "")

    def recoveries(self) -> Iterator[tuple[str, str, str, str, Recovery | None]]:
        """(target, mode, event, observer, what it did), of every event who is back first."""
        events, run = self.scenario.events, self.scenario.run
        starts = sorted({event.start for event in events})
        names = [", ".join(dict.fromkeys(e.kind for e in events if e.start == start)) + f" at {start:g} s" for start in starts]
        for (target, mode), group in groupby(self._series(), key=lambda s: s[:2]):
            known = {name: recovery(x, self.scenario.dt, starts, self.window, run.warm_up) for _, _, name, x in group}
            for i, event in enumerate(names):
                for name in sorted(known, key=lambda name: _rank(known[name][i])):
                    yield target, mode, event, name, known[name][i]

    def _recoveries(self) -> Table:
        """One row per event and observer."""
        table = new_table(
            ("Target", "Mode", "Event", "Observer"),
            ("before, nm", "worst after, nm", "at the end, nm", "recovery time, s"),
            title=self._title("Error before and after every event"),
        )
        for _, lines in groupby(self.recoveries(), key=lambda line: line[:3]):
            for target, mode, event, name, r in lines:
                table.add_row(target, mode, event, row_label(name), *recovery_texts(r))
            table.add_section()
        return table

    def _times(self) -> Table:
        """One row per observer, one column per time."""
        ends = _spread(round(self.scenario.run.duration / self.window + 1e-9))
        times = [f"{end * self.window:g} s" for end in ends]
        table = new_table(("Target", "Mode", "Observer"), times, title=self._title("Error, nm"))
        every = max(round(self.window / self.scenario.dt), 1)
        for _, group in groupby(self._series(), key=lambda s: s[:2]):
            for target, mode, observer, x in group:
                values = [x[min(end * every, x.size) - 1] for end in ends]
                table.add_row(target, mode, row_label(observer), *("-" if np.isnan(v) else f"{v * 1e3:.2f}" for v in values))
            table.add_section()
        return table


def recovery_texts(r: Recovery | None) -> tuple[str, str, str, str]:
    """Error before, at its worst and at the end [nm], and the recovery time [s], as texts."""
    if r is None:
        return "-", "-", "-", "-"
    before, worst, last = (f"{value * 1e3:.2f}" for value in (r.before, r.worst, r.last))
    return before, worst, last, "never" if r.back is None else f"{r.back:.2f}"


def _rank(r: Recovery | None) -> tuple[float, float]:
    """Sort by the recovery time, then by the error."""
    return (inf, inf) if r is None else (inf if r.back is None else r.back, r.worst)


def _spread(n: int) -> Sequence[int]:
    """Up to MOST_TIMES of 1 ... n, evenly, the last one among them."""
    return sorted({round(float(v)) for v in np.linspace(1, n, min(n, MOST_TIMES))})


def score_table(rows: Sequence[Row]) -> Table:
    """Return the RMS table, of errors or, without truth, of predictions.

    Errors are means over the seeds, with their intervals at 95 % confidence, all else medians. The bound of the LGS has the
    interval of an optimal observer's error in 95 % of records, and observers may state their standard deviation. The caption
    gives the interval of the scored samples.
    """
    several = len({r["seed"] for r in rows}) > 1
    unknown = any(r["target"] == RESIDUAL for r in rows)
    title, base = ("Error of the next measurement, and residual,", "z") if unknown else ("RMS error", "truth")
    groups = grouped_rows(rows, "target", "mode", "observer")
    bounds = {key: same[-1]["rms_um"] for key, same in groups.items() if key[2] in NOT_OBSERVERS}
    bounded = ("to limit",) if any(own_bound(r["observer"]) in {name for *_, name in bounds} for r in rows) else ()
    stated = ("sigma, nm",) if any(r["sd_um"] for r in rows) else ()
    numbers = ("error, nm", "95 %, nm", *bounded, *stated, f"{base}, nm", f"error / {base}", "lag, ms", "us / step")
    table = new_table(
        ("Target", "Mode", "Observer", "Prior knowledge"),
        numbers,
        title=f"{title} after warm-up" + (", mean over seeds" if several else ""),
        caption=_caption(rows),
    )
    targets, modes = (*SCORED, PREDICTION, RESIDUAL), list(dict.fromkeys(r["mode"] for r in rows))

    def place(group: tuple[tuple[str, ...], list[Row]]) -> tuple:
        """Turbulence, vibration, then both together; modes as they come, best observer first, those that stand apart last."""
        (target, mode, _), same = group
        return targets.index(target), modes.index(mode), any(r["apart"] for r in same), _mean_and_interval(same)[0]

    last = None
    for (target, mode, observer), same in sorted(groups.items(), key=place):
        error, interval = _mean_and_interval(same)
        above = above_bound(error, interval, bounds.get((target, mode, own_bound(observer) or "")))
        if last != (target, mode):
            table.add_section()
        last = (target, mode)
        table.add_row(
            target,
            mode,
            row_label(observer)
            + (" (looks ahead)" if is_non_causal(observer) else "")
            + (f" ({own_interval(own[0])})" if (own := [r for r in same if r["apart"]]) else ""),
            same[0]["needs"],
            f"{error * 1e3:.2f}",
            interval_text(error, interval, 1e3),
            *(
                ("-" if above is None else "?" if isnan(above) else f"{100.0 * above:+.0f} %" if above else "at",)
                if bounded
                else ()
            ),
            *((median_text(same, "sd_um", 2, 1e3),) if stated else ()),
            f"{median(r['truth_rms_um'] for r in same) * 1e3:.2f}",
            median_text(same, "normalised_rms", 3),
            median_text(same, "lag_s", 2, 1e3),
            median_text(same, TIME, 2),
        )
    return table


def grouped_rows(rows: Sequence[Row], *keys: str) -> dict[tuple[str, ...], list[Row]]:
    """Return rows by the values of some of their keys, in the order in which these come."""
    out: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        out.setdefault(tuple(row[key] for key in keys), []).append(row)
    return out


def _mean_and_interval(same: Sequence[Row]) -> tuple[float, Sequence[float] | None]:
    """Return the mean error over the seeds and its interval [um]; of one seed, or of a bound, those of the row."""
    errors = np.array([r["rms_um"] for r in same])
    alone = errors.size == 1 or same[0]["observer"] in NOT_OBSERVERS
    return float(errors.mean()), same[0]["interval_um"] if alone else seeds_interval(errors)


def _caption(rows: Sequence[Row]) -> str:
    """Return the interval of the scored samples, target by target where they differ."""
    found = {target: scored_interval(same) for (target,), same in grouped_rows(rows, "target").items()}
    spans = {span for span in found.values() if span}
    if len(spans) > 1:
        return "Scored: " + "; ".join(f"{target} {span}" for target, span in found.items() if span)
    return f"Scored: {spans.pop()}" if spans else ""


def median_text(same: Sequence[Row], key: str, digits: int, scale: float = 1.0) -> str:
    """Write the median of a number over the rows that have it; "-" where none has."""
    values = [r[key] * scale for r in same if r[key] is not None]
    return f"{median(values):.{digits}f}" if values else "-"


def budget_table(budgets: Sequence[Budget]) -> Table:
    """Return the table of terms, their shares of the total, and the bound; the smallest error of a target and mode first."""
    missing = dict.fromkeys((row_label(b.observer), b.reason) for b in budgets if b.reason)
    out = new_table(
        ("Target", "Mode", "Observer"),
        title="Error budget: parts of the mean square error, nm^2, and their shares",
        caption="; ".join(f"{label}: none, {reason}" for label, reason in missing),
    )
    for name in ("error, nm", "nm^2", *TERMS.values(), "limit, nm^2"):
        out.add_column(name, justify="right")
    last, modes = None, list(dict.fromkeys(b.mode for b in budgets))
    for it in sorted((b for b in budgets if b.terms), key=lambda b: (SCORED.index(b.target), modes.index(b.mode), b.total)):
        if last != (it.target, it.mode):
            out.add_section()
        last = (it.target, it.mode)
        parts = [(round(it.terms[name] * 1e6, 1) + 0.0, it.shares[name]) for name in TERMS]  # zero without a sign
        cells = (f"{part:.1f} {round(100.0 * share):4d} %" for part, share in parts)
        bound = "-" if it.bound is None else f"{it.bound * 1e6:.1f}"
        out.add_row(*last, row_label(it.observer), f"{sqrt(it.total) * 1e3:.2f}", f"{it.total * 1e6:.1f}", *cells, bound)
    return out


def show(all_rows: list[Row], as_json: bool) -> None:
    """Print rows to standard output, as JSON or as a table."""
    if as_json:
        print_json([{k: v for k, v in row.items() if k != TIME} for row in all_rows])
    else:
        show_table(score_table(all_rows))


def new_table(texts: Sequence[str], numbers: Sequence[str] = (), *, no_wrap: bool = True, **options: Any) -> Table:
    """Return a table without rows: columns of texts, then of numbers at the right; options : those of rich."""
    out = Table(**options)
    for name in (*texts, *numbers):
        out.add_column(name, justify="right" if name in numbers else "left", no_wrap=no_wrap)
    return out


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
    more = {"simulation": simulation, "budgets": known, "evidence": evidence, "source": result.prior_source}
    found = (verdict(*given, *key, **more) for key in of)
    for it in found:
        if it is not None:
            click.echo("\n" + "\n".join(f"{'  ' * bool(i)}{line}" for i, line in enumerate(it.sentences())))


def print_note(line: str) -> None:
    """Print a line for the user on standard error."""
    click.echo(f"wfsobs: {line}", err=True)


def print_json(value: Any) -> None:
    """Print a value as JSON, which has no NaN."""
    click.echo(json.dumps(value, allow_nan=False))


def warn(result: Result) -> None:
    """Say which observers were left out, and why."""
    for failure in result.failures:
        print_note(failure.reason)


@contextmanager
def progress_bar(what: str = "observers") -> Iterator[Watch]:
    """Show a progress bar on standard error where that is a terminal; yield the watch that moves it."""
    console = Console(stderr=True)
    columns = (TextColumn(what), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("", total=1.0)
        yield Watch(progress=lambda fraction: progress.update(task, completed=fraction))
