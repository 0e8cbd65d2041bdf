"""File formats of records: each a small module with `read` and `write`, and one table from name to format.

A format turns a file into columns and named arrays, and back; their meaning is checked
in one place, `wfsobs.telemetry.intake`. A new format is one more module and one more line here.
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import IO

from wfsobs.record import RecordError
from wfsobs.telemetry.formats import aot, csv, fits, libraries, npz
from wfsobs.telemetry.formats.contents import APART, STARS, FileColumns, read_at_most
from wfsobs.typing import Array


@dataclass(frozen=True)
class Format:
    """A file format.

    Attributes
    ----------
    endings : tuple of str
        Endings of file names.
    read : callable
        (open file, maximum bytes of numbers) -> FileColumns, under the file's own names.
    write : callable or None
        (open file, arrays) -> None; None of a format that is only read.
    omits : tuple of str
        Parts of a record that have no place in what it writes.
    """

    endings: tuple[str, ...]
    read: Callable[[IO[bytes], int], FileColumns]
    write: Callable[[IO[bytes], Mapping[str, Array]], None] | None = None
    omits: tuple[str, ...] = ()


FORMATS = (
    Format((".npz",), npz.read, npz.write),
    Format((".csv", ".txt", ".dat", ".tsv", ".asc"), csv.read, csv.write, (STARS, APART)),
    Format((".aot.fits",), aot.read, aot.write, ("open_loop_y", STARS, APART, "turbulence", "vibration", "training")),
    Format((".fits", ".fit", ".fts"), aot.read_fits, fits.write, (STARS, APART)),
    Format((".h5", ".hdf5", ".hdf", ".he5"), libraries.read_hdf5, libraries.write_hdf5),
    Format((".mat",), libraries.read_matlab, libraries.write_matlab),
    Format((".parquet", ".pq"), libraries.read_parquet, libraries.write_parquet, (STARS, APART)),
    Format((".npy",), npz.read_npy),
    Format((".sav", ".idl"), libraries.read_sav),
)


WRITTEN = tuple(ending for fmt in FORMATS if fmt.write for ending in fmt.endings)
"""Endings of formats that are not only read."""


def format_of(name: str) -> Format:
    """Return the format of a file name, by its ending. Raises RecordError."""
    for fmt in FORMATS:
        if name.lower().endswith(fmt.endings):
            return fmt
    raise RecordError(f"its name ends in none of {', '.join(ending for fmt in FORMATS for ending in fmt.endings)}")


def from_gzip(file: IO[bytes], most: int) -> IO[bytes]:
    """Return the content of an open gzip file. Raises RecordError where it is damaged, TooLargeError beyond `most` bytes."""
    try:
        with gzip.open(file) as packed:
            return io.BytesIO(read_at_most(packed, most))
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise RecordError(f"cannot be unpacked: {error}") from None


def writer_of(name: str) -> Callable[[IO[bytes], Mapping[str, Array]], None]:
    """Return what writes the format of a file name. Raises RecordError, also of formats that are only read."""
    for fmt in FORMATS:
        if fmt.write and name.lower().endswith(fmt.endings):
            return fmt.write
    raise RecordError(f"its name ends in none of {', '.join(WRITTEN)}")
