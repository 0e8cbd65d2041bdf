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
from importlib import import_module
from typing import IO, Any

import numpy as np

from wfsobs.record import RecordError
from wfsobs.telemetry.formats.contents import (
    CLOCKS,
    NUMBERS,
    SIGNALS,
    TRAINING,
    FileColumns,
    TooLargeError,
    import_library,
    is_rate,
    numbers_and_texts,
    read_at_most,
    refuse_damage,
)
from wfsobs.typing import Array

HDUList = Any
"""Astropy's, which is imported only when needed."""

KEYWORDS = {"dt": "DT", "ratio": "RATIO", "delay": "DELAY", "command_sign": "CMDSIGN", "unit": "BUNIT", "origin": "STATED"}
EXACT = "DTEXACT"
"""The time step as text: a number in a header has sixteen digits, one less than needed."""

DAMAGED = "damaged, or not a FITS file of tables and images"
MOST_HDUS = 200


def astropy_fits() -> Any:
    """Return astropy.io.fits. Raises RecordError naming the extra where it is not installed."""
    import_library("astropy.io", "fits", "FITS files")
    return import_module("astropy.io.fits")


@contextmanager
def open_fits(file: IO[bytes], most: int) -> Iterator[HDUList]:
    """Yield the HDUs of a file, after a check that their stated lengths fit the file and the limit."""
    fits = astropy_fits()
    content = read_at_most(file, most)
    if not content.startswith(b"SIMPLE  ="):  # neither a compressed file, which astropy would unpack
        raise RecordError("not a FITS file, or a compressed one")
    with refuse_damage(DAMAGED, fits.VerifyError), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of headers that are not quite to the standard
        how = {"memmap": False, "lazy_load_hdus": False, "disable_image_compression": True}
        with fits.open(io.BytesIO(content), **how, do_not_scale_image_data=True) as hdus:  # astropy forgets some blanks in that
            _check_sizes(hdus, len(content), most)
            yield hdus


def _check_sizes(hdus: HDUList, length: int, most: int) -> None:
    if len(hdus) > MOST_HDUS:
        raise RecordError(f"has {len(hdus)} parts, at most {MOST_HDUS} are read")
    if sum(hdu.size for hdu in hdus) > most:
        raise TooLargeError(most)
    for hdu in hdus:
        if hdu.size < 0 or hdu._data_offset + hdu.size > length:
            raise RecordError("ends before its data do")


def tables_and_images(hdus: HDUList, most: float) -> FileColumns:
    """Read the tables and images of a file. Raises RecordError, TooLargeError."""
    fits = astropy_fits()
    out = FileColumns(most=most)
    for number, hdu in enumerate(hdus):
        part = f"{hdu.name or 'HDU'} {number}." if number else ""
        for key, keyword in KEYWORDS.items():
            if keyword not in hdu.header or (part and keyword in hdus[0].header):
                continue
            if key != "unit":
                out.add(key, float(hdu.header.get(EXACT, hdu.header[keyword])) if key == "dt" else hdu.header[keyword])
            elif not hdu.is_image or hdu.data is None:  # of one image alone
                out.add(f"{part}{key}", hdu.header[keyword])
        if hdu.header.get("ZIMAGE"):
            name = hdu.name or f"image {number}"
            out.leave(name, f"{name} is a compressed image, which is not read: unpack it, as funpack does")
            continue
        data: Any = hdu.data
        if isinstance(hdu, fits.BinTableHDU):
            for column in hdu.columns:
                twice = column.name in out.columns or f"{column.name}[0]" in out.columns
                name = f"{hdu.name or number}.{column.name}" if twice else column.name
                if "P" in column.format or "Q" in column.format:
                    out.leave(name, f"{name} is a column of rows of unlike lengths")
                else:
                    raw = data.view(np.ndarray)[column.name]
                    out.add(name, _native(data[column.name], raw, column.null), column.unit or "")
        elif data is not None:
            out.add(hdu.name or f"image {number}", image_numbers(hdu), str(hdu.header.get("BUNIT", "")))
        for key in filter(is_rate, hdu.header):
            out.add(f"{part}{key}", hdu.header[key])
    return out


def image_numbers(hdu: Any) -> Array:
    """Return the numbers of an image, scaled as its header says."""
    header = hdu.header
    return _native(hdu.data, hdu.data, header.get("BLANK")) * header.get("BSCALE", 1.0) + header.get("BZERO", 0.0)


def _native(data: Any, raw: Any, blank: int | None) -> Array:
    """Return numbers in native byte order, NaN where the stored integer is `blank`."""
    if np.asarray(data).dtype.kind not in "fiu":
        return np.asarray(data)
    out = np.array(data, dtype=np.float64)
    if blank is not None and np.asarray(raw).dtype.kind in "iu":
        out[np.asarray(raw) == blank] = np.nan
    return out


def write(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write the arrays as tables, numbers as keywords, the scenario as history."""
    fits = astropy_fits()
    plain = numbers_and_texts(arrays, "ascii")
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
