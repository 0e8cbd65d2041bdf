"""The record of a link: its name, the SHA-256 by which its file is known, and what was said of it; never the record itself.

`record.name=night.csv&record.sha256=2f9c...&record.unit=nm&record.sign=-1&record.column.u/tip=volts`. Whoever opens the link
gives the file; its name opens nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from wfsobs.app.session_values import SessionError, read_declaration
from wfsobs.app.sources import LoadedRecord, Source
from wfsobs.telemetry.columns import ROLES
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import safe_name
from wfsobs.units import UNITS

PREFIX, COLUMN = "record.", "column."

DIGITS = 64
"""Of a SHA-256 in hexadecimal."""

STATEMENTS: dict[str, tuple[str, Callable[[str], Any], str]] = {
    "unit": ("unit", str, f"takes one of {', '.join(UNITS)}"),
    "sign": ("command_sign", int, "takes 1 or -1"),
    "delay": ("command_delay", int, "takes a whole number of steps from 1"),
    "rate": ("rate", float, "takes a rate above 0 Hz"),
    "trust": ("trust", lambda text: bool(("False", "True").index(text)), "takes True"),
}
"""Field -> part of the declaration, its reading, what it takes."""


@dataclass(frozen=True)
class NamedRecord:
    """A record that a link is of; sha256 : of its file, in hexadecimal digits."""

    name: str
    sha256: str
    declaration: DeclaredFormat

    def line(self, other: str = "", digest: str = "") -> str:
        """Ask for the file. other, digest : name and SHA-256 of a file that is another one."""
        line = (
            f"This link is of the record {self.name} (SHA-256 {self.sha256[:12]}…): drop that file here, or load it, to see it; "
            "until then the simulation of these settings is shown."
        )
        return line + (f" {other} is another file: its SHA-256 is {digest[:12]}…" if other else "")


def name_record(source: Source | None) -> NamedRecord | None:
    """Name a record that was loaded; None for a simulation, and for a record whose file is not known."""
    if not isinstance(source, LoadedRecord) or not source.sha256:
        return None
    return NamedRecord(source.name, source.sha256, source.declaration)


def record_fields(record: NamedRecord) -> dict[str, str]:
    """Write a record as fields of a link."""
    said = {key: getattr(record.declaration, part) for key, (part, _, _) in STATEMENTS.items()}
    fields = {"name": record.name, "sha256": record.sha256}
    fields |= {key: f"{value:.17g}" if key == "rate" else str(value) for key, value in said.items() if value not in (None, False)}
    fields |= {COLUMN + role: name for role, name in record.declaration.columns.items()}
    return {PREFIX + key: text for key, text in fields.items()}


def read_record_fields(fields: Mapping[str, str]) -> tuple[NamedRecord | None, dict[str, str]]:
    """Read the record of a link; field -> why it cannot be used. Without a SHA-256 there is no record."""
    refused: dict[str, str] = {}
    given = {key.removeprefix(PREFIX): text for key, text in fields.items()}
    name, digits, declaration = given.pop("name", ""), given.pop("sha256", ""), DeclaredFormat()
    if len(digits) != DIGITS or not set(digits) <= set("0123456789abcdef"):
        return None, {f"{PREFIX}sha256": f"takes {DIGITS} hexadecimal digits"}
    if name != safe_name(name):
        refused[f"{PREFIX}name"] = "takes the name of a file"
    for key, text in given.items():
        try:
            declaration = _with(declaration, key, text)
        except (SessionError, ValueError) as error:
            refused[PREFIX + key] = str(error) if isinstance(error, SessionError) else STATEMENTS[key][2]
    return NamedRecord(safe_name(name), digits, declaration), refused


def _with(declaration: DeclaredFormat, key: str, text: str) -> DeclaredFormat:
    """Add what one field says. Raises SessionError, ValueError."""
    role = key.removeprefix(COLUMN)
    if key.startswith(COLUMN) and role in ROLES:
        changed = replace(declaration, columns={**declaration.columns, role: text})
    elif key in STATEMENTS:
        part, read, takes = STATEMENTS[key]
        changed = replace(declaration, **{part: read(text)})
    else:
        raise SessionError("there is no such part of a record")
    try:
        return read_declaration({**vars(changed), "columns": dict(changed.columns)})
    except SessionError:
        raise SessionError(takes if key in STATEMENTS else "takes the name of a column") from None
