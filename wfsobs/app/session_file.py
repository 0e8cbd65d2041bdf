"""A session in one file: every entry of the history, its loaded records, and what was shown.

The file is a zip of `session.json` and of the records as `.npz`. Nothing of it is unpickled, and the sizes are checked before
anything is unpacked. What is read is checked like everything else that comes from outside.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from wfsobs.app.history_entry import LONGEST_NAME, MOST, MOST_RECORD_BYTES, HistoryEntry
from wfsobs.app.service import run_key
from wfsobs.app.session_values import DAMAGED, SessionError, get_number, get_text, get_value, read_declaration, read_score
from wfsobs.app.sources import LoadedRecord, SimulatedRecord, Source, Step, record_key
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.errors import SettingError
from wfsobs.telemetry.columns import to_contents
from wfsobs.telemetry.formats import npz
from wfsobs.telemetry.intake import DeclaredFormat, to_record
from wfsobs.telemetry.preview import safe_name
from wfsobs.telemetry.records import record_arrays

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
    scenario, preset, source = content.step
    values = {
        "format": FORMAT,
        "version": VERSION,
        "shown": {
            "preset": preset,
            "scenario": scenario.to_dict(),
            "source": _source_values(source, numbers),
            "view": content.view,
        },
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


def _entry_values(entry: HistoryEntry, numbers: Mapping[str, int]) -> dict[str, Any]:
    return {
        "key": entry.key,
        "name": entry.name,
        "own_name": entry.own_name,
        "time": entry.time,
        "star": entry.star,
        "preset": entry.preset,
        "scenario": entry.scenario.to_dict(),
        "source": _source_values(entry.source, numbers),
        "record": entry.record,
        "view": entry.view,
        "scores": [asdict(s) | {"calibration": s.calibration and list(s.calibration)} for s in entry.scores],
    }


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
    if isinstance(values, dict) and "simulation" in values:
        return SimulatedRecord(_scenario(get_value(values, "simulation", dict)))
    if not isinstance(values, dict):
        raise SessionError(DAMAGED)
    record, key = records.find(get_value(values, "number", int))
    digits = get_text(values, "sha256")
    if digits and (len(digits) != 64 or not set(digits) <= set("0123456789abcdef")):
        raise SessionError("a SHA-256 takes 64 hexadecimal digits")
    name = safe_name(get_text(values, "name"))
    return LoadedRecord(
        record, name, key, get_text(values, "what"), read_declaration(get_value(values, "declaration", dict)), digits
    )


def _entry(values: Any, records: _Records) -> HistoryEntry:
    if not isinstance(values, dict):
        raise SessionError(DAMAGED)
    scenario, preset, source = _step(values, records)
    record = safe_name(get_text(values, "record")) if values.get("record") else ""
    listed = get_value(values, "scores", list)
    if len(listed) > MOST_SCORES or bool(record and source) != isinstance(source, LoadedRecord):
        raise SessionError(DAMAGED)
    lost = bool(record) and source is None
    return HistoryEntry(
        get_text(values, "key", 64) if lost else run_key(scenario, source),
        " ".join(get_text(values, "name", LONGEST_NAME).split()) or "no name",
        get_number(values, "time"),
        scenario,
        preset,
        source,
        record,
        tuple(map(read_score, listed)),
        get_value(values, "star", bool),
        get_text(values, "view"),
        get_value(values, "own_name", bool),
    )
