"""What of a campaign is done: one bit for each run."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from pathlib import Path

import numpy as np

from wfsobs.campaign.keys import row_key, scenario_digest
from wfsobs.campaign.plan import Campaign
from wfsobs.campaign.store import PLAN, ROWS, read_batches
from wfsobs.files import write_whole
from wfsobs.settings.errors import SettingError
from wfsobs.typing import Array

LEFTOVER = 3600.0
"""Age of a temporary file that nobody writes any more [s]; to write a batch takes milliseconds."""

TEMPORARY = re.compile(r"\.(plan\.json|[0-9a-f]{32}\.parquet)\..+")
"""Names of the temporary files of `wfsobs.files.write_whole`, for the files of this folder."""


def open_folder(plan: Campaign, folder: Path) -> None:
    """Make the folder of a campaign, or check that it is that of this plan.

    Parameters
    ----------
    plan : Campaign
        What is to run.
    folder : Path
        Folder; the same plan with more seeds continues what is there.

    Raises
    ------
    SettingError
        The folder holds the results of another plan.
    OSError
        It cannot be written.
    """
    (folder / ROWS).mkdir(parents=True, exist_ok=True)
    known = folder / PLAN
    if known.exists() and folder_plan(folder).identity() != plan.identity():
        raise SettingError(f"{folder}: holds another campaign; the plan may differ in its number of seeds alone")
    write_whole(known, lambda file: file.write(json.dumps(plan.to_dict()).encode()))


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of workers that were killed while they wrote.

    Those are at least LEFTOVER older than the plan, which has just been written: times of one file system are compared, not those
    of two machines.
    """
    now = (folder / PLAN).stat().st_mtime
    for place in (folder, folder / ROWS):
        for path in place.glob(".*"):
            with suppress(FileNotFoundError):  # another share was faster
                if TEMPORARY.fullmatch(path.name) and now - path.stat().st_mtime > LEFTOVER:
                    path.unlink()


def folder_plan(folder: Path) -> Campaign:
    """Return the plan of a folder. Raises SettingError."""
    if not (folder / PLAN).is_file():
        raise SettingError(f"{folder}: holds no campaign ({PLAN} is missing)")
    try:
        return Campaign.from_dict(json.loads((folder / PLAN).read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError):
        raise SettingError(f"{folder / PLAN}: is not the plan of a campaign") from None


def finished_runs(plan: Campaign, folder: Path) -> Array:
    """Return which runs have all their rows, bool (n_cells, n_seeds).

    A row counts if its key is that of the present settings and versions.
    """
    names = (*plan.observers, *plan.controllers)
    seen = np.zeros((len(plan.cells), len(plan.seeds), len(names)), dtype=bool)
    digests: dict[int, str] = {}
    for table in read_batches(folder, ("key", "cell", "seed", "name")):
        for key, cell, seed, name in zip(*(table[c].to_pylist() for c in ("key", "cell", "seed", "name")), strict=True):
            if cell >= len(plan.cells) or seed not in plan.seeds or name not in names:
                continue
            if key == row_key(_digest(plan, cell, digests), seed, name):
                seen[cell, plan.seeds.index(seed), names.index(name)] = True
    return np.all(seen, axis=2)


def _digest(plan: Campaign, cell: int, digests: dict[int, str]) -> str:
    if cell not in digests:
        try:
            digests[cell] = scenario_digest(plan.cells[cell].scenario())
        except SettingError:  # its failures have keys of their own
            digests[cell] = repr(plan.cells[cell].changes)
    return digests[cell]
