"""Results of a campaign in the terminal: all rows, or errors over the seeds and paired differences from the best."""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from rich.table import Table

from wfsobs.campaign.compare import QUANTILES, compare
from wfsobs.campaign.plan import Campaign
from wfsobs.campaign.selection import cells_where
from wfsobs.campaign.store import RESULTS
from wfsobs.evaluation.rows import NOT_OBSERVERS
from wfsobs.settings.errors import SettingError

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
            out.writerow([_text(row[c]) for c in columns] + [_text(changes.get(path)) for path in axes])


def _text(value: object) -> object:
    return "" if value is None else repr(value) if isinstance(value, float) else value


def summary_table(plan: Campaign, rows: object, title: str) -> Table:
    """Return a table with one row per scenario, target, mode and observer."""
    out = Table(title=title, caption="+-: interval of 95 % of the paired difference from the best; ~: not significant")
    texts, numbers = ("Scenario", "Settings", "Target", "Mode", "Name"), ("rms, nm", SPREAD, "above the best, nm", "seeds")
    for name in (*texts, *numbers):
        out.add_column(name, justify="right" if name in numbers else "left")
    before = None
    for one in compare(rows):
        key = (one.cell, one.target, one.mode)
        settings = ", ".join(f"{path.split('.')[-1]} = {value}" for path, value in plan.cells[one.cell].changes.items())
        new = key != before
        above = (
            ""
            if one.difference is None
            else f"{'~' if one.is_tie else ''}{one.difference:.2f}"
            + (f" +- {one.half_width:.2f}" if one.half_width is not None else "")
        )
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
