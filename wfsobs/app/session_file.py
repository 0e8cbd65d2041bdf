"""A session in one file: every entry of the history, its loaded records, and what was shown.

The file is a zip of `session.json` and of the records as `.npz`. Nothing of it is unpickled, and the sizes are checked before
anything is unpacked. What is read is checked like everything else that comes from outside.
"""

from __future__ import annotations

import io
import json
import re
import time
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from inspect import signature
from math import inf, isfinite
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from wfsobs.app.cache import owners_in
from wfsobs.app.compared import DrawnLines
from wfsobs.app.service import run_key
from wfsobs.app.sources import LoadedRecord, SimulatedRecord, Source, Step, record_key
from wfsobs.app.work import RunResults
from wfsobs.evaluation.evidence import Evidence
from wfsobs.evaluation.result import NOT_OBSERVERS
from wfsobs.evaluation.scores import Calibration, Score
from wfsobs.observers import OBSERVERS
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.values import SettingError
from wfsobs.telemetry.columns import to_contents
from wfsobs.telemetry.formats import npz
from wfsobs.telemetry.intake import LONGEST_DELAY, DeclaredFormat, to_record
from wfsobs.telemetry.preview import safe_name
from wfsobs.telemetry.records import record_arrays
from wfsobs.units import UNITS

LONGEST_TEXT = 2_000

SHA256 = re.compile("[0-9a-f]{64}")

DAMAGED = "damaged, or no session of wfsobs"

T = TypeVar("T")


class SessionError(ValueError):
    """Error: a file that is no session that can be opened; one line saying why."""


def read_declaration(values: Mapping[str, Any]) -> DeclaredFormat:
    """Read what was said of a record's file. Raises SessionError."""
    said = read_as(DeclaredFormat, values)
    delay, above_zero = said.command_delay, (said.rate, said.rail, *(said.command_gain or ()))
    valid = (
        said.unit in (None, *UNITS)
        and said.command_sign in (None, 1, -1)
        and (delay is None or 1 <= delay <= LONGEST_DELAY)
        and all(x is None or 0 < x < inf for x in above_zero)
        and all(len(name) <= LONGEST_TEXT for name in said.columns.values())
    )
    if not valid:
        raise SessionError("what is said of a record makes no sense")
    return said


def read_as(kind: type[T], values: Any) -> T:
    """Read a dataclass from plain values by the types of its fields; other values are passed over. Raises SessionError."""
    if not isinstance(values, dict):
        raise SessionError(DAMAGED)
    hints = get_type_hints(kind)
    for name, parameter in signature(kind).parameters.items():
        if parameter.default is parameter.empty and name not in values:
            raise SessionError(f"{name} is missing")
    return kind(**{name: get_value(values, name, hint) for name, hint in hints.items() if name in values})


def get_value(values: Mapping[str, Any], name: str, hint: Any) -> Any:
    """Return a value of one type and no other. Raises SessionError."""
    try:
        return _convert(values.get(name), hint)
    except (TypeError, OverflowError, UnicodeEncodeError):
        raise SessionError(f"{name} is missing or of the wrong kind") from None


def _convert(value: Any, hint: Any) -> Any:
    """Return a plain value as one of a type; JSON has a tuple as a list. Raises TypeError, OverflowError, UnicodeEncodeError."""
    of = get_args(hint)
    if isinstance(hint, UnionType):
        return None if value is None else _convert(value, of[0])
    if isinstance(value, (list, tuple)) and hint is Calibration:
        return Calibration(*(_convert(item, float) for item in value))
    if isinstance(value, (list, tuple)) and get_origin(hint) is tuple and len(value) in (len(of), len(value) * (of[-1] is ...)):
        return tuple(_convert(item, of[0]) for item in value)
    if isinstance(value, dict) and get_origin(hint) is Mapping:
        return {_convert(key, of[0]): _convert(item, of[1]) for key, item in value.items()}
    if hint is float and type(value) is int:
        value = float(value)
    if type(value) is not hint:
        raise TypeError
    if isinstance(value, str):
        value.encode()  # JSON may have half of a surrogate pair, a page may not
    return value


def get_text(values: Mapping[str, Any], name: str, most: int = LONGEST_TEXT) -> str:
    """Return a text, cut at some characters. Raises SessionError."""
    return get_value(values, name, str)[:most]


LARGEST = 20_000_000
"""Of a file that is opened [bytes]."""

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
    evidence : errors over several seeds, where they have been known; not in a file
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
    evidence: Evidence | None = field(default=None, repr=False)

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


SUFFIX = ".wfsobs-session"
FORMAT, VERSION = "wfsobs-session", 1
JSON = "session.json"

MOST_TEXT = 40_000_000
"""Of the settings and scores of a session [bytes]."""

MOST_SCORES = 5_000
"""Of one entry."""


@dataclass(frozen=True)
class SessionContent:
    """What a session's file holds.

    step, view : what was shown;  compared_keys : of the entries that were compared
    """

    entries: Sequence[HistoryEntry]
    step: Step
    view: str = ""
    compared_keys: Sequence[str] = ()


# ---------------------------------------------------------------------- writing


def write_session(content: SessionContent) -> bytes:
    """Return the bytes of a session's file."""
    records: dict[str, LoadedRecord] = {}
    for source in (content.step[2], *(entry.source for entry in content.entries)):
        if isinstance(source, LoadedRecord):
            records.setdefault(source.key, source)
    numbers = {key: number for number, key in enumerate(records)}
    values = {
        "format": FORMAT,
        "version": VERSION,
        "shown": _step_values(content.step, numbers) | {"view": content.view},
        "compared": [i for i, entry in enumerate(content.entries) if entry.key in content.compared_keys],
        "entries": [_entry_values(entry, numbers) for entry in content.entries],
    }
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(JSON, json.dumps(values, separators=(",", ":")))
        for key, number in numbers.items():
            arrays = io.BytesIO()
            npz.write(arrays, record_arrays(records[key].record))
            archive.writestr(_member(number), arrays.getvalue(), zipfile.ZIP_STORED)
    return file.getvalue()


def _member(number: int) -> str:
    return f"records/{number}.npz"


PLAIN: Mapping[str, type] = {"name": str, "own_name": bool, "time": float, "star": bool, "record": str, "view": str}
"""Fields of an entry that are read as they are written, and their types."""


def _entry_values(entry: HistoryEntry, numbers: Mapping[str, int]) -> dict[str, Any]:
    plain = {name: getattr(entry, name) for name in ("key", *PLAIN)}
    return plain | _step_values(entry.step, numbers) | {"scores": [asdict(score) for score in entry.scores]}


def _step_values(step: Step, numbers: Mapping[str, int]) -> dict[str, Any]:
    scenario, preset, source = step
    return {"preset": preset, "scenario": scenario.to_dict(), "source": _source_values(source, numbers)}


def _source_values(source: Source | None, numbers: Mapping[str, int]) -> dict[str, Any] | None:
    if isinstance(source, SimulatedRecord):
        return {"simulation": source.simulation.to_dict()}
    if isinstance(source, LoadedRecord):
        stated = vars(source.declaration) | {"columns": dict(source.declaration.columns)}
        named = {"name": source.name, "what": source.what, "sha256": source.sha256}
        return {"number": numbers[source.key], **named, "declaration": stated}
    return None


# ---------------------------------------------------------------------- reading


def read_session(content: bytes) -> SessionContent:
    """Read a session's file. Raises SessionError, one line."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {info.filename: info for info in archive.infolist()}
            if JSON not in members or len(members) > MOST + 1:
                raise SessionError(DAMAGED)
            values = json.loads(_unpack(archive, members[JSON], MOST_TEXT))
            if not isinstance(values, dict) or values.get("format") != FORMAT:
                raise SessionError(DAMAGED)
            if values.get("version") != VERSION:
                raise SessionError(f"is of version {str(values.get('version'))[:20]}; version {VERSION} is read here")
            return _content(values, _Records(archive, members))
    except SessionError:
        raise
    except (SettingError, RecordError) as error:
        raise SessionError(str(error).partition("\n")[0][:300]) from None
    except RecursionError:
        raise SessionError("its settings are nested too deep") from None
    except (ValueError, EOFError, OSError, zipfile.BadZipFile, zlib.error, KeyError, RuntimeError, MemoryError, ArithmeticError):
        raise SessionError(DAMAGED) from None


def _unpack(archive: zipfile.ZipFile, info: zipfile.ZipInfo, most: int) -> bytes:
    """Return the bytes of a member, at most the size in the directory."""
    if info.file_size > most:
        raise SessionError(f"holds more than {most / 1e6:.4g} MB, which is the most that is read here")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise SessionError(DAMAGED)
    with archive.open(info) as stream:
        return stream.read(info.file_size)


class _Records:
    """The records of a file, each read once, all within one limit."""

    def __init__(self, archive: zipfile.ZipFile, members: Mapping[str, zipfile.ZipInfo]):
        self._archive, self._members = archive, members
        self._left = MOST_RECORD_BYTES
        self._records: dict[int, tuple[Record, str]] = {}
        self._largest = Scenario().replace({"telescope.radial_order": 6})  # as many modes as there may be

    def find(self, number: int) -> tuple[Record, str]:
        """Return a record and its key."""
        if number not in self._records:
            info = self._members.get(_member(number))
            if info is None:
                raise SessionError("one of its records is missing")
            contents = to_contents(npz.read(io.BytesIO(_unpack(self._archive, info, self._left)), self._left), {})
            self._left -= sum(array.nbytes for array in contents.arrays.values())
            record = to_record(contents, self._largest, DeclaredFormat())
            self._records[number] = record, record_key(record)
        return self._records[number]


def _content(values: Mapping[str, Any], records: _Records) -> SessionContent:
    shown = get_value(values, "shown", dict)
    step = _step(shown, records)
    listed = get_value(values, "entries", list)
    if len(listed) > MOST:
        raise SessionError(f"holds {len(listed)} results, at most {MOST} are read here")
    entries: list[HistoryEntry] = []
    for number, item in enumerate(listed, 1):
        try:
            entries.append(_entry(item, records))
        except (SettingError, SessionError) as error:
            raise SessionError(f"result {number}: {error}") from None
    compared = [entries[i].key for i in get_value(values, "compared", list) if type(i) is int and 0 <= i < len(entries)]
    return SessionContent(entries, step, get_text(shown, "view"), compared)


def _step(values: Mapping[str, Any], records: _Records) -> Step:
    preset = get_text(values, "preset")
    if preset not in PRESETS:
        raise SessionError(f"there is no preset {preset[:40]!r}")
    return _scenario(get_value(values, "scenario", dict)), preset, _source(values.get("source"), records)


def _scenario(values: Mapping[str, Any]) -> Scenario:
    scenario = Scenario.from_dict(values)
    scenario.validate()
    return scenario


def _source(values: Any, records: _Records) -> Source | None:
    if values is None:
        return None
    if not isinstance(values, dict):
        raise SessionError(DAMAGED)
    if "simulation" in values:
        return SimulatedRecord(_scenario(get_value(values, "simulation", dict)))
    record, key = records.find(get_value(values, "number", int))
    digits = get_text(values, "sha256")
    if digits and not SHA256.fullmatch(digits):
        raise SessionError("a SHA-256 takes 64 hexadecimal digits")
    name = safe_name(get_text(values, "name"))
    return LoadedRecord(
        record, name, key, get_text(values, "what"), read_declaration(get_value(values, "declaration", dict)), digits
    )


def _entry(values: Any, records: _Records) -> HistoryEntry:
    if not isinstance(values, dict):
        raise SessionError(DAMAGED)
    scenario, preset, source = _step(values, records)
    plain = {name: get_value(values, name, kind) for name, kind in PLAIN.items()}
    record = safe_name(plain["record"]) if plain["record"] else ""
    listed = get_value(values, "scores", list)
    if len(listed) > MOST_SCORES or bool(record and source) != isinstance(source, LoadedRecord):
        raise SessionError(DAMAGED)
    lost = bool(record) and source is None
    scores = [read_as(Score, score) for score in listed]
    if not isfinite(plain["time"]):
        raise SessionError(f"time = {plain['time']:g}: takes a finite number")
    for rms in (score.rms for score in scores):
        if not 0.0 <= rms < inf:
            raise SessionError(f"rms = {rms:g}: takes a finite number from 0")
    plain |= {
        "key": get_text(values, "key", 64) if lost else run_key(scenario, source),
        "name": " ".join(plain["name"][:LONGEST_NAME].split()) or "no name",
        "record": record,
        "scores": tuple(score for score in scores if score.observer in (*OBSERVERS, *NOT_OBSERVERS)),  # others have no label here
    }
    return HistoryEntry(scenario=scenario, preset=preset, source=source, **plain)
