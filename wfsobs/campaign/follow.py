"""Follow a campaign while it runs: read what is new in its folder, and keep the errors as arrays."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from time import time

import numpy as np

from wfsobs.campaign.errors import CampaignErrors, can_win
from wfsobs.campaign.pace import BatchPace, WrittenBatch, measure_pace
from wfsobs.campaign.plan import Campaign
from wfsobs.campaign.state import folder_plan
from wfsobs.campaign.store import PLAN, batch_files, need_pyarrow, read_batch
from wfsobs.progress import QUIET, Watch
from wfsobs.settings.errors import SettingError
from wfsobs.typing import Array

COLUMNS = ("cell", "seed", "name", "target", "mode", "rms_nm", "apart", "written", "host", "process")


@dataclass(frozen=True)
class CampaignState:
    """What of a campaign is done, and with which errors.

    Attributes
    ----------
    plan : Campaign
        What is run.
    n_done, n_rows : int
        Runs that have a row of everything, and number of rows.
    pace : BatchPace
        How fast batches come.
    errors : mapping
        (target, mode) -> errors.
    failures : Mapping
        Observer or controller -> number of runs without an estimate in each scenario, (n_cells,).
    """

    plan: Campaign
    n_done: int
    n_rows: int
    pace: BatchPace
    errors: Mapping[tuple[str, str], CampaignErrors]
    failures: Mapping[str, Array]

    @property
    def seconds_left(self) -> float:
        """About how long the rest takes at the rate of the latest batches [s]; NaN where nothing comes."""
        return self.pace.seconds_left(self.plan.n_runs - self.n_done, time())

    @property
    def silence(self) -> float:
        """For how long no batch has come, if that is clearly longer than a batch has taken [s]; else 0."""
        return 0.0 if self.n_done == self.plan.n_runs else self.pace.silence(time())


class CampaignFolder:
    """The folder of a campaign, read only; files that have been read are not read again.

    Parameters
    ----------
    folder : Path
        Folder of the campaign.

    Raises
    ------
    SettingError
        It holds no campaign, or pyarrow is missing.
    """

    def __init__(self, folder: Path):
        need_pyarrow()
        self.folder = folder
        self._plan = folder_plan(folder)
        self._read_paths: set[Path] = set()
        self._codes: dict[str, int] = {}
        self._parts: list[Array] = []
        self._batches: list[WrittenBatch] = []
        self._state: CampaignState | None = None
        self._plan_time = 0
        self._lock = threading.Lock()

    def read(self, watch: Watch = QUIET) -> CampaignState:
        """Return what is known by now; the same object as long as there is nothing new. Raises SettingError, Cancelled."""
        with self._lock:
            try:
                plan_time = (self.folder / PLAN).stat().st_mtime_ns
            except OSError as error:
                raise SettingError(f"{self.folder / PLAN}: cannot be read: {error.strerror}") from None
            if plan_time != self._plan_time:  # it may have been given more seeds
                self._plan, self._plan_time, self._state = folder_plan(self.folder), plan_time, None
            fresh = [path for path in batch_files(self.folder) if path not in self._read_paths]
            for i, path in enumerate(fresh):
                watch.step(i / len(fresh))
                self._take(path)
            if self._state is None or fresh:
                self._state = self._build()
            return self._state

    def _take(self, path: Path) -> None:
        """Read one file; one that cannot be read is tried again the next time."""
        table = read_batch(path, COLUMNS)
        if table is None:
            return
        part = np.zeros(table.num_rows, dtype=ROW)
        for column in ("cell", "seed", "rms_nm", "apart"):
            part[column] = table[column].to_numpy()
        for column in ("name", "target", "mode"):
            encoded = table[column].combine_chunks().dictionary_encode()
            codes = np.array(
                [self._codes.setdefault(text, len(self._codes)) for text in encoded.dictionary.to_pylist()], dtype=int
            )
            part[column] = codes[encoded.indices.to_numpy()] if len(codes) else 0
        self._parts.append(part)
        self._read_paths.add(path)
        if len(part):
            written, host, process = (table[column][0].as_py() for column in ("written", "host", "process"))
            self._batches.append(WrittenBatch(written, (host, process), len(np.unique(part[["cell", "seed"]]))))

    def _build(self) -> CampaignState:
        plan, codes = self._plan, self._codes
        rows = np.concatenate([np.zeros(0, dtype=ROW), *self._parts])
        rows["seed"] -= plan.seeds.start
        rows = rows[(rows["cell"] < len(plan.cells)) & (rows["seed"] >= 0) & (rows["seed"] < len(plan.seeds))]
        self._parts = [rows.copy()]
        self._parts[0]["seed"] += plan.seeds.start
        texts = list(codes)
        errors, shape = {}, (len(plan.cells), len(plan.seeds))
        pairs = [(t, m) for t, m in np.unique(rows[["target", "mode"]]).tolist() if texts[t]]
        for target, mode in pairs:
            part = rows[(rows["target"] == target) & (rows["mode"] == mode)]
            errors[texts[target], texts[mode]] = _errors(part, texts, texts[target], shape)
        done = np.ones(shape, dtype=bool)
        failures = {}
        failed = rows[rows["target"] == codes.get("", -1)]
        for name in (*plan.observers, *plan.controllers):
            seen, of = np.zeros(shape, dtype=bool), rows[rows["name"] == codes.get(name, -1)]
            seen[of["cell"], of["seed"]] = True
            done &= seen
            lost = np.unique(failed[failed["name"] == codes.get(name, -1)][["cell", "seed"]])
            failures[name] = np.bincount(lost["cell"], minlength=shape[0])
        n_done = int(done.sum())
        pace = measure_pace(self._batches, 1e-9 * self._plan_time, time())
        for one in errors.values():
            _ = one.winners, one.bound  # here, not on the thread of a page
        return CampaignState(plan, n_done, len(rows), pace, errors, failures)


ROW = np.dtype(
    [("cell", "i4"), ("seed", "i8"), ("name", "i4"), ("target", "i4"), ("mode", "i4"), ("rms_nm", "f8"), ("apart", "?")]
)
"""One row, its texts as numbers."""


def _errors(rows: Array, texts: list[str], target: str, shape: tuple[int, int]) -> CampaignErrors:
    """Return the errors of the rows of one target and mode."""
    codes, column = np.unique(rows["name"], return_inverse=True)
    names = tuple(texts[code] for code in codes)
    values = np.full((*shape, len(names)), np.nan)
    values[rows["cell"], rows["seed"], column] = rows["rms_nm"]
    eligible = np.tile([can_win(name, target) for name in names], (shape[0], 1))
    eligible[rows["cell"][rows["apart"]], column[rows["apart"]]] = False
    return CampaignErrors(names, values, eligible)
