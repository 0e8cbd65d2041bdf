"""Run the arena: every entry on every scenario of its tracks, results written once."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from math import isfinite
from pathlib import Path
from typing import Any

from wfsobs.files import write_whole
from wfsobs.record import Record
from wfsobs.testing import QUICK
from wfsobs_arena.cases import Case
from wfsobs_arena.definition import Arena
from wfsobs_arena.entries import FOLDER, ArenaEntry, admits
from wfsobs_arena.process import EntryError, EntryProcess
from wfsobs_arena.tracks import TRACKS
from wfsobs_arena.trials import Trial, try_record

CHECKS = 2
"""Version of the checks: what has passed those of another is checked again."""

Tell = Callable[[str], None]


@dataclass(frozen=True)
class EntryOutcome:
    """EntryOutcome of an entry.

    Attributes
    ----------
    entry : ArenaEntry
        The entry.
    refusal : str
        Why it is refused, one line; empty where it is not.
    trials : dict
        (track, scenario) -> results.
    """

    entry: ArenaEntry
    refusal: str
    trials: dict[tuple[str, str], list[Trial]]


class RecordCache:
    """Records of the scenarios and the mean squares of their references, each made once."""

    def __init__(self) -> None:
        self._records: dict[str, tuple[Record, list[float]]] = {}

    def get(self, case: Case, seed: int) -> tuple[Record, list[float]]:
        """Return a record, and the mean squares [um^2] of the reference."""
        key = f"{case.digest} {seed}"
        if key not in self._records:
            record = case.record(seed)
            self._records[key] = record, case.reference_squares(record, seed)
        return self._records[key]


def run_arena(
    arena: Arena, entries: Sequence[ArenaEntry], folder: Path, *, tell: Tell = lambda _line: None
) -> list[EntryOutcome]:
    """Run what is missing, and return all outcomes.

    Parameters
    ----------
    arena : Arena
        Scenarios and rules.
    entries : sequence of ArenaEntry
        Who enters.
    folder : Path
        Where results are; made where there is none.
    tell : callable
        Receives a line per entry and scenario.

    Returns
    -------
    list of EntryOutcome
        In the order of the entries.

    Raises
    ------
    OSError
        A result cannot be written.
    """
    records = RecordCache()
    return [_run_entry(arena, entry, folder / "results" / entry.id, records, tell) for entry in entries]


def _run_entry(arena: Arena, entry: ArenaEntry, folder: Path, records: RecordCache, tell: Tell) -> EntryOutcome:
    folder.mkdir(parents=True, exist_ok=True)
    cases = cases_of(arena, entry)
    trials: dict[tuple[str, str], list[Trial]] = {}
    with EntryProcess(entry, arena.rules.memory) as process:
        refusal = "" if entry.kind == FOLDER or not cases else _refusal(arena, entry, folder, process)
    if refusal:
        tell(f"{entry.id}: refused: {refusal}")
        return EntryOutcome(entry, refusal, {})
    with EntryProcess(entry, arena.rules.memory) as process:  # another one: it has never had a truth
        for case in cases:
            path, key = folder / f"{case.track}-{case.name}.json", [arena.version, case.digest, entry.version]
            known = _read(path, key)
            missing = [seed for seed in case.seeds if seed not in known]
            if missing:
                runs_in = None if entry.kind == FOLDER else process
                known |= {t.seed: t for t in _try_records(arena, entry, case, missing, records, runs_in)}
                _write(path, {"key": key, "entry": asdict(entry), "trials": [asdict(trial) for trial in known.values()]})
            trials[case.track, case.name] = [known[seed] for seed in case.seeds]
            failures = [trial.failure for trial in trials[case.track, case.name] if trial.failure]
            tell(f"{entry.id}: {case.track} {case.name}{f': no answer: {failures[0]}' if failures else ''}")
    return EntryOutcome(entry, "", trials)


def cases_of(arena: Arena, entry: ArenaEntry) -> list[Case]:
    """Return the scenarios of the tracks that an entry takes part in; a folder does where it has a file of one of the records."""
    cases = [case for case in arena.cases if admits(TRACKS[case.track], entry)]
    if entry.kind != FOLDER:
        return cases
    files = {path.stem for path in Path(entry.place).glob("*.npz")}
    tracks = {case.track for case in cases if any(case.record_id(seed) in files for seed in case.seeds)}
    return [case for case in cases if case.track in tracks]


def _try_records(
    arena: Arena, entry: ArenaEntry, case: Case, seeds: Sequence[int], records: RecordCache, process: EntryProcess | None
) -> Iterator[Trial]:
    for seed in seeds:
        yield try_record(entry, case, seed, *records.get(case, seed), process, arena.rules)


def _refusal(arena: Arena, entry: ArenaEntry, folder: Path, process: EntryProcess) -> str:
    """Return why an entry is refused by the checks, empty where it is not; checked once."""
    path, key = folder / "check.json", [arena.version, CHECKS, entry.version]
    known = _load_file(path, key)
    if known is None or not isinstance(known.get("refusal"), str):
        try:
            process.check(arena.rules.seconds(QUICK["run.duration"]))
            known = {"key": key, "refusal": ""}
        except EntryError as error:
            known = {"key": key, "refusal": str(error).removeprefix(f"{entry.id}: ")}
        _write(path, known)
    return known["refusal"]


def _load_file(path: Path, key: list[Any]) -> dict[str, Any] | None:
    """Return the contents of a file of this key, None where there is none."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return values if isinstance(values, dict) and values.get("key") == key else None


def _read(path: Path, key: list[Any]) -> dict[int, Trial]:
    """Return the results in a file of this key by seed, none where it holds anything else."""
    try:
        trials = [Trial(**one) for one in (_load_file(path, key) or {"trials": ()})["trials"]]
        is_whole = all(map(isfinite, chain.from_iterable((*t.squares, *t.reference) for t in trials)))
    except (KeyError, TypeError):
        return {}
    return {trial.seed: trial for trial in trials} if is_whole else {}


def _write(path: Path, values: dict[str, Any]) -> None:
    text = json.dumps(values, indent=1) + "\n"
    write_whole(path, lambda file: file.write(text.encode()))
