"""A user's own vibration spectrum from CSV or FITS, for the settings vibration.psd.

CSV: columns frequency, tip and tilt, each with its unit in brackets, such as `tip [nm^2/Hz]`. FITS: a table of those columns
with TUNITn, or an image of three rows, frequency, tip, tilt, with BUNIT. One-sided densities; frequencies in Hz.

Densities at evenly spaced frequencies are those of bins, as an estimate of a spectrum has them: the first and the last go on by
half a step. Joined by straight lines they then have the power of all bins.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import IO

import numpy as np

from wfsobs.record import RecordError
from wfsobs.telemetry.formats import csv
from wfsobs.telemetry.formats.fits import image_numbers, open_fits
from wfsobs.typing import Array
from wfsobs.units import UNITS, micrometres_per, parse_unit

COLUMNS = ("frequency", "tip", "tilt")
MOST = 64_000_000
"""Maximum bytes of numbers in a file; a scenario takes 100 000 frequencies."""

FEWEST_BINS = 8
"""Frequencies by which a table may be one of bins."""

UNEVEN = 0.01
"""Maximum relative difference of the spaces between bins, which short numbers round."""

SQUARED = re.compile(r"(?P<unit>[A-Za-zµμ]+)\s*(?:(?:\^|\*\*)?2|²)\s*(?:/\s*|\s)Hz(?:\^?-1|⁻¹)?")
Table = tuple[dict[str, Array], dict[str, str]]
"""Columns, and their units in the file."""


class NoSpectrumError(RecordError):
    """Error: a file without the columns or rows of a spectrum."""


def load_psd(path: str | Path, unit: str | None = None, diameter: float = 8.0) -> dict[str, list[float]]:
    """Read a vibration spectrum.

    Parameters
    ----------
    path : str or Path
        CSV or FITS file.
    unit : str, optional
        Unit of the amplitude, one of UNITS, where the file gives none.
    diameter : float
        Aperture diameter, for angles [m].

    Returns
    -------
    dict of str to list of float
        The setting vibration.psd: frequency [Hz], tip and tilt [um^2/Hz].

    Raises
    ------
    RecordError
        The file cannot be used; one line naming what, where and what is expected.
    """
    try:
        with open(path, "rb") as file:
            return read_psd(file, str(path), unit, diameter)
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror or error}") from None


def read_psd(file: IO[bytes], name: str, unit: str | None = None, diameter: float = 8.0) -> dict[str, list[float]]:
    """Read a vibration spectrum from an open file, as `load_psd`; its name gives the format and is never opened."""
    try:
        fits = name.lower().endswith((".fits", ".fit", ".fts"))
        columns, units = _from_fits(file) if fits else _from_csv(file)
        return _to_table(columns, units, unit, diameter)
    except RecordError as error:
        kind = NoSpectrumError if isinstance(error, NoSpectrumError) else RecordError
        raise kind(f"{name}: {error}") from None


def _from_csv(file: IO[bytes]) -> Table:
    table = csv.read(file, MOST)
    names = {heading.partition("[")[0].strip().lower(): heading for heading in (*table.columns, *table.texts)}
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        raise NoSpectrumError(f"has no column {missing[0]}; it takes frequency [Hz], tip [nm^2/Hz], tilt [nm^2/Hz]")
    of_text = [names[name] for name in COLUMNS if names[name] in table.texts]
    if of_text:
        raise RecordError(table.texts[of_text[0]])
    units = {name: names[name].partition("[")[2].rstrip("] ") for name in COLUMNS}
    return {name: table.columns[names[name]] for name in COLUMNS}, units


def _from_fits(file: IO[bytes]) -> Table:
    with open_fits(file, MOST) as hdus:
        for hdu in hdus:
            names = {c.name.lower(): c for c in getattr(hdu, "columns", None) or ()}
            if all(name in names for name in COLUMNS):
                columns = {name: np.array(hdu.data[names[name].name], dtype=np.float64) for name in COLUMNS}
                return columns, {name: names[name].unit or "" for name in COLUMNS}
            if hdu.is_image and hdu.data is not None and hdu.data.ndim == 2 and hdu.data.shape[0] == len(COLUMNS):
                density = str(hdu.header.get("BUNIT", ""))
                return dict(zip(COLUMNS, image_numbers(hdu), strict=True)), {"frequency": "Hz", "tip": density, "tilt": density}
    raise NoSpectrumError("has neither a table of frequency, tip and tilt nor an image of three rows")


def _to_table(columns: dict[str, Array], units: dict[str, str], unit: str | None, diameter: float) -> dict[str, list[float]]:
    if units["frequency"] not in ("", "Hz", "hz"):
        raise RecordError(f"frequency is in {units['frequency']!r}; it takes Hz")
    for name, values in columns.items():
        if values.ndim != 1 or not values.size or not np.isfinite(values).all():
            raise RecordError(f"{name} does not hold one finite number per row")
    columns = _extend_bins(columns)
    out = {"frequency": columns["frequency"].tolist()}
    for name in COLUMNS[1:]:
        match = SQUARED.fullmatch(units[name].strip())
        own = parse_unit(match["unit"]) if match else None
        if units[name] and own is None:
            raise RecordError(f"{name} is in {units[name]!r}; it takes the square of {', '.join(UNITS)} per Hz")
        if own and unit and own != unit:
            raise RecordError(f"{name} is in {own}^2/Hz, but {unit} is stated")
        amplitude = own or unit
        if amplitude is None:
            raise RecordError(f"has no unit of {name}: state one of {', '.join(UNITS)} (squared, per Hz)")
        out[name] = (columns[name] * micrometres_per(amplitude, diameter) ** 2).tolist()
    return out


def _extend_bins(columns: dict[str, Array]) -> dict[str, Array]:
    """Return the columns with the outer edges of the first and last bin, where their frequencies are evenly spaced."""
    f = columns["frequency"]
    half, steps = 0.5 * (f[-1] - f[0]) / max(f.size - 1, 1), np.diff(f)
    if f.size < FEWEST_BINS or half <= 0 or np.ptp(steps) > UNEVEN * steps.min():
        return columns
    low = max(f[0] - half, 0.0)
    begins = int(low < f[0])
    extended = {name: np.pad(values, (begins, 1), "edge") for name, values in columns.items()}
    return extended | {"frequency": np.concatenate([[low] * begins, f, [f[-1] + half]])}
