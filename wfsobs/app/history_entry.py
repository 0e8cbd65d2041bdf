"""An entry of the history, and how much of all entries is held."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from wfsobs.app.cache import owners_in
from wfsobs.app.compared import DrawnLines
from wfsobs.app.service import run_key
from wfsobs.app.sources import LoadedRecord, Source, Step
from wfsobs.app.work import RunResults
from wfsobs.evaluation.scores import Score
from wfsobs.scenario import Scenario

MOST = 200
"""Entries of a history; the oldest that have neither a star nor are compared go first."""

LONGEST_NAME = 200
"""Characters of an entry's name."""

RECORD_BYTES = 800_000_000
"""Of all loaded records that the sessions of a server hold in their histories [bytes]."""

MOST_RECORD_BYTES = 200_000_000
"""Of the records in one file of a session [bytes]."""


@dataclass(eq=False)
class HistoryEntry:
    """A result of the session.

    key     : names the settings and the record
    time    : when it was last computed or shown [s since 1970]
    record  : name of the loaded record; empty for a simulation
    source  : what the observers ran on where that is not the simulation of the settings; None too for a record no longer held
    view    : the page's view when it was last shown, as a query
    own_name : whether a visitor gave it its name
    results : with traces, as long as they are held
    """

    key: str
    name: str
    time: float
    scenario: Scenario
    preset: str
    source: Source | None = None
    record: str = ""
    scores: tuple[Score, ...] = ()
    star: bool = False
    view: str = ""
    own_name: bool = False
    results: RunResults | None = field(default=None, repr=False)

    @property
    def is_restorable(self) -> bool:
        """Whether what it ran on is there."""
        return not self.record or self.source is not None

    @property
    def step(self) -> Step:
        """Settings, preset and record."""
        return self.scenario, self.preset, self.source


def make_entry(step: Step, name: str, results: RunResults | None = None) -> HistoryEntry:
    """Make an entry of settings and what they gave."""
    scenario, preset, source = step
    record = source.name if isinstance(source, LoadedRecord) else ""
    scores = results.result.scores if results else ()
    return HistoryEntry(run_key(scenario, source), name, time.time(), scenario, preset, source, record, scores, results=results)


def let_go(
    entries: Iterable[HistoryEntry],
    current: str,
    most_bytes: int,
    most_record_bytes: int,
    lines: Iterable[DrawnLines | None] = (),
) -> None:
    """Let go of traces and of loaded records beyond some bytes: those of starred entries last.

    current : key of the entry whose results are shown, which holds its record; lines : of compared runs, which stay
    """
    names, names_of_records = set[int](), set[int]()
    left, left_of_records = most_bytes - sum(_new_bytes(drawn, names) for drawn in lines), most_record_bytes
    for entry in sorted(entries, key=lambda entry: (entry.key != current, not entry.star)):
        if entry.results is not None:
            left -= _new_bytes(entry.results, names)
            if left < 0:
                entry.results = None
        if isinstance(entry.source, LoadedRecord):
            left_of_records -= _new_bytes(entry.source.record, names_of_records)
            if left_of_records < 0 and entry.key != current:
                entry.source = entry.results = None


def _new_bytes(value: Any, names: set[int]) -> int:
    """Return the memory of the arrays in a value beyond those named already [bytes], and name them."""
    owners = {name: size for name, size in owners_in(value).items() if name not in names}
    names |= owners.keys()
    return sum(owners.values())
