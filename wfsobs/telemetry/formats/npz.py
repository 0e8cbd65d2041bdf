"""Records as numpy's `.npz`, one array per name. Nothing is unpickled, and nothing grows beyond its limit."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from typing import IO

import numpy as np
from numpy.lib import format as npy

from wfsobs.record import RecordError
from wfsobs.telemetry.formats.contents import DAMAGES, NAMES, FileColumns, TooLargeError, refuse_damage
from wfsobs.typing import Array

DAMAGED = "damaged, or holds more than plain arrays"
LARGE, PACKED = 100_000_000, 200
"""Bytes from which arrays are not unpacked where they are packed in so many times less: those of noise hardly shrink."""

HEADER = 10_000
"""Maximum header of an array [bytes]."""


def read(file: IO[bytes], most: int) -> FileColumns:
    """Read the arrays of known names, and those of others that are columns or texts, as far as there is room.

    Raises RecordError, and TooLargeError before the memory is used.
    """
    if not zipfile.is_zipfile(file):
        raise RecordError("not an .npz file; a record is an .npz with y_lgs, u and dt")
    out = FileColumns(most=most)
    with refuse_damage(DAMAGED), zipfile.ZipFile(file) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        known = {name: info for name, info in members.items() if name.lower() in NAMES}
        size, packed = (sum(getattr(info, what) for info in known.values()) for what in ("file_size", "compress_size"))
        if (room := most - size) < 0:
            raise TooLargeError(most)
        if size > LARGE and size > PACKED * packed:
            raise RecordError(f"unpacks from {packed / 1e6:.3g} to {size / 1e6:.4g} MB, as no measurements do")
        for name, info in (known | members).items():
            if name not in known:
                if info.file_size > room or not _is_table(archive, info):
                    continue
                room -= info.file_size
            with archive.open(info) as stream:
                out.add(name, _values(stream, info.file_size, name))
    return out


def _is_table(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bool:
    """Return whether a member holds numbers, times or texts in three dimensions at most, or fields of them."""
    try:
        with archive.open(info) as stream:
            shape, _, dtype = _header(stream)
    except DAMAGES:
        return False
    return dtype.kind in "fiuMVSU" and not dtype.hasobject and len(shape) <= 3


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, order (True: Fortran's) and type."""
    read_header = npy.read_array_header_1_0 if npy.read_magic(stream) == (1, 0) else npy.read_array_header_2_0
    return read_header(stream, max_header_size=HEADER)


def _values(stream: IO[bytes], length: int, name: str) -> Array:
    """Return an array whose header agrees with the length of its file: a read without a size would unpack everything."""
    shape, fortran, dtype = _header(stream)
    if dtype.hasobject:
        raise RecordError(DAMAGED)
    size = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or size != length - stream.tell():
        raise RecordError(f"{name} is damaged: not as long as its header says")
    values = np.frombuffer(stream.read(size), dtype, math.prod(shape))
    return values.reshape(shape, order="F" if fortran else "C")


def read_npy(file: IO[bytes], most: int) -> FileColumns:
    """Read one array, whose columns are array[0], array[1], ... Raises RecordError, TooLargeError."""
    out, length = FileColumns(most=most), file.seek(0, 2)
    if length > most:
        raise TooLargeError(most)
    file.seek(0)
    with refuse_damage(DAMAGED):
        values = _values(file, length, "array")
        if 8 * values.size > most:
            raise TooLargeError(most)
        out.add("array", values)
    return out


def write(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write the arrays, compressed."""
    np.savez_compressed(file, allow_pickle=False, **dict(arrays))
