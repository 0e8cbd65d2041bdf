"""A campaign while it runs: what is new in its folder, its errors as arrays, and what is best in one scenario or many."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import time
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from wfsobs.campaign.compare import LEVEL
from wfsobs.campaign.plan import Campaign
from wfsobs.campaign.store import PLAN, batch_files, folder_plan, need_pyarrow, read_batch
from wfsobs.evaluation.evidence import columns_differ
from wfsobs.evaluation.rows import NOT_OBSERVERS, can_be_best
from wfsobs.evaluation.scores import BOUNDS, COMMON_BOUNDS
from wfsobs.observers import OBSERVERS
from wfsobs.progress import QUIET, Watch
from wfsobs.settings.errors import SettingError
from wfsobs.typing import Array


class CampaignPlace(NamedTuple):
    """One observer, controller or bound over some scenarios.

    Attributes
    ----------
    name : str
        Id.
    rms : float
        Root mean square over the seeds, of several scenarios the geometric mean [nm].
    above : float
        Mean of its rms over that of the best, less 1; NaN where it is not compared.
    low, high : float
        Interval of `above`; NaN where there is none.
    is_best, is_tie, is_untested : bool
        Whether it is the best; whether a test of all pairs together finds no difference from the best; whether it is compared
        with too little to test.
    """

    name: str
    rms: float
    above: float
    low: float
    high: float
    is_best: bool
    is_tie: bool
    is_untested: bool

    @property
    def is_rival(self) -> bool:
        """Whether it is compared with the best."""
        return self.is_tie or self.is_untested or not np.isnan(self.above)


class CampaignWinner(NamedTuple):
    """The best over some scenarios.

    margin : how much worse the next is, NaN without one;  ties : what does not differ by a test
    is_decided : whether it differs significantly from all others
    """

    best: CampaignPlace
    margin: float
    ties: tuple[str, ...]
    is_decided: bool


@dataclass(frozen=True)
class CampaignErrors:
    """Errors of a campaign, for one target and mode.

    Attributes
    ----------
    names : tuple of str
        Ids of observers or controllers, and of bounds.
    values : Array
        rms [nm], (n_cells, n_seeds, n_names), NaN without a result.
    eligible : Array
        Whether a name can be the best in a scenario, bool (n_cells, n_names).
    """

    names: tuple[str, ...]
    values: Array
    eligible: Array

    @cached_property
    def count(self) -> Array:
        """Records with a result, (n_cells, n_names)."""
        return (~np.isnan(self.values)).sum(axis=1)

    @cached_property
    def rms(self) -> Array:
        """Root mean square over the seeds [nm], (n_cells, n_names)."""
        squares = np.nansum(self.values**2, axis=1)
        return np.sqrt(np.divide(squares, self.count, out=np.full(squares.shape, np.nan), where=self.count > 0))

    @cached_property
    def bound(self) -> Array:
        """The smallest bound of what all observers are given, of every scenario [nm], (n_cells,); NaN where none is known."""
        of = [i for i, name in enumerate(self.names) if name in COMMON_BOUNDS]
        known = self.rms[:, of] if of else np.full((len(self.rms), 1), np.nan)
        return np.fmin.reduce(known, axis=1)

    def over_bound(self, cells: Sequence[int] | Array) -> tuple[Array, Array, Array]:
        """Return the geometric mean over scenarios of rms over bound, and its interval, each (n_names,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(self.rms[cells] / self.bound[cells, None])
        mean, half = _mean_interval(np.where(np.isfinite(logs), logs, np.nan))
        return np.exp(mean), np.exp(mean - half), np.exp(mean + half)

    def known_cells(self, cells: Sequence[int] | Array) -> Array:
        """Return those of some scenarios that have results."""
        cells = np.asarray(cells, dtype=int)
        return cells[self.count[cells].any(axis=1)]

    def standings(self, cells: Sequence[int] | Array) -> list[CampaignPlace]:
        """Compare all names over some scenarios: over the seeds if a single one has results, else over the scenarios.

        Seeds of one scenario are no independent evidence about others, so that of several each counts once, by the logarithm of
        its rms. The best is the one with the smallest mean of those with a result in most records or scenarios.
        """
        cells = self.known_cells(cells)
        if len(cells) == 1:
            samples, mean, eligible = self.values[cells[0]], self.rms[cells[0]], self.eligible[cells[0]]
        else:
            rms = self.rms[cells]
            with np.errstate(divide="ignore"):
                samples = np.where(rms > 0, np.log(rms), np.nan)
            mean, eligible = np.exp(_mean_interval(samples)[0]), (self.eligible[cells] | np.isnan(rms)).all(axis=0)
        known = (~np.isnan(samples)).sum(axis=0)
        candidates = eligible & (known > 0)
        ranked = [i for i in np.argsort(mean) if candidates[i] and known[i] == known[candidates].max()]
        above = low = high = np.full(len(mean), np.nan)
        best = ranked[0] if ranked else -1
        tie, untested = np.zeros((2, len(mean)), dtype=bool)
        if ranked:
            difference, half = _mean_interval(samples - samples[:, [best]])
            rivals = candidates & (np.arange(len(mean)) != best)
            untested = rivals & np.isnan(half)
            compared = np.flatnonzero(candidates)
            tie[compared] = ~columns_differ(samples[:, compared])[compared == best][0]
            tie &= rivals & ~untested
            parts = [np.where(rivals, part, np.nan) for part in (difference, difference - half, difference + half)]
            above, low, high = (part / mean[best] if len(cells) == 1 else np.expm1(part) for part in parts)
        numbers = [column.tolist() for column in (mean, above, low, high, np.arange(len(mean)) == best, tie, untested)]
        return [CampaignPlace(self.names[i], *(column[i] for column in numbers)) for i in np.argsort(mean) if known[i]]

    def verdict(self, cells: Sequence[int] | Array) -> CampaignWinner | None:
        """Return the best over some scenarios; None where nothing is known."""
        standings = self.standings(cells)
        best = next((s for s in standings if s.is_best), None)
        if best is None:
            return None
        rivals = [s for s in standings if s.is_rival]
        decided = bool(rivals) and not any(s.is_tie or s.is_untested for s in rivals)
        margin = min((s.rms for s in rivals), default=np.nan) / best.rms - 1.0 if best.rms > 0 else np.nan
        return CampaignWinner(best, float(margin), tuple(s.name for s in standings if s.is_tie), decided)

    @cached_property
    def winners(self) -> dict[int, CampaignWinner]:
        """The best of every scenario that has results."""
        known = np.flatnonzero((self.count * self.eligible).any(axis=1)).tolist()
        found = {cell: self.verdict([cell]) for cell in known}
        return {cell: verdict for cell, verdict in found.items() if verdict is not None}


def can_win(name: str, target: str) -> bool:
    """Return whether an observer or a controller is one that can be the best."""
    if target == "residual":
        return name not in BOUNDS
    return name not in (*OBSERVERS, *NOT_OBSERVERS) or can_be_best(name, apart=False)


def _mean_interval(samples: Array) -> tuple[Array, Array]:
    """Return mean and half-width of its interval by Student's t along the first axis; NaN with fewer than one and two samples."""
    known = ~np.isnan(samples)
    n = known.sum(axis=0)
    some = np.maximum(n, 1)
    mean = np.where(known, samples, 0.0).sum(axis=0) / some
    spread = np.sqrt((np.where(known, samples - mean, 0.0) ** 2).sum(axis=0) / np.maximum(n - 1, 1))
    half = stdtrit(np.maximum(n - 1, 1), (1 + LEVEL) / 2) * spread / np.sqrt(some)
    return np.where(n > 0, mean, np.nan), np.where(n > 1, half, np.nan)


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
