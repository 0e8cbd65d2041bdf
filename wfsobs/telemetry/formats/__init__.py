"""File formats of records: each a small module with `read` and `write`, one table from name to format.

A format turns a file into named arrays and back (`Contents`); what they mean and whether they make a record is checked
in one place, `wfsobs.telemetry.records`. A new format is one more module and one more line here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import IO

from wfsobs.record import RecordError
from wfsobs.telemetry.formats import aot, csv, fits, npz
from wfsobs.telemetry.formats.contents import Contents
from wfsobs.typing import Array


@dataclass(frozen=True)
class Format:
    """endings : of file names; read : (open file, most bytes of numbers) -> Contents; write : (open file, arrays)."""

    endings: tuple[str, ...]
    read: Callable[[IO[bytes], int], Contents]
    write: Callable[[IO[bytes], Mapping[str, Array]], None]


FORMATS = (
    Format((".npz",), npz.read, npz.write),
    Format((".csv", ".txt"), csv.read, csv.write),
    Format((".aot.fits",), aot.read, aot.write),
    Format((".fits", ".fit", ".fts"), fits.read, fits.write),  # reads AOT as well, which says so inside
)


def format_of(name: str) -> Format:
    """The format that a file name asks for by its ending. Raises RecordError."""
    for fmt in FORMATS:
        if name.lower().endswith(fmt.endings):
            return fmt
    raise RecordError(f"its name ends in none of {', '.join(ending for fmt in FORMATS for ending in fmt.endings)}")
