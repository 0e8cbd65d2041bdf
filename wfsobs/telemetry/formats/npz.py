"""Records as numpy's `.npz`, one array per name. Nothing is unpickled, and nothing grows beyond its limit."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from typing import IO

import numpy as np
from numpy.lib import format as npy

from wfsobs.record import RecordError
from wfsobs.telemetry.formats.contents import NAMES, NUMBERS, TEXTS, Contents, FileColumns, TooLargeError
from wfsobs.typing import Array

KINDS = "fiuUb"
"""Kinds of array that are read: numbers, text, booleans. No objects, so no pickles."""

DAMAGED = "damaged, or holds more than plain arrays"
HEADER = 10_000
"""Maximum header of an array [bytes]."""


def read(file: IO[bytes], most: int) -> Contents:
    """Read the arrays of known names, and no others. Raises RecordError, and TooLargeError before the memory is used."""
    return Contents(_arrays(file, most, NAMES))


def columns(file: IO[bytes], most: int) -> FileColumns:
    """Read the columns of every array, whatever its name. Raises as `read`."""
    out = FileColumns()
    for name, values in _arrays(file, most).items():
        if name in (*NUMBERS, *TEXTS):
            out.plain[name] = values
        else:
            out.add(name, values)
    return out


def _arrays(file: IO[bytes], most: int, names: Iterable[str] | None = None) -> dict[str, Array]:
    """Return the arrays of these names, of all names by default."""
    if not zipfile.is_zipfile(file):
        raise RecordError("not an .npz file; a record is an .npz with y_lgs, u and dt")
    try:
        with zipfile.ZipFile(file) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            known = {name: members[name] for name in names or members if name in members}
            if sum(info.file_size for info in known.values()) > most:
                raise TooLargeError(most)
            return {name: _array(_member(archive, info), name) for name, info in known.items()}
    except RecordError:
        raise
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error, KeyError, RuntimeError, NotImplementedError, MemoryError):
        raise RecordError(DAMAGED) from None


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """Return the bytes of a member, at most the size in the directory: a read without a size would unpack everything."""
    with archive.open(info) as stream:
        return stream.read(info.file_size)


def _array(content: bytes, name: str) -> Array:
    """Return an array whose header agrees with the data after it."""
    stream = io.BytesIO(content)
    version = npy.read_magic(stream)
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, fortran, dtype = read_header(stream, max_header_size=HEADER)
    if dtype.hasobject or dtype.kind not in KINDS:
        raise RecordError(DAMAGED if dtype.hasobject else f"{name} holds {dtype}, not numbers")
    count = 1
    for length in shape:
        count *= length
    if count * dtype.itemsize != len(content) - stream.tell():
        raise RecordError(f"{name} is not as long as its header says")
    values = np.frombuffer(content, dtype, count, stream.tell())
    return values.reshape(shape, order="F" if fortran else "C")


def write(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write the arrays, compressed."""
    np.savez_compressed(file, allow_pickle=False, **dict(arrays))
