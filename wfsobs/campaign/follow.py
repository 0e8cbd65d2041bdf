"""A campaign while it runs: what is new in its folder, its errors as arrays and as a table, and how far it is."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import time
from typing import NamedTuple

import numpy as np

from wfsobs.campaign.compare import ROW, CampaignErrors, CampaignPlace, coded_rows, gather_errors
from wfsobs.campaign.plan import Campaign
from wfsobs.campaign.store import PLAN, batch_files, folder_plan, need_pyarrow, read_batch
from wfsobs.progress import QUIET, Watch
from wfsobs.settings.values import SettingError
from wfsobs.typing import Array

LATEST = 20
"""Batches by which the time left is estimated."""
TIMES = 3.0
"""How much longer than the longest batch a silence has to be to say something."""
LEAST = 10.0
"""The shortest silence that says something [s]: batches are made to take 3 s, and starting processes takes some."""
UNKNOWN = 300.0
"""The shortest one where it is not known what a batch takes [s]."""


class WrittenBatch(NamedTuple):
    """A batch: when it was written [s since 1970], host and process that did so, and its number of runs."""

    time: float
    worker: tuple[str, int]
    n_runs: int


@dataclass(frozen=True)
class BatchPace:
    """What is known of the pace.

    Attributes
    ----------
    last : float
        When the last batch was written, or the campaign was started after that [s since 1970]; NaN before the first batch.
    patience : float
        Silence that is clearly longer than what a batch has taken so far [s].
    seconds_per_run : float
        By the latest batches [s]; NaN where not known.
    """

    last: float
    patience: float
    seconds_per_run: float

    def silence(self, now: float) -> float:
        """Return for how long no batch has come, if that is clearly longer than a batch has taken [s]; else 0."""
        return now - self.last if now - self.last > self.patience else 0.0

    def seconds_left(self, n_runs: int, now: float) -> float:
        """Return about how long so many runs take [s]; NaN where not known, or where nothing comes."""
        return np.nan if self.silence(now) else n_runs * self.seconds_per_run


def measure_pace(batches: Iterable[WrittenBatch], start: float, now: float) -> BatchPace:
    """Measure the pace by the times at which batches were written.

    What a batch takes is the time since the one before of the same process, of the first one that since the start. After a
    silence that says something the rate is measured anew.

    Parameters
    ----------
    batches : iterable of WrittenBatch
        All that are known.
    start : float
        When the campaign was started the last time [s since 1970]; left out where it is later than now, by another clock.
    now : float
        The time [s since 1970].
    """
    longest, last, before = 0.0, np.nan, dict[tuple[str, int], float]()
    stretch: list[WrittenBatch] = []
    for batch in sorted(batches):
        if batch.time - last > _patience(longest):
            stretch, before = [], {}
        if batch.worker in before:
            longest = max(longest, batch.time - before[batch.worker])
        elif not last >= start and start <= batch.time:
            longest = max(longest, batch.time - start)
        stretch.append(batch)
        before[batch.worker] = last = batch.time
    latest, per_run = stretch[-LATEST:], np.nan
    if len(latest) > 1 and latest[-1].time > latest[0].time:
        per_run = (latest[-1].time - latest[0].time) / sum(batch.n_runs for batch in latest[1:])
    return BatchPace(max(last, start) if last < start <= now else last, _patience(longest), per_run)


def _patience(longest: float) -> float:
    return max(LEAST, TIMES * longest) if longest else UNKNOWN


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


def progress_text(state: CampaignState) -> str:
    """Say how far a campaign is, and when it will be done or that nothing comes any more."""
    plan, silence, left = state.plan, state.silence, state.seconds_left
    said = f"{plan.name}: {state.n_done} of {plan.n_runs} runs, {len(plan.cells)} scenarios, {state.n_rows} rows"
    if state.n_done == plan.n_runs:
        return f"{said}, finished"
    if silence:
        ended = "ended, stopped" if plan.stop else "stopped"  # it may need no more seeds
        return f"{said}; no new batch for {_span(silence)}: {ended}, or slower than before"
    return f"{said}, about {_span(left)} left" if np.isfinite(left) else said


def _span(seconds: float) -> str:
    """Write a time for people.

    >>> _span(40), _span(600), _span(9000), _span(1e6)
    ('40 s', '10 min', '2.5 h', '12 days')
    """
    if seconds < 5400:
        return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 48 * 3600 else f"{seconds / 86400:.0f} days"


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
            fresh.sort(key=lambda path: path.stat().st_mtime)  # of rows of two versions the newer ones count
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
        part = coded_rows(table, self._codes)
        self._parts.append(part)
        self._read_paths.add(path)
        if len(part):
            written, host, process = (table[column][0].as_py() for column in ("written", "host", "process"))
            self._batches.append(WrittenBatch(written, (host, process), len(np.unique(part[["cell", "seed"]]))))

    def _build(self) -> CampaignState:
        plan, codes = self._plan, self._codes
        rows = np.concatenate([np.zeros(0, dtype=ROW), *self._parts])
        seeds = rows["seed"] - plan.seeds.start
        rows = rows[(rows["cell"] < len(plan.cells)) & (seeds >= 0) & (seeds < len(plan.seeds))]
        self._parts = [rows.copy()]
        rows["seed"] -= plan.seeds.start
        shape = len(plan.cells), len(plan.seeds)
        errors = gather_errors(rows, codes, shape, plan.level)
        done = np.ones(shape, dtype=bool)
        failures = {}
        for name in (*plan.observers, *plan.controllers):
            seen, of = np.zeros(shape, dtype=bool), rows[rows["name"] == codes.get(name, -1)]
            seen[of["cell"], of["seed"]] = True
            done &= seen
            lost = np.unique(of[of["target"] == codes.get("", -1)][["cell", "seed"]])
            failures[name] = np.bincount(lost["cell"], minlength=shape[0])
        n_done = int(done.sum())
        pace = measure_pace(self._batches, 1e-9 * self._plan_time, time())
        for one in errors.values():
            _ = one.winners, one.bound  # here, not on the thread of a page
        return CampaignState(plan, n_done, len(rows), pace, errors, failures)


BEST, TIED, UNTESTED = "best", "tied", "not tested"


@dataclass(frozen=True)
class TogetherRow:
    """One row of the table.

    Attributes
    ----------
    target, mode, name : str
        What it is.
    rms_nm : float
        Root mean square over the seeds, of several scenarios the geometric mean [nm].
    over_bound, over_bound_low, over_bound_high : float
        Geometric mean over the scenarios of the error over the smallest bound, and its interval; NaN where there is none.
    above, above_low, above_high : float
        Mean error over that of the best, less 1, and its interval; NaN where it is not compared, or not tested.
    rank : str
        BEST where all others differ significantly, TIED where a test finds no difference, UNTESTED where there is too little to
        test, else empty.
    wins, decided_wins : int or None
        Scenarios in which it is the best, and how many of these are significant; None where it cannot be.
    records : int
        Records with a result.
    failures : int or None
        Runs without an estimate; None for bounds.
    """

    target: str
    mode: str
    name: str
    rms_nm: float
    over_bound: float
    over_bound_low: float
    over_bound_high: float
    above: float
    above_low: float
    above_high: float
    rank: str
    wins: int | None
    decided_wins: int | None
    records: int
    failures: int | None


def standings(state: CampaignState, target: str, mode: str, cells: Sequence[int] | Array) -> list[TogetherRow]:
    """Return the table over some scenarios, the smallest error first.

    state : of `wfsobs.campaign.follow.CampaignFolder`;  cells : of `wfsobs.campaign.plan.cells_where`
    """
    errors = state.errors[target, mode]
    ratio, low, high = errors.over_bound(cells)
    places = errors.standings(cells)
    out = []
    for s in places:
        i = errors.names.index(s.name)
        won = [v for cell in cells if (v := errors.winners.get(int(cell))) is not None and v.best.name == s.name]
        can_win, failed = errors.eligible[cells, i].any(), state.failures.get(s.name)
        out.append(
            TogetherRow(
                target,
                mode,
                s.name,
                s.rms,
                over_bound=float(ratio[i]),
                over_bound_low=float(low[i]),
                over_bound_high=float(high[i]),
                above=s.above,
                above_low=s.low,
                above_high=s.high,
                rank=_rank(s, places),
                wins=len(won) if can_win else None,
                decided_wins=sum(v.is_decided for v in won) if can_win else None,
                records=int(errors.count[cells, i].sum()),
                failures=None if failed is None else int(failed[cells].sum()),
            )
        )
    return out


def _rank(s: CampaignPlace, places: Sequence[CampaignPlace]) -> str:
    rivals = [other for other in places if other.is_rival]
    of = rivals if s.is_best else [s]
    if any(one.is_tie for one in of):
        return TIED
    if any(one.is_untested for one in of):
        return UNTESTED
    return BEST if s.is_best and rivals else ""
