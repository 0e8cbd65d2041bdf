"""Records in the files of other programs, through the library made for each: MATLAB, HDF5, IDL and Parquet.

Sizes are known before anything grows. Objects, references, links and data kept in other files are left out, with the reason.
"""

from __future__ import annotations

import io
import struct
import tempfile
import warnings
import zlib
from collections.abc import Iterable, Mapping
from importlib import import_module
from math import prod
from typing import IO, Any

import numpy as np

from wfsobs.record import RecordError
from wfsobs.telemetry.formats.contents import (
    NUMBERS,
    STAMP,
    TEXTS,
    FileColumns,
    TooLargeError,
    is_rate,
    numbers_and_texts,
    parse_cell,
    to_columns,
)
from wfsobs.typing import Array

HDF5 = b"\x89HDF\r\n\x1a\n"
USERBLOCK = 512
"""Bytes before the HDF5 of a MATLAB file of version 7.3."""

WRONG = (OSError, ValueError, TypeError, LookupError, RuntimeError, MemoryError, AttributeError, ArithmeticError)
"""What libraries raise of a damaged file."""

MOST_PARTS = 1000
"""Maximum arrays of a file."""

PACKED = 15
"""Type of a packed element of a MATLAB file."""


def _import(name: str, extra: str) -> Any:
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise RecordError(f"files of this kind need {error.name}; install wfsobs with its extra: wfsobs[{extra}]") from None


# ---------------------------------------------------------------------- MATLAB


def read_matlab(file: IO[bytes], most: int) -> FileColumns:
    """Read the arrays of a MATLAB file and the fields of its structures. Raises RecordError, TooLargeError."""
    head = file.read(USERBLOCK + len(HDF5))
    if head.endswith(HDF5) or head.startswith(HDF5):
        return read_hdf5(file, most)
    from scipy.io import matlab

    def opened() -> Any:
        return io.BytesIO(content)

    file.seek(0)
    out = FileColumns()
    try:
        content = _unpack_mat(file.read(most + 1), most)
        for name, shape, kind in matlab.whosmat(opened()):
            if kind in ("cell", "object", "opaque", "function", "sparse", "unknown") or (kind == "struct" and prod(shape) != 1):
                out.leave(name, f"{name} is a MATLAB {kind} of shape {shape}, which is not read: save it as arrays of numbers")
            else:
                out.add(name, matlab.loadmat(opened(), variable_names=[name])[name])
    except RecordError:
        raise
    except (*WRONG, matlab.MatReadError, zlib.error, struct.error):
        raise RecordError("damaged, or not a MATLAB file") from None
    return out


def _unpack_mat(content: bytes, most: int) -> bytes:
    """Return a MATLAB file of version 5 with no packed element: what it unpacks to is bounded here."""
    if len(content) > most:
        raise TooLargeError(most)
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:  # of version 4, which packs nothing
        return content
    parts, place = [content[:128]], 128
    while place + 8 <= len(content) and len(parts) < MOST_PARTS:
        kind, size = struct.unpack_from(f"{order}II", content, place)
        element = content[place : place + 8 + size + (-size % 8 if kind != PACKED else 0)]
        place += len(element)
        if kind == PACKED:
            room = most - sum(map(len, parts))
            element = zlib.decompressobj().decompress(element[8:], max(room, 0) + 1)
            if len(element) > room:
                raise TooLargeError(most)
        parts.append(element)
    return b"".join(parts)


def write_matlab(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write the arrays as a MATLAB file of version 5."""
    from scipy.io import savemat

    content: Any = io.BytesIO()
    savemat(content, dict(arrays), do_compression=True)
    file.write(content.getvalue())


# ---------------------------------------------------------------------- HDF5


def read_hdf5(file: IO[bytes], most: int) -> FileColumns:
    """Read the arrays of an HDF5 file under their paths, of MATLAB with the axes as it shows them. Raises RecordError."""
    h5py = _import("h5py", "hdf5")
    out, room, paths = FileColumns(), most, ["/"]
    file.seek(0)
    try:
        with h5py.File(file, "r") as source:
            for count, path in enumerate(paths):
                if count > MOST_PARTS:  # also where a group is within itself
                    raise RecordError(f"has more than {MOST_PARTS} groups and arrays")
                item = source[path]
                _add_attributes(out, item)
                if isinstance(item, h5py.Dataset):
                    room -= max(item.size or 0, prod(item.chunks or ())) * max(item.dtype.itemsize, 8)
                    if room < 0:
                        raise TooLargeError(most)
                    is_text = h5py.check_string_dtype(item.dtype) is not None and item.size == 1
                    _add_dataset(out, path[1:], item, is_text or not item.dtype.hasobject)
                elif isinstance(item, h5py.Group):
                    for name in item:
                        if isinstance(item.get(name, getlink=True), h5py.HardLink):
                            paths.append(f"{path.rstrip('/')}/{name}")
                        else:
                            out.leave(name, f"{name} is a link, which is not followed")
    except RecordError:
        raise
    except WRONG:
        raise RecordError("damaged, or not an HDF5 file") from None
    return out


def _add_attributes(out: FileColumns, item: Any) -> None:
    """Add the numbers and texts of a record, or its rate, among the attributes of a group or of an array."""
    for key in item.attrs:
        is_text = key.lower() in TEXTS and item.name == "/"
        if (is_text or key.lower() in NUMBERS or is_rate(key)) and item.attrs.get_id(key).shape in ((), (1,)):
            out.add(key, item.attrs[key])


def _add_dataset(out: FileColumns, name: str, item: Any, is_plain: bool) -> None:
    if item.external or item.is_virtual:
        out.leave(name, f"{name} lies in another file, which is not opened")
    elif item.shape is None or not is_plain:
        out.leave(name, f"{name} holds objects or references, not numbers")
    else:
        values, of_matlab = item[()], _text(item.attrs.get("MATLAB_class", ""))
        if of_matlab == "char":
            values = "".join(map(chr, np.transpose(values).ravel().tolist()))
        out.add(name, np.transpose(values) if of_matlab else values, _text(item.attrs.get("units", item.attrs.get("unit", ""))))


def _text(value: object) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value if isinstance(value, str) else ""


def write_hdf5(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write the arrays as HDF5, numbers and texts among them."""
    h5py, content = _import("h5py", "hdf5"), io.BytesIO()
    with h5py.File(content, "w") as out:
        for name, values in arrays.items():
            text = values.dtype.kind == "U"
            out.create_dataset(name, data=np.bytes_(str(values).encode()) if text else values)
    file.write(content.getvalue())


# ---------------------------------------------------------------------- IDL


def read_sav(file: IO[bytes], most: int) -> FileColumns:
    """Read the variables of an IDL save file and the fields of its structures. Raises RecordError, TooLargeError."""
    from scipy.io import readsav

    out, content, found = FileColumns(), file.read(most + 1), None
    with warnings.catch_warnings(), tempfile.NamedTemporaryFile() as copy:
        warnings.simplefilter("ignore")
        try:
            _check_sav(content, most)
            copy.write(content)
            copy.flush()
            found = readsav(copy.name, python_dict=True)
        except RecordError:
            raise
        except Exception:  # scipy raises bare ones
            pass
    if found is None:  # here, for scipy leaves the file open to its traceback
        raise RecordError("damaged, or not a save file of IDL")
    for name, values in found.items():
        out.add(name, values)
    return out


def _check_sav(content: bytes, most: int) -> None:
    """Check what a save file unpacks to: a record begins with its kind and where the next one is."""
    if len(content) > most:
        raise TooLargeError(most)
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
    pyarrow, parquet = _import("pyarrow", "campaign"), _import("pyarrow.parquet", "campaign")
    out, types = FileColumns(), pyarrow.types
    file.seek(0)
    try:
        source = parquet.ParquetFile(pyarrow.PythonFile(file, mode="r"))
        groups = [source.metadata.row_group(i) for i in range(source.num_row_groups)]
        if 8 * sum(group.column(j).num_values for group in groups for j in range(group.num_columns)) > most:
            raise TooLargeError(most)
        for key, value in (source.schema_arrow.metadata or {}).items():
            if (name := key.decode("utf-8", "replace")) in (*NUMBERS, *TEXTS):
                out.add(name, float(value) if name in NUMBERS else value)
        for field in source.schema_arrow:
            of = field.type.value_type if types.is_list(field.type) or types.is_fixed_size_list(field.type) else field.type
            if not (types.is_integer(of) or types.is_floating(of) or types.is_timestamp(of) or types.is_string(of)):
                out.leave(field.name, f"{field.name} holds {str(field.type)[:40]}, not numbers")
                continue
            column = source.read([field.name]).column(0)
            _add_column(out, field.name, column.combine_chunks(), of is not field.type)
    except RecordError:
        raise
    except (*WRONG, pyarrow.ArrowException):
        raise RecordError("damaged, or not a Parquet file") from None
    return out


def _add_column(out: FileColumns, name: str, column: Any, is_list: bool) -> None:
    """Add a column of Arrow, without the nulls that end it; those before are missing samples."""
    valid = np.flatnonzero(column.is_valid())
    column = column.slice(0, valid[-1] + 1 if valid.size else 0)
    n = len(column)
    if is_list:
        column = column.flatten()
    if n and column.type == "string":
        texts: Iterable[str] = (str(x.as_py()) for x in column)
        if not STAMP.fullmatch(next(iter(texts)).strip()):
            out.leave(name, f"{name} holds text, not numbers")
            return
        out.add(name, np.array([parse_cell(str(x.as_py() or "")) for x in column]), "s")
    elif n and len(column) % n == 0:
        values = column.to_numpy(zero_copy_only=False)
        out.add(name, values.reshape(n, -1) if is_list else values)


def write_parquet(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write the arrays as columns, those that end early with nulls, numbers and texts as metadata."""
    pyarrow, parquet = _import("pyarrow", "campaign"), _import("pyarrow.parquet", "campaign")
    columns = {name: np.asarray(values, dtype=np.float64) for name, values in to_columns(arrays).items()}
    n = max(map(len, columns.values()), default=0)
    padded = {name: pyarrow.array(np.pad(x, (0, n - len(x))), mask=np.arange(n) >= len(x)) for name, x in columns.items()}
    said = {name: value if isinstance(value, str) else repr(value) for name, value in numbers_and_texts(arrays).items()}
    parquet.write_table(pyarrow.table(padded).replace_schema_metadata(said), file)
