"""Records as FITS, through astropy (the extra wfsobs[fits]).

It reads binary tables, their columns named as the arrays (y_lgs with one element per mode) or as in CSV (y_lgs/tip_um), and
images whose EXTNAME is an array's name; units from TUNITn or BUNIT. It writes a table RECORD, and a table TRAINING.
FITS is big-endian and may scale integers: both are undone here.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import IO, Any

import numpy as np

from wfsobs.record import RecordError
from wfsobs.telemetry.formats.contents import (
    CLOCKS,
    NUMBERS,
    SIGNALS,
    TRAINING,
    Contents,
    FileColumns,
    TooLargeError,
    from_columns,
    numbers_and_texts,
)
from wfsobs.typing import Array

HDUList = Any
"""Astropy's, which is imported only when needed."""

KEYWORDS = {"dt": "DT", "ratio": "RATIO", "delay": "DELAY", "command_sign": "CMDSIGN", "unit": "BUNIT", "origin": "STATED"}
EXACT = "DTEXACT"
"""The time step as text: a number in a header has sixteen digits, one less than needed."""

AOT = "AOT-VERS"
"""Keyword of an AOT file."""

DAMAGED = "damaged, or not a FITS file of tables and images"
MOST_HDUS = 200


def columns(file: IO[bytes], most: int) -> FileColumns:
    """Read every column of the tables and images, whatever its name. Raises RecordError, TooLargeError."""
    fits = astropy_fits()
    out = FileColumns()
    with open_fits(file, most) as hdus:
        if AOT in hdus[0].header:
            raise RecordError("columns of an AOT file have names of their own")
        for number, hdu in enumerate(hdus):
            out.plain |= {key: value for key, value in _plain(hdu).items() if key != "unit"}  # of one image alone
            if isinstance(hdu, fits.BinTableHDU):
                for column in hdu.columns:
                    if "P" not in column.format and "Q" not in column.format and hdu.data[column.name].dtype.kind in "fiu":
                        out.add(column.name, _native(hdu.data[column.name], column.name, column.null), column.unit or "")
            elif hdu.data is not None and hdu.data.dtype.kind in "fiu":
                name = hdu.name or f"image {number}"
                out.add(name, _native(hdu.data, name, hdu.header.get("BLANK")), str(hdu.header.get("BUNIT", "")))
    return out


def astropy_fits() -> Any:
    """Return astropy.io.fits. Raises RecordError naming the extra where it is not installed."""
    try:
        from astropy.io import fits
    except ModuleNotFoundError:
        raise RecordError("FITS files need astropy; install wfsobs with its extra: wfsobs[fits]") from None
    return fits


def read(file: IO[bytes], most: int) -> Contents:
    """Read a FITS file, or an AOT file. Raises RecordError, TooLargeError."""
    with open_fits(file, most) as hdus:
        if AOT not in hdus[0].header:
            return _contents(hdus)
    from wfsobs.telemetry.formats import aot

    return aot.read(file, most)


@contextmanager
def open_fits(file: IO[bytes], most: int) -> Iterator[HDUList]:
    """Yield the HDUs of a file, after a check that their stated lengths fit the file and the limit."""
    fits = astropy_fits()
    content = read_whole(file)
    length = len(content)
    if not content.startswith(b"SIMPLE  ="):  # neither a compressed file, which astropy would unpack
        raise RecordError("not a FITS file, or a compressed one")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of headers that are not quite to the standard
            with fits.open(io.BytesIO(content), memmap=False, lazy_load_hdus=False, disable_image_compression=True) as hdus:
                _check_sizes(hdus, length, most)
                yield hdus
    except RecordError:
        raise
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        EOFError,
        AttributeError,
        MemoryError,
        OverflowError,
        AssertionError,
        ZeroDivisionError,
        fits.VerifyError,
    ):
        raise RecordError(DAMAGED) from None


def read_whole(file: IO[bytes]) -> bytes:
    """Return all bytes of a file from its beginning: astropy closes the file it is given."""
    file.seek(0)
    return file.read()


def _check_sizes(hdus: HDUList, length: int, most: int) -> None:
    if len(hdus) > MOST_HDUS:
        raise RecordError(f"has {len(hdus)} parts, at most {MOST_HDUS} are read")
    if sum(hdu.size for hdu in hdus) > most:
        raise TooLargeError(most)
    for hdu in hdus:
        if hdu.size < 0 or hdu._data_offset + hdu.size > length:
            raise RecordError("ends before its data do")


def _contents(hdus: HDUList) -> Contents:
    fits = astropy_fits()
    contents = Contents()
    flat: dict[str, Array] = {}
    for hdu in hdus:
        name = hdu.name.lower()
        if isinstance(hdu, fits.BinTableHDU):
            _read_table(hdu, contents, flat)
        elif name in SIGNALS or name in CLOCKS:
            contents.arrays[name] = _native(hdu.data, name, hdu.header.get("BLANK"))
            if name in SIGNALS and "BUNIT" in hdu.header:
                contents.state_unit(name, str(hdu.header["BUNIT"]))
        contents.arrays |= {key: value for key, value in _plain(hdu).items() if not (key == "unit" and name in SIGNALS)}
    of_modes = from_columns(flat)
    contents.arrays |= of_modes.arrays
    contents.units |= of_modes.units
    return contents


def _plain(hdu: Any) -> dict[str, Array]:
    """Return the numbers and texts of a header."""
    found = {key: np.array(hdu.header[keyword]) for key, keyword in KEYWORDS.items() if keyword in hdu.header}
    return found | ({"dt": np.array(float(hdu.header[EXACT]))} if EXACT in hdu.header else {})


def _read_table(hdu: Any, contents: Contents, flat: dict[str, Array]) -> None:
    for column in hdu.columns:
        name = column.name.lower()
        known = name in SIGNALS or name in CLOCKS
        if "P" in column.format or "Q" in column.format:
            if known:
                raise RecordError(f"{name} is a column of rows of unlike lengths")
            continue
        if known:
            values = _native(hdu.data[column.name], name, column.null)
            contents.arrays[name] = values[:, None] if name in SIGNALS and values.ndim == 1 else values  # of one mode
            if name in SIGNALS and column.unit:
                contents.state_unit(name, column.unit)
        elif "/" in name or name.removesuffix("_s") in CLOCKS:
            flat[column.name] = _native(hdu.data[column.name], column.name, column.null)


def _native(data: Any, name: str, blank: int | None) -> Array:
    """Return numbers in native byte order, integers scaled as the header says; the integer `blank` is a missing one."""
    if data is None or np.asarray(data).dtype.kind not in "fiu":
        raise RecordError(f"{name} does not hold numbers")
    out = np.array(data, dtype=np.float64)
    if blank is not None and np.asarray(data).dtype.kind in "iu":
        out[np.asarray(data) == blank] = np.nan
    return out


def write(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write the arrays as tables, numbers as keywords, the scenario as history."""
    fits = astropy_fits()
    plain = numbers_and_texts(arrays)
    tables = [_table("RECORD", {n: arrays[n] for n in (*SIGNALS, *CLOCKS) if n in arrays and n not in TRAINING})]
    training = {n: arrays[n] for n in TRAINING if n in arrays}
    if training:
        tables.append(_table("TRAINING", training))
    header = tables[0].header
    for key in (*NUMBERS, "origin"):
        if key in plain:
            header[KEYWORDS[key]] = plain[key]
    if "dt" in plain:
        header[EXACT] = repr(float(plain["dt"]))
    for line in str(plain.get("scenario", "")).splitlines():
        header.add_history(line)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a long text goes on in CONTINUE cards
        fits.HDUList([fits.PrimaryHDU(), *tables]).writeto(file)


def _table(name: str, arrays: Mapping[str, Array]) -> Any:
    fits = astropy_fits()
    columns = [
        fits.Column(key, f"{x.shape[1]}D" if x.ndim == 2 else "D", unit="um" if key in SIGNALS else "s", array=x)
        for key, x in ((k, np.asarray(v, dtype=np.float64)) for k, v in arrays.items())
    ]
    return fits.BinTableHDU.from_columns(columns, name=name)
