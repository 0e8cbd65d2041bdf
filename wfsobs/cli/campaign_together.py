"""Observers of a campaign over all scenarios together, in the terminal: the table of the dashboard's page."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Sequence
from dataclasses import astuple, fields
from pathlib import Path

from rich.table import Table

from wfsobs.campaign.follow import CampaignFolder
from wfsobs.campaign.standings import TogetherRow, standings
from wfsobs.cli.campaign_results import cells_of, check_known
from wfsobs.cli.show import show_table
from wfsobs.evaluation.rows import NOT_OBSERVERS

TEXTS = ("Target", "Mode", "Name")
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
        out.writerows([["" if _is_missing(value) else value for value in astuple(row)] for row in rows])
        return
    title = f"{state.plan.name}: {state.n_done} of {state.plan.n_runs} runs, {len(cells)} of {len(state.plan.cells)} scenarios"
    show_table(_table(rows, title))


def _table(rows: Sequence[TogetherRow], title: str) -> Table:
    out = Table(title=title, caption="wins: scenarios with the smallest error, and how many of them are significant")
    for name in (*TEXTS, *NUMBERS):
        out.add_column(name, justify="right" if name in NUMBERS else "left")
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
    return out


def _above(row: TogetherRow) -> str:
    if math.isnan(row.above):
        return ""
    around = "" if math.isnan(row.above_low) else f" ({100 * row.above_low:.1f} to {100 * row.above_high:.1f})"
    return f"{100 * row.above:.1f}{around}"


def _is_missing(value: object) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))
