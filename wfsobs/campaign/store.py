"""Results of a campaign: a folder with the plan and one Parquet file per batch, by keys of all that a result depends on."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import sys
import uuid
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wfsobs.campaign.plan import Campaign
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.result import NOT_OBSERVERS
from wfsobs.files import write_text, write_whole
from wfsobs.observers import OBSERVERS
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError
from wfsobs.typing import Array
from wfsobs.version import __version__

if TYPE_CHECKING:
    import pyarrow

PHYSICS_VERSION = 6
"""Number of the simulation and its numerics: rises with every change that moves results (tests/campaign/test_physics.py)."""


def scenario_digest(scenario: Scenario) -> str:
    """Return a digest of the settings but for the seed, and of the version of the physics."""
    settings = scenario.to_dict()
    settings["run"] = {k: v for k, v in settings["run"].items() if k != "seed"}
    return hashlib.sha256(json.dumps([PHYSICS_VERSION, settings], sort_keys=True).encode()).hexdigest()


def row_key(digest: str, seed: int, name: str) -> str:
    """Return the key of the rows of one observer, controller or bound, on one record.

    Parameters
    ----------
    digest : str
        That of the scenario.
    seed : int
        Seed of the record.
    name : str
        Id of the observer or controller.

    Returns
    -------
    str
        SHA-256, in hexadecimal.
    """
    return hashlib.sha256(f"{digest} {seed} {name} {package_version(name)}".encode()).hexdigest()


UNKNOWN = "not installed"
"""In place of the version of an observer or a controller of another package."""


@cache
def package_version(name: str) -> str:
    """Return the package of an observer or a controller and its version; that of wfsobs for bounds, or UNKNOWN.

    >>> package_version("kf-lgs").split()[0]
    'wfsobs'
    """
    if name in NOT_OBSERVERS:
        return f"wfsobs {__version__}"
    entry, controller = OBSERVERS.get(name), CONTROLLERS.get(name)
    if entry is None and controller is None:
        return UNKNOWN
    function = entry.run if entry is not None else controller and (controller.law or controller.step_law)
    home = getattr(function, "__module__", "wfsobs").partition(".")[0]
    package = sys.modules.get(home)
    return f"{home} {getattr(package, '__version__', None) or _distribution_version(home)}"


def _distribution_version(home: str) -> str:
    """Return the version of the installed distribution that has this module; "0" for a script."""
    from importlib.metadata import packages_distributions, version

    names = packages_distributions().get(home, [])
    return version(names[0]) if names else "0"


PLAN = "plan.json"
ROWS = "rows"
"""Folder of the batches."""

RESULTS = {
    "key": "string",
    "cell": "int32",
    "scenario": "string",
    "seed": "int64",
    "name": "string",
    "target": "string",
    "mode": "string",
    "rms_nm": "float64",
    "truth_rms_nm": "float64",
    "start_s": "float64",
    "apart": "bool",
    "note": "string",
}
"""Columns that settings and seed determine."""

PROVENANCE = {"step_us": "float64", "kernel": "string", "host": "string", "process": "int64", "written": "float64"}
"""Columns that say where and how a row was made."""

COMPLETE = frozenset(("key", "cell", "seed", "name"))
"""Columns without nulls."""

ORDER = ("key", "cell", "target", "mode")
"""Two scenarios of one plan may have the same settings, and then have the same keys."""


def need_pyarrow() -> None:
    """Raise SettingError where pyarrow is not installed."""
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise SettingError('campaigns need pyarrow: pip install "wfsobs[campaign]"') from None


def schema() -> pyarrow.Schema:
    """Return the columns of a file."""
    import pyarrow as pa

    return pa.schema([(name, pa.type_for_alias(kind)) for name, kind in {**RESULTS, **PROVENANCE}.items()])


def write_batch(folder: Path, rows: Sequence[Mapping[str, Any]], provenance: Mapping[str, Any]) -> None:
    """Write the rows of a batch to a file of their own: all or none of them. Raises OSError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.Table.from_pylist([{**row, **provenance} for row in rows], schema=schema())
    path = folder / ROWS / f"{uuid.uuid4().hex}.parquet"

    def write(file: Any) -> None:
        pq.write_table(table, file, compression="zstd")
        file.flush()
        os.fsync(file.fileno())

    write_whole(path, write)


def check_apart(path: Path, folder: Path) -> None:
    """Raise OSError where a file to write would stand among those that a campaign keeps."""
    real = path.resolve()
    if real == (folder / PLAN).resolve() or real.parent == (folder / ROWS).resolve():
        raise OSError(errno.EEXIST, "belongs to the campaign; write to another", str(path))


def batch_files(folder: Path) -> list[Path]:
    """Return the files of all batches."""
    return sorted((folder / ROWS).glob("[!.]*.parquet"))


def read_batch(path: Path, columns: Collection[str]) -> pyarrow.Table | None:
    """Return the rows of one file; None where it cannot be read, or is none of a batch."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns, wanted = list(columns), schema()
    try:
        file = pq.ParquetFile(path)
        if not RESULTS.keys() <= {*file.schema_arrow.names}:
            return None
        table = file.read(columns=columns).select(columns).cast(pa.schema([wanted.field(name) for name in columns]))
    except (OSError, pa.ArrowException, KeyError):
        return None
    return None if any(table[name].null_count for name in COMPLETE.intersection(columns)) else table


def read_batches(folder: Path, columns: Collection[str]) -> Iterator[pyarrow.Table]:
    """Yield the rows of one file after the other; one that cannot be read is left out."""
    for path in batch_files(folder):
        if (table := read_batch(path, columns)) is not None:
            yield table


def read_results(folder: Path) -> pyarrow.Table:
    """Return all rows without PROVENANCE, each once, sorted by key, scenario, target and mode.

    Rows that were computed twice (by a worker that was taken for dead) have one key, and the first counts.
    """
    return _each_once(list(read_batches(folder, RESULTS)), list(RESULTS))


def _each_once(tables: Sequence[pyarrow.Table], columns: Sequence[str]) -> pyarrow.Table:
    """Return the rows of tables, each once, sorted."""
    import pyarrow as pa

    if not tables:
        return pa.schema([f for f in schema() if f.name in columns]).empty_table()
    table = pa.concat_tables(tables).sort_by([(name, "ascending") for name in ORDER])
    keys = [table[name].to_numpy() for name in ORDER]
    again = np.logical_and.reduce([k[1:] == k[:-1] for k in keys])
    return table.filter(pa.array(np.concatenate([[True], ~again])))


def present_rows(plan: Campaign, table: pyarrow.Table) -> pyarrow.Table:
    """Return the rows of a plan's own seeds, without those of earlier settings or versions where there are present ones."""
    import pyarrow.compute as pc

    table = table.filter(pc.field("seed").isin([*plan.seeds]) & (pc.field("cell") < len(plan.cells)))
    run = ["cell", "seed", "name"]
    keys_of = table.group_by(run).aggregate([("key", "distinct"), ("key", "count_distinct")])
    several = keys_of.filter(pc.field("key_count_distinct") > 1)
    digests, stale = dict[int, str](), set[str]()
    for cell, seed, name, keys in zip(*(several[c].to_pylist() for c in (*run, "key_distinct")), strict=True):
        present = row_key(_digest(plan, cell, digests), seed, name)
        stale |= {*keys} - {present if present in keys else min(keys)}
    return table.filter(~pc.field("key").isin(sorted(stale))) if stale else table


class BatchIndex:
    """Which files have rows of which scenarios: what is asked of some of them is read without the others.

    Parameters
    ----------
    folder : Path
        Folder of the campaign.

    Attributes
    ----------
    n_rows : int
        Number of rows, those computed twice included.
    """

    n_rows: Any

    COLUMNS = ("key", "cell", "scenario", "seed", "name", "target", "mode", "rms_nm", "apart")

    def __init__(self, folder: Path):
        import pyarrow as pa
        import pyarrow.parquet as pq

        self.n_rows = 0
        self._spans: list[tuple[Path, int, int]] = []
        for path in batch_files(folder):
            try:
                known = pq.read_metadata(path)
                column = known.schema.names.index("cell")
                of_groups = [known.row_group(i).column(column).statistics for i in range(known.num_row_groups)]
                span = int(min(s.min for s in of_groups)), int(max(s.max for s in of_groups))
            except (OSError, pa.ArrowException, ValueError, TypeError, AttributeError):  # no rows, or as in `read_batch`
                continue
            self._spans.append((path, *span))
            self.n_rows += known.num_rows

    def read(self, cells: range) -> pyarrow.Table:
        """Return the rows of some scenarios, each once, with COLUMNS, sorted as in `read_results`."""
        import pyarrow.compute as pc

        tables: list[pyarrow.Table] = []
        for path, low, high in self._spans:
            if high >= cells.start and low < cells.stop and (table := read_batch(path, self.COLUMNS)) is not None:
                tables.append(table.filter((pc.field("cell") >= cells.start) & (pc.field("cell") < cells.stop)))
        return _each_once(tables, self.COLUMNS)


def add_settings(plan: Campaign, table: pyarrow.Table) -> pyarrow.Table:
    """Return the rows with a column for each setting that the scenarios differ in."""
    cells = table["cell"].to_pylist()
    for path in plan.axes:
        table = table.append_column(path, [[plan.cells[cell].changes.get(path) for cell in cells]])
    return table


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
    write_text(known, json.dumps(plan.to_dict()))


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
    except (ValueError, KeyError, TypeError, AttributeError):
        raise SettingError(f"{folder / PLAN}: is not the plan of a campaign") from None


def finished_runs(plan: Campaign, folder: Path) -> Array:
    """Return which runs have all their rows, bool (n_cells, n_seeds).

    A row counts if its key is that of the present settings and versions; of what is not installed every row does.
    """
    names = (*plan.observers, *plan.controllers)
    seen = np.zeros((len(plan.cells), len(plan.seeds), len(names)), dtype=bool)
    digests: dict[int, str] = {}
    for table in read_batches(folder, ("key", "cell", "seed", "name")):
        for key, cell, seed, name in zip(*(table[c].to_pylist() for c in ("key", "cell", "seed", "name")), strict=True):
            if cell >= len(plan.cells) or seed not in plan.seeds or name not in names:
                continue
            if package_version(name) == UNKNOWN or key == row_key(_digest(plan, cell, digests), seed, name):
                seen[cell, plan.seeds.index(seed), names.index(name)] = True
    return np.all(seen, axis=2)


def _digest(plan: Campaign, cell: int, digests: dict[int, str]) -> str:
    if cell not in digests:
        try:
            digests[cell] = scenario_digest(plan.cells[cell].scenario())
        except SettingError:  # its failures have keys of their own
            digests[cell] = repr(plan.cells[cell].changes)
    return digests[cell]
