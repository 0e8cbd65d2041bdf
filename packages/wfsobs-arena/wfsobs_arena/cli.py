"""`wfsobs arena`: observers and controllers under the same rules on the same records."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
from rich.table import Table

from wfsobs.cli.show import show_table
from wfsobs.settings.values import SettingError
from wfsobs.telemetry.records import save_arrays
from wfsobs_arena.definition import Arena, add_records, load_arena
from wfsobs_arena.entries import find_entries
from wfsobs_arena.results import tables, write_results
from wfsobs_arena.run import cases_of, run_arena
from wfsobs_arena.tracks import TRACKS

TRACK = click.option(
    "--track", "tracks", multiple=True, metavar="TRACK", help=f"Only this track, of {', '.join(TRACKS)}; repeat it."
)
SEEDS = click.option(
    "--seeds", type=click.IntRange(1, 1000), default=None, metavar="N", help="Only the first N records of a scenario."
)
QUICK = click.option(
    "--quick", is_flag=True, help="One short scenario per track and two seeds: a trial, whose scores are not meaningful."
)


@click.group()
def arena() -> None:
    """Rank observers and controllers under the same rules on the same records (docs/arena.md)."""


@arena.command("list")
@QUICK
@SEEDS
def print_list(quick: bool, seeds: int | None) -> None:
    """List the scenarios, and the SHA-256 of their first record."""
    found = load_arena(seeds=seeds, quick=quick)
    table = Table(title=f"Arena {found.version}: {found.digest[:16]}")
    for name in ("Track", "Scenario", "Records", "Over the", "First record", ""):
        table.add_column(name)
    for case in found.cases:
        row = case.track, case.name, str(len(case.seeds)), case.reference, case.record_id(case.seeds[0])[:16], case.help
        table.add_row(*row)
    show_table(table)


@arena.command()
@click.option("--out", required=True, metavar="DIR", help="Folder of the results; the same command again resumes.")
@click.option(
    "--entry",
    "entries",
    multiple=True,
    metavar="ENTRY",
    help="Only this: an id, MODULE:NAME or a folder of estimates; repeat it.",
)
@click.option("--record", "files", multiple=True, metavar="FILE", help="Telemetry for the track next; repeat it.")
@TRACK
@SEEDS
@QUICK
def run(
    out: str, entries: tuple[str, ...], files: tuple[str, ...], tracks: tuple[str, ...], seeds: int | None, quick: bool
) -> None:
    """Run what is missing, and write results.json and index.html; tables of other tracks that are there stay."""
    whole, entrants = load_arena(seeds=seeds, quick=quick), find_entries(entries)
    found = _select_tracks(add_records(whole, [Path(file) for file in files]), tracks)
    idle = [entry.id for entry in entrants if not cases_of(found, entry)]
    if idle and (entries or len(idle) == len(entrants)):
        names = ", ".join(idle) if entries else "every entry"
        raise SettingError(f"arena run: in no track that is chosen: {names}; next takes records by --record")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    outcomes = run_arena(found, entrants, folder, tell=lambda line: click.echo(f"wfsobs: {line}", err=True))
    values = tables(found, outcomes)
    values["digest"] = whole.digest  # whatever tracks are chosen: they share a page
    write_results(values, folder)
    for track in values["tracks"]:
        show_table(_table(track))
    for one in values["refused"]:
        click.echo(f"{one['entry']}: refused: {one['reason']}")
    click.echo(f"wfsobs: {folder / 'index.html'}: written", err=True)


@arena.command()
@click.option("--out", required=True, metavar="DIR", help="Folder of the records.")
@TRACK
@SEEDS
@QUICK
def records(out: str, tracks: tuple[str, ...], seeds: int | None, quick: bool) -> None:
    """Write the measurements of the records, RECORD.npz, for entries by a folder of estimates."""
    cases = _select_tracks(load_arena(seeds=seeds, quick=quick), tracks).cases
    asked = [case for case in cases if not TRACKS[case.track].is_loop]
    if not asked:
        raise SettingError(f"arena records: there are none of {', '.join(tracks)}: no folder of estimates takes part there")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    for case in asked:
        for seed in case.seeds:
            seen = vars(case.record(seed).measurements()).items()
            known = {name: np.asarray(value) for name, value in seen if value is not None}
            named = {"track": np.array(case.track), "scenario": np.array(case.name), "unit": np.array("um")}
            save_arrays(folder / f"{case.record_id(seed)}.npz", known | named)


def _select_tracks(whole: Arena, tracks: tuple[str, ...]) -> Arena:
    """Return the arena with these tracks alone, all where there are none. Raises SettingError."""
    for name in tracks:
        if name not in TRACKS:
            raise SettingError(f"--track {name}: takes {', '.join(TRACKS)}")
    cases = tuple(case for case in whole.cases if not tracks or case.track in tracks)
    return Arena(whole.version, cases, whole.rules)


def _table(track: dict) -> Table:
    """Return the rows of a track for the terminal."""
    table = Table(title=f"{track['label']}: {track['help']}", caption="~: tied; scenarios: error over the reference")
    for name in ("Rank", "Entry", "Score", "95 %", *(one["name"] for one in track["scenarios"]), "us", "Prior knowledge"):
        table.add_column(name, justify="left" if name in ("Entry", "Prior knowledge") else "right")
    for row in track["rows"]:
        between = "" if row["interval"] is None else f"{row['interval'][0]:.3f} to {row['interval'][1]:.3f}"
        time = "" if row["microseconds"] is None else f"{row['microseconds']:.3g}"
        failed = f" ({row['failures']} of {row['runs']} without an answer: {row['reason']})" if row["failures"] else ""
        ratios = [f"{ratio:.3f}" for ratio in row["ratios"]]
        name = f"{row['entry']}{failed}"
        table.add_row(
            f"{'~' if row['is_tie'] else ''}{row['rank']}", name, f"{row['score']:.3f}", between, *ratios, time, row["told"]
        )
    return table
