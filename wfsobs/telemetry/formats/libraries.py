"""Records in the files of other programs, through the library made for each: MATLAB, HDF5, IDL and Parquet.

Sizes are known before anything grows. Objects, references, links and data kept in other files are left out, with the reason.
"""

from __future__ import annotations

import io
import json
import os
import struct
import subprocess
import sys
import tempfile
import warnings
import zlib
from collections.abc import Iterator, Mapping
from math import prod
from typing import IO, Any

import numpy as np

from wfsobs.record import RecordError
from wfsobs.telemetry.formats.contents import (
    DEEPEST,
    FAST,
    NUMBERS,
    STAMP,
    TEXTS,
    UNIT,
    FileColumns,
    TooLargeError,
    import_library,
    is_rate,
    numbers_and_texts,
    parse_cell,
    read_at_most,
    refuse_damage,
    texts_of,
    to_columns,
    unit_among,
)
from wfsobs.typing import Array

HDF5 = b"\x89HDF\r\n\x1a\n"
USERBLOCK = 512
"""Bytes before the HDF5 of a MATLAB file of version 7.3."""

LONGEST_READING = 600.0
"""Time that a file is given to be read [s]."""

MOST_PARTS = 1000
"""Maximum arrays of a file."""

MATRIX, PACKED = 14, 15
"""Types of an element of a MATLAB file."""

STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Types of numbers in it -> numpy's."""

STRUCT, TEXT, NUMBERS_OR_TEXT, OBJECT, COMPLEX = 2, 4, {4, *range(6, 16)}, 17, 0x800
CLASSES = {1: "cell", 2: "struct", 3: "object", 5: "sparse matrix", 16: "function", OBJECT: "object"}
"""Classes of its arrays, and a flag."""


# ---------------------------------------------------------------------- MATLAB


def read_matlab(file: IO[bytes], most: int) -> FileColumns:
    """Read the arrays of a MATLAB file and the fields of its structures. Raises RecordError, TooLargeError.

    Version 5 is read here: scipy may end the process at a damaged one.
    """
    head = file.read(USERBLOCK + len(HDF5))
    if head.endswith(HDF5) or head.startswith(HDF5):
        return read_hdf5(file, most, ".")
    out, content = FileColumns(most=most), read_at_most(file, most)
    with refuse_damage("damaged, or not a MATLAB file"):
        if (order := {b"IM": "<", b"MI": ">"}.get(content[126:128])) is None:
            _add_version_4(out, content)
        else:
            for kind, body in _elements(memoryview(content)[128:], order):
                if kind == PACKED:
                    unpacked = zlib.decompressobj().decompress(body, most + 1)
                    if len(unpacked) > most:
                        raise TooLargeError(most)
                    kind, body = next(_elements(memoryview(unpacked), order))
                if kind == MATRIX:
                    _add_matrix(out, body, order)
    return out


def _add_version_4(out: FileColumns, content: bytes) -> None:
    from scipy.io import matlab

    source: Any = io.BytesIO(content)
    try:
        if matlab.matfile_version(source)[0] != 0:  # of a version 5 that is damaged
            raise ValueError(content[:128])
        arrays = matlab.loadmat(source)
    except matlab.MatReadError as error:
        raise ValueError(str(error)) from None
    for name, values in arrays.items():
        if not name.startswith("__"):
            out.add(name, values)


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield the type and the bytes of every element of MATLAB's version 5."""
    place = 0
    while place + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, place)
        if kind >> 16:  # small: its bytes are in the place of the size
            yield kind & 0xFFFF, content[place + 4 : place + 4 + min(kind >> 16, 4)]
            size = 0
        else:
            yield kind, content[place + 8 : place + 8 + size]
        place += 8 + size + (-size % 8 if kind != PACKED else 0)


def _add_matrix(out: FileColumns, body: memoryview, order: str, name: str = "") -> None:
    """Add an array, or the fields of a structure; name : of a field, which has none of its own."""
    parts = _elements(body, order)
    (flags,) = struct.unpack_from(f"{order}I", next(parts)[1])
    kind = flags & 0xFF
    shape = () if kind == OBJECT else tuple(np.frombuffer(next(parts)[1], f"{order}i4").tolist())
    name = bytes(next(parts)[1]).decode("latin-1") or name
    if not name:  # what its objects are made of
        return
    if kind == STRUCT and prod(shape) == 1 and name.count(".") < DEEPEST:
        (length,) = struct.unpack_from(f"{order}i", next(parts)[1])
        names = bytes(next(parts)[1])
        for place, (_, field) in zip(range(0, len(names), length), parts, strict=False):
            key = names[place : place + length].partition(b"\0")[0].decode("latin-1")
            _add_matrix(out, field, order, f"{name}.{key}")
    elif kind in NUMBERS_OR_TEXT and not flags & COMPLEX:
        stored, data = next(parts, (1, b""))
        if kind == TEXT:
            text = bytes(data).decode({16: "utf-8", 4: f"utf-16{'lb'[order == '>']}e", 17: "utf-16"}.get(stored, "latin-1"))
            rows = [text[row :: shape[0]] for row in range(shape[0])] if len(shape) == 2 else [text]
            out.add(name, np.array(rows, dtype=str))
            return
        out.add(name, np.frombuffer(data, order + STORED[stored]).reshape(shape, order="F"))
    else:
        what = CLASSES.get(kind, "array of complex numbers")
        out.leave(name, f"{name} is a MATLAB {what}, which is not read: save it as arrays of numbers")


def write_matlab(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write the arrays as a MATLAB file of version 5."""
    from scipy.io import savemat

    content: Any = io.BytesIO()
    savemat(content, dict(arrays), do_compression=True)
    file.write(content.getvalue())


# ---------------------------------------------------------------------- HDF5

DAMAGED = "damaged, or not an HDF5 file"


def read_hdf5(file: IO[bytes], most: int, separator: str = "/") -> FileColumns:
    """Read the arrays of an HDF5 file under their paths, of MATLAB with the axes as it shows them. Raises RecordError.

    separator : what stands between the names of a path
    This is done in a process of its own, since the HDF5 library may end it at a damaged file.
    """
    out, content = FileColumns(), read_at_most(file, most)
    command = [sys.executable, "-c", f"import {__name__} as of; of.send_hdf5({most})"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with refuse_damage(DAMAGED, subprocess.SubprocessError):
        done = subprocess.run(command, input=content, capture_output=True, timeout=LONGEST_READING, env=environment, check=True)
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
            said = json.loads(str(found["said"]))
            arrays = {key: found[key] for key in found}
    if said["error"]:
        raise TooLargeError(most) if said["error"] == "large" else RecordError(said["error"])
    for i, (path, text) in enumerate(said["parts"]):
        name = path.replace("/", separator)
        if (key := f"part {i}") in arrays:
            out.add(name, arrays[key], text)
        else:
            out.leave(name, text)
    return out


Part = tuple[str, object, str]
"""Name, values and unit, or for what is left out name, None and the reason."""


def send_hdf5(most: int) -> None:
    """Write what the HDF5 file on the standard input holds to the standard output, as `.npz`."""
    parts, arrays, error = list[tuple[str, str]](), dict[str, Array](), ""
    try:
        for name, values, text in _read_parts(io.BytesIO(sys.stdin.buffer.read()), most):
            if values is not None:
                arrays[f"part {len(parts)}"] = np.asarray(values)
            parts.append((name, text))
    except TooLargeError:
        error = "large"
    except RecordError as refusal:
        error = str(refusal)
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, said=np.array(json.dumps({"error": error, "parts": parts})), **arrays)
    sys.stdout.buffer.write(content.getvalue())


def _read_parts(file: IO[bytes], most: int) -> Iterator[Part]:
    h5py = import_library("h5py", "hdf5")
    room, paths = most, ["/"]
    with refuse_damage(DAMAGED), h5py.File(file, "r") as source:
        for count, path in enumerate(paths):
            if count > MOST_PARTS:  # also where a group is within itself
                raise RecordError(f"has more than {MOST_PARTS} groups and arrays")
            item = source[path]
            yield from _attributes(item, isinstance(item, h5py.Group))
            if isinstance(item, h5py.Dataset):
                room -= max(item.size or 0, prod(item.chunks or ())) * max(item.dtype.itemsize, 8)
                if room < 0:
                    raise TooLargeError(most)
                is_text = h5py.check_string_dtype(item.dtype) is not None and item.size == 1
                yield _dataset(path[1:], item, is_text or not item.dtype.hasobject)
            elif isinstance(item, h5py.Group):
                for name in item:
                    if isinstance(item.get(name, getlink=True), h5py.HardLink):
                        paths.append(f"{path.rstrip('/')}/{name}")
                    else:
                        yield name, None, f"{name} is a link, which is not followed"


def _attributes(item: Any, is_group: bool) -> Iterator[Part]:
    """Yield the numbers and texts of a record, or its rate, that the root states, and those that only other parts do."""
    where = f"{item.name}/".lstrip("/")
    for key in item.attrs:
        is_text = (key.lower() in TEXTS and not where) or (UNIT.fullmatch(key) is not None and is_group)
        if not is_text and ((where and key in item.file.attrs) or item.attrs.get_id(key).shape not in ((), (1,))):
            continue
        if is_text:
            yield f"{where}{key}", texts_of(item.attrs[key]), ""
        elif key.lower() in NUMBERS or is_rate(key):
            yield key if key.lower() in NUMBERS else f"{where}{key}", item.attrs[key], ""


def _dataset(name: str, item: Any, is_plain: bool) -> Part:
    if item.external or item.is_virtual:
        return name, None, f"{name} lies in another file, which is not opened"
    if item.shape is None or not is_plain:
        return name, None, f"{name} holds objects or references, not numbers"
    values, of_matlab = item[()], _text(item.attrs.get("MATLAB_class", ""))
    if item.attrs.get("MATLAB_empty"):  # the numbers are its sizes
        values = values[:0]
    if item.dtype.hasobject:
        values = _text(np.ravel(values)[0])
    if of_matlab == "char":
        values = "".join(map(chr, np.transpose(values).ravel().tolist()))
    unit = unit_among({key: item.attrs[key] for key in item.attrs if UNIT.fullmatch(key)})
    return name, np.transpose(values) if of_matlab else values, unit


def _text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value if isinstance(value, str) else ""


def write_hdf5(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write the arrays as HDF5, numbers and texts among them."""
    h5py, content = import_library("h5py", "hdf5"), io.BytesIO()
    with h5py.File(content, "w") as out:
        for name, values in arrays.items():
            text = values.dtype.kind == "U"
            out.create_dataset(name, data=np.bytes_(str(values).encode()) if text else values)
    file.write(content.getvalue())


# ---------------------------------------------------------------------- IDL


def read_sav(file: IO[bytes], most: int) -> FileColumns:
    """Read the variables of an IDL save file and the fields of its structures. Raises RecordError, TooLargeError."""
    from scipy.io import readsav

    out, content, is_whole = FileColumns(), read_at_most(file, most), False
    with warnings.catch_warnings(), tempfile.NamedTemporaryFile() as copy:
        warnings.simplefilter("ignore")
        try:
            _check_sav(content, most)
            copy.write(content)
            copy.flush()
            for name, values in readsav(copy.name, python_dict=True).items():
                out.add(name, values)
            is_whole = True
        except RecordError:
            raise
        except Exception:  # scipy raises bare ones
            pass
    if not is_whole:  # here, for scipy leaves the file open to its traceback
        raise RecordError("damaged, or not a save file of IDL")
    return out


def _check_sav(content: bytes, most: int) -> None:
    """Check what a save file unpacks to: a record begins with its kind and where the next one is."""
    place, room = 4, most
    while content[2:4] == b"\x00\x06" and place + 16 <= len(content):
        low, high = struct.unpack_from(">II", content, place + 4)
        following = low + (high << 32)
        if struct.unpack_from(">i", content, place)[0] == LAST_RECORD or following <= place:
            break
        packed = zlib.decompressobj()
        data = content[place + 16 : following]
        while data and not packed.eof:
            room -= len(packed.decompress(data, UNPACKED))
            data = packed.unconsumed_tail
            if room < 0:
                raise TooLargeError(most)
        place = following


LAST_RECORD = 6
UNPACKED = 1 << 20
"""Bytes that are unpacked at once."""


# ---------------------------------------------------------------------- Parquet


def read_parquet(file: IO[bytes], most: int) -> FileColumns:
    """Read the columns of a Parquet file, and lists of one length as columns each. Raises RecordError, TooLargeError."""
    pyarrow, parquet = import_library("pyarrow", "campaign"), import_library("pyarrow.parquet", "campaign")
    out, types = FileColumns(), pyarrow.types
    file.seek(0)
    with refuse_damage("damaged, or not a Parquet file", pyarrow.ArrowException):
        source = parquet.ParquetFile(pyarrow.PythonFile(file, mode="r"))
        groups = [source.metadata.row_group(i) for i in range(source.num_row_groups)]
        if 8 * sum(group.column(j).num_values for group in groups for j in range(group.num_columns)) > most:
            raise TooLargeError(most)
        for key, value in (source.schema_arrow.metadata or {}).items():
            name = key.decode("utf-8", "replace").strip().lower()
            if name in (*NUMBERS, *TEXTS) or UNIT.fullmatch(name):
                out.add(name, float(value) if name in NUMBERS else value)
        for field in source.schema_arrow:
            of = field.type.value_type if types.is_list(field.type) or types.is_fixed_size_list(field.type) else field.type
            alone = of is field.type and (types.is_timestamp(of) or types.is_string(of))
            if not (types.is_integer(of) or types.is_floating(of) or alone):
                out.leave(field.name, f"{field.name} holds {str(field.type)[:40]}, not numbers")
                continue
            column = source.read([field.name]).column(0)
            unit = unit_among({key.decode("utf-8", "replace"): value for key, value in (field.metadata or {}).items()})
            _add_column(out, field.name, column.combine_chunks(), of is not field.type, unit)
    return out


def _add_column(out: FileColumns, name: str, column: Any, is_list: bool, unit: str) -> None:
    """Add a column of Arrow, whose nulls are missing samples; without those that end what may be shorter than the record.

    That begins with a sample, as frames in rows of their own do, and frames in the rows of fast steps do not.
    """
    valid = np.asarray(column.is_valid())
    if name.lower() not in FAST and valid[:1].all():
        valid = valid[: np.flatnonzero(valid).max(initial=-1) + 1]
        column = column.slice(0, len(valid))
    if is_list:
        lengths = np.unique(column.value_lengths().drop_null())
        if lengths.size > 1:
            return out.leave(name, f"{name} holds lists of {lengths[0]} to {lengths[-1]} numbers; it takes lists of one length")
        values = np.full((len(valid), lengths.max(initial=0)), np.nan)
        values[valid] = column.flatten().to_numpy(zero_copy_only=False).reshape(valid.sum(), values.shape[1])
    elif column.type == "string":
        if valid.any() and not STAMP.fullmatch(column.drop_null()[0].as_py().strip()):
            return out.leave(name, f"{name} holds text, not numbers")
        return out.add(name, np.array([parse_cell(x or "") for x in column.to_pylist()]), "s")
    else:
        values = column.to_numpy(zero_copy_only=False)
    out.add(name, values, unit)


def write_parquet(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write the arrays as columns, those that end early with nulls, numbers and texts as metadata."""
    pyarrow, parquet = import_library("pyarrow", "campaign"), import_library("pyarrow.parquet", "campaign")
    columns = {name: np.asarray(values, dtype=np.float64) for name, values in to_columns(arrays).items()}
    n = max(map(len, columns.values()), default=0)
    padded = {name: pyarrow.array(np.pad(x, (0, n - len(x))), mask=np.arange(n) >= len(x)) for name, x in columns.items()}
    said = {name: value if isinstance(value, str) else repr(value) for name, value in numbers_and_texts(arrays).items()}
    parquet.write_table(pyarrow.table(padded).replace_schema_metadata(said), file)
