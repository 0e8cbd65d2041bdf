"""Contents of a record file by name, whatever its format."""

from __future__ import annotations

import math
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from io import BufferedIOBase
from typing import IO, Any

import numpy as np

from wfsobs.record import RecordError
from wfsobs.sensors.zernike import TIP_TILT
from wfsobs.typing import Array
from wfsobs.units import DAYS, SECONDS, parse_unit, split_unit

FAST = ("y_lgs", "u", "turbulence", "vibration", "open_loop_y")
"""Arrays with one row per fast step."""

NGS = "y_ngs"
TRAINING = ("training_y", "training_u", "training_open_loop_y")
SIGNALS = (*FAST, NGS, *TRAINING)
"""Arrays (n, n_modes)."""

TIME, TIME_NGS = "time", "time_ngs"
CLOCKS = (TIME, TIME_NGS)
"""Arrays (n,) [s]."""

FRAME = "frame"
"""Array (n,), counts the frames and may start anew at a power of two."""

STARS = "lgs_stars"
"""Array (n,) of whole numbers; in .npz alone."""

APART = "y_stars"
"""Array (n, n_lgs, n_modes); in .npz alone."""

NUMBERS = ("dt", "ratio", "delay", "command_sign")
TEXTS = ("unit", "origin", "scenario")
NAMES = (*SIGNALS, *CLOCKS, STARS, APART, *NUMBERS, *TEXTS)

COLUMN = re.compile(
    r"(?:truth/)?(?P<array>[a-z_]+)(?:/|\.(?=tip|tilt))(?P<mode>[A-Za-z0-9 -]+?)(?:(?:_| ?[\[(])(?P<unit>[A-Za-zµμ]+)[\])]?)?$"
)
"""Name of a column of one mode, such as y_lgs/tip_um, or y_lgs.tip of a structure."""

MOST_COLUMNS = 20_000
"""Maximum columns of one array that a file offers under names of its own."""


@dataclass
class Contents:
    """Arrays and units of a file.

    Attributes
    ----------
    arrays : dict of str to Array
        Name (of NAMES) -> array as in the file; numbers and texts have no dimension.
    units : dict of str to str
        Name of a signal -> its unit, where the file gives one for it alone.
    guesses : list of str
        What was guessed of the file, a few words each.
    leftovers : list of str
        Columns that are no part of the record.
    hint : str
        What the names of columns suggest, where a record lacks a part.
    """

    arrays: dict[str, Array] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    guesses: list[str] = field(default_factory=list)
    leftovers: list[str] = field(default_factory=list)
    hint: str = ""

    def state_unit(self, name: str, text: str) -> None:
        """Note the unit of a signal, if there is one. Raises RecordError where it differs from that of its other modes."""
        unit = parse_unit(text) or text.strip()
        if text and self.units.setdefault(name, unit) != unit:
            raise RecordError(f"{name} is in {self.units[name]} and in {unit}")


@dataclass
class FileColumns(Contents):
    """What a file holds, whatever its format: whole arrays, numbers and texts of the names of a record, and all under its own.

    Attributes
    ----------
    columns : dict of str to Array
        Name in the file -> values, (n,).
    column_units : dict of str to str
        Name in the file, also of an array, a table, a structure or a group of columns -> its unit, as written.
    texts : dict of str to str
        Name in the file -> why it holds no numbers.
    numbers : dict of str to float
        Name in the file -> number that stands alone.
    matrices : dict of str to Array
        Matrices of a loop from slopes to modes, the first choice first, and from modes to commands.
    most : float
        Maximum bytes of numbers that are added, 8 each.
    """

    columns: dict[str, Array] = field(default_factory=dict)
    column_units: dict[str, str] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)
    matrices: dict[str, Array] = field(default_factory=dict)
    most: float = math.inf
    _bytes: int = 0

    def add(self, name: str, data: object, unit: str = "") -> None:
        """Add what a file holds under a name: as part of a record where it has the name of one, and numbers as columns.

        Columns of two dimensions are name[0], name[1], ..., the longest axis being time; fields of a structure are name.field.
        Raises RecordError where a part of a record holds no numbers, TooLargeError.
        """
        values, known = np.asarray(data), name.lower()
        if values.dtype.names and name.count(".") < DEEPEST:
            self.column_units[name] = unit
            for key in values.dtype.names:
                self.add(f"{name}.{key}", values[key])
        elif values.dtype.kind == "O" and isinstance(values.item() if values.size == 1 else None, HOLDS):
            self.add(name, values.item(), unit)
        elif values.dtype.kind == "M":
            self.add(name, np.where(np.isnat(values), np.nan, values.astype("M8[ns]").astype(np.int64) * 1e-9), "s")
        elif values.dtype.kind in "SU":
            self._add_texts(name, texts_of(values))
        elif values.dtype.kind not in "fiu":
            self.leave(name, f"{name} holds {KINDS.get(values.dtype.kind, values.dtype)}, not numbers")
        elif not values.size:
            self.leave(name, f"{name} is empty")
        elif known in (*NUMBERS, *TEXTS):
            if values.size > 1 and not (values == values.flat[0]).all():
                raise RecordError(f"{known} holds {values.size} numbers that differ; it takes one")
            value = values.flat[0] * (seconds_per(known, unit) if known == "dt" else 1)
            self.arrays[known] = np.unique(np.append(self.arrays.get(known, ()), value)).squeeze()  # of several parts
        elif values.size == 1 and known not in NAMES and not parse_heading(name):
            self.numbers[name] = float(values.item()) * (hertz_per(name, unit) if is_rate(name) else 1.0)
        else:
            self._add_numbers(name, values, unit)

    def _add_numbers(self, name: str, values: Array, unit: str) -> None:
        values = np.atleast_1d(values)
        known, longest = name.lower(), int(np.argmax(values.shape))
        rows = np.moveaxis(values, longest, 0).reshape(values.shape[longest], -1)
        size = 8 * (values.size if known in NAMES else rows[:, :MOST_COLUMNS].size)
        if self._bytes + size > self.most:
            if known not in NAMES:
                return self.leave(name, f"there is no room for {name}")
            raise TooLargeError(self.most)
        self._bytes += size
        if known in self.arrays:
            raise RecordError(f"two parts are named {known}")
        if known in CLOCKS:
            self.arrays[known] = values.reshape(rows.shape if rows.shape[1] > 1 else -1) * seconds_per(known, unit)
        elif known in SIGNALS:
            self.arrays[known] = values if values.ndim == 2 else rows
            self.state_unit(known, unit)
        elif known in (STARS, APART):
            self.arrays[known] = rows.ravel() if known == STARS else values
        self.column_units[name] = unit
        for i, column in enumerate(rows.T[:MOST_COLUMNS]):
            self.columns[f"{name}[{i}]" if rows.shape[1] > 1 else name] = column.astype(np.float64)

    def _add_texts(self, name: str, texts: list[str]) -> None:
        if (match := UNIT.fullmatch(name)) and any(texts):
            if match["of"]:
                self.column_units[match["of"]] = one_text(texts)
            else:
                self.arrays["unit"] = np.array(one_text([*np.atleast_1d(self.arrays.get("unit", [])).tolist(), *texts]))
        elif name.lower() in TEXTS and len(texts) == 1:
            self.arrays[name.lower()] = np.array(texts[0])
        elif len(texts) > 1 and STAMP.fullmatch(texts[0].strip()):
            self.add(name, np.array([parse_cell(text) for text in texts]), "s")
        else:
            self.leave(name, f"{name} holds text, not numbers")

    def unit_around(self, name: str, is_clock: bool) -> str:
        """Return the unit of the nearest that a column is in; a clock takes one of time, a signal none of these."""
        units = (self.column_units.get(outer, "") for outer in names_around(name))
        return next((unit for unit in units if unit and (unit.lower() in SECONDS) == is_clock), "")

    def own_name(self, name: str) -> str:
        """Return a name as the file has it: `s/field`, as MATLAB stores it in version 7.3, is `s.field`."""
        known = (*self.columns, *self.texts)
        return next((x for x in (name, name.replace("/", ".")) if any(key.startswith(x) for key in known)), name)

    def leave(self, name: str, why: str) -> None:
        """Leave out what holds no numbers. Raises RecordError with that reason where it has the name of a part of a record."""
        if name.lower() in (*SIGNALS, *CLOCKS, STARS, APART, *NUMBERS) or parse_heading(name):
            raise RecordError(why)
        self.texts[name] = why


def names_around(name: str) -> Iterator[str]:
    """Yield the names of the array, the structures and the groups that a column is in.

    >>> [*names_around("loop/wfs.slopes[0]")]
    ['loop/wfs.slopes', 'loop/wfs', 'loop']
    """
    while match := re.fullmatch(r"(.+)[/.\[].*", name):
        name = match[1]
        yield name


RATE = re.compile(
    r"(?:.*[/.])?(?:(?:frame|loop|sampl(?:e|ing)|wfs|lgs)?[_ ]?(?:rate|freq(?:uency)?)|fs|fps)(?:[_ ]?[\[(]?hz[\])]?)?", re.I
)
"""Name of the number of frames per second."""


def is_rate(name: str) -> bool:
    """Return whether a number of this name is the rate of the frames.

    >>> [is_rate(name) for name in ("frame_rate_hz", "loop/fs", "LOOPFREQ", "ngs_rate", "strehl")]
    [True, True, True, False, False]
    """
    return RATE.fullmatch(name) is not None


def hertz_per(name: str, unit: str) -> float:
    """Return the hertz per unit of a rate, 1 where none is stated. Raises RecordError.

    >>> hertz_per("rate", "kHz"), hertz_per("rate", "")
    (1000.0, 1.0)
    """
    hertz = HERTZ.get(unit.strip().lower() or "hz")
    if hertz is None:
        raise RecordError(f"{name} is in {unit[:40]!r}, which is no unit of a rate; it takes Hz or kHz")
    return hertz


HERTZ = {"khz": 1e3, "kilohertz": 1e3, **dict.fromkeys("hz hertz 1/s s-1 s^-1 fps".split(), 1.0)}
"""Hertz per unit of a rate."""

UNIT = re.compile(r"(?:(?P<of>.*)[/.])?\s*units?\s*", re.I)
"""Name of the unit of a structure or a group."""


def texts_of(values: object) -> list[str]:
    """Return the texts among values, decoded."""
    plain = (x.decode("utf-8", "replace") if isinstance(x, bytes) else x for x in np.ravel(np.asarray(values)).tolist())
    return [x for x in plain if isinstance(x, str)]


def one_text(texts: Iterable[str]) -> str:
    """Return equal texts as one, and those that differ as what is no unit.

    >>> one_text(["nm", "nm "]), one_text(["nm", "um"])
    ('nm', 'nm and um')
    """
    return " and ".join(dict.fromkeys(filter(None, map(str.strip, texts))))


def unit_among(attributes: Mapping[str, object]) -> str:
    """Return the unit that is among attributes, empty where there is none.

    >>> unit_among({"Units": ["nm", "nm"], "comment": "good seeing"})
    'nm'
    """
    return one_text(text for name, value in attributes.items() if UNIT.fullmatch(name) for text in texts_of(value))


KINDS = {"O": "objects", "b": "yes or no", "c": "complex numbers", "V": "structures too deep"}
"""Kinds of array that are not read, by numpy's letter."""

HOLDS = (np.ndarray, np.number, str, bytes, float)
"""What a cell for objects may hold."""

DEEPEST = 6
"""Maximum depth of structures."""

STAMP = re.compile(r"(?:(\d{4}[-/]\d\d[-/]\d\d)[T ])?(\d\d:\d\d:\d\d)(?:[.,](\d{1,9}))?\d*(?:Z|[+-]\d\d:?\d\d)?")
"""A time stamp of ISO 8601, or the time of a day; the time zone is that of all."""

ABSENT = frozenset(("", *"na n/a null none - --".split()))
"""What stands in a cell for a missing number."""


def parse_cell(text: str) -> float:
    """Return the number of a cell, or the seconds since 1970 of a stamp; NaN where there is none.

    A number may have a decimal comma, and the exponent of Fortran's double precision.

    >>> parse_cell("0,5"), parse_cell("-2.5D-01"), parse_cell("1970-01-02 00:00:00.25Z"), parse_cell("N/A")
    (0.5, -0.25, 86400.25, nan)

    Raises ValueError.
    """
    if text.strip().lower() in ABSENT:
        return np.nan
    if (match := STAMP.fullmatch(text.strip())) is None:
        return float(text.replace(",", ".").upper().replace("D", "E"))
    day, clock, part = match.groups()
    whole = np.datetime64(f"{(day or '1970-01-01').replace('/', '-')}T{clock}").astype(np.int64)
    return float(whole + float(f"0.{part or 0}"))


def parse_heading(heading: str, beside: str = "") -> tuple[str, str] | None:
    """Return the role and the unit of a column named as in a record, None of any other; beside : its unit, if not in its name.

    >>> parse_heading("y_lgs/tip_um"), parse_heading("u/tip nm"), parse_heading("time [ms]"), parse_heading("flux")
    (('y_lgs/tip', 'um'), ('u/tip', 'nm'), ('time', 'ms'), None)
    """
    match = COLUMN.fullmatch(heading)
    if match and match["array"] in SIGNALS:
        mode, unit = (match["mode"], match["unit"]) if match["unit"] else split_unit(match["mode"])  # "tip nm", too
        return f"{match['array']}/{mode}", unit or beside.strip()
    name, unit = split_unit(heading, beside)
    name = TIME if name.lower() in DAYS else name.lower()
    return (name, unit) if name in CLOCKS else None


def seconds_per(name: str, unit: str) -> float:
    """Return the seconds per unit of a clock, 1 where none is stated. Raises RecordError.

    >>> seconds_per("time", "Milliseconds since the start"), seconds_per("time", "")
    (0.001, 1.0)
    """
    words = unit.split() or ["s"]
    seconds = SECONDS.get(words[0]) or SECONDS.get(words[0].lower())
    if seconds is None:
        raise RecordError(f"{name} is in {unit[:40]!r}, which is no unit of time; it takes s, ms, us, ns or d")
    return seconds


def from_columns(columns: Mapping[str, tuple[Array, str]]) -> Contents:
    """Return the contents of columns {role: (values, unit)}, the shorter fast ones with missing samples at their end.

    Modes are tip, tilt and then in the order of the columns of y_lgs. Raises RecordError where an array lacks one of them, unless
    it is one of slopes or of commands of actuators, or the other is.
    """
    contents = Contents()
    found: dict[str, dict[str, Array]] = {}
    columns_of: dict[str, list[Array]] = {}
    for role, (values, unit) in columns.items():
        name, _, mode = role.partition("/")
        if not mode:
            contents.arrays[name] = values * seconds_per(name, unit)  # a counter has no unit
            continue
        found.setdefault(name, {})[mode] = values
        contents.state_unit(name, unit)
    first = [mode.name for mode in TIP_TILT]

    def in_order(modes: Iterable[str]) -> list[str]:
        return sorted(modes, key=lambda mode: first.index(mode) if mode in first else len(first))

    for name, by_mode in found.items():
        modes = in_order(found.get("y_lgs", by_mode))
        if max(len(by_mode), len(modes)) > len(first) and len(by_mode) != len(modes):  # slopes or actuators
            modes = in_order(by_mode)
        elif set(by_mode) != set(modes):
            raise RecordError(f"{name} has the modes {', '.join(by_mode)}; y_lgs has {', '.join(modes)}")
        if name == "y_lgs" and modes == first[1:]:
            contents.guesses.append(f"{modes[0]} alone, called {first[0]}")
        columns_of[name] = [by_mode[mode] for mode in modes]
    fast = [len(x) for name in FAST for x in columns_of.get(name, ())]
    longest = max([len(contents.arrays.get(TIME, ())), *fast])
    for name, values in columns_of.items():  # what ends early has missing samples there
        n = longest if name in FAST else max(map(len, values))
        contents.arrays[name] = np.column_stack([np.pad(x, (0, n - len(x)), constant_values=np.nan) for x in values])
    return contents


def to_columns(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return the signals and clocks as columns (n,), named as COLUMN."""
    columns = {f"{name}_s": np.asarray(arrays[name]) for name in CLOCKS if name in arrays}
    for name in SIGNALS:
        if name in arrays:
            for i, values in enumerate(np.asarray(arrays[name]).T):
                columns[f"{name}/{column_mode(i)}_um"] = values
    return columns


def column_mode(column: int) -> str:
    """Return the name of a column's mode: tip, tilt, then Noll's numbers, Z4 and up."""
    return TIP_TILT[column].name if column < len(TIP_TILT) else f"Z{column + 2}"


def numbers_and_texts(arrays: Mapping[str, Array], encoding: str = "utf-8") -> dict[str, float | int | str]:
    """Return all that is neither a signal nor a clock, as plain values; what the encoding has no letter for is `?`."""
    plain = {name: np.asarray(arrays[name]).item() for name in (*NUMBERS, *TEXTS) if name in arrays}
    return {name: x.encode(encoding, "replace").decode(encoding) if isinstance(x, str) else x for name, x in plain.items()}


class TooLargeError(RecordError):
    """Error: a file that exceeds the limit of memory."""

    def __init__(self, most: float):
        super().__init__(f"holds more than {most / 1e6:.4g} MB of numbers, which is the most that is read here")


def read_at_most(file: IO[bytes] | BufferedIOBase, most: int) -> bytes:
    """Return all bytes of an open file from its beginning. Raises TooLargeError."""
    file.seek(0)
    if len(content := file.read(most + 1)) > most:
        raise TooLargeError(most)
    return content


DAMAGES = (
    *(OSError, ValueError, TypeError, LookupError, RuntimeError, MemoryError, AttributeError, ArithmeticError, NameError),
    *(EOFError, AssertionError, StopIteration, struct.error, zlib.error, zipfile.BadZipFile, tokenize.TokenError),
)
"""What libraries raise of a damaged file."""


@contextmanager
def refuse_damage(what: str, *more: type[Exception]) -> Iterator[None]:
    """Raise RecordError, saying what a file is, in place of DAMAGES and of `more`, which a library raises of its own."""
    try:
        yield
    except RecordError:
        raise
    except (*DAMAGES, *more):
        raise RecordError(what) from None


def import_library(name: str, extra: str, files: str = "files of this kind") -> Any:
    """Import what reads some files. Raises RecordError naming the extra where it is not installed."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        library = (error.name or name).partition(".")[0]
        raise RecordError(f"{files} need {library}; install wfsobs with its extra: wfsobs[{extra}]") from None


MEAN_SLOPES = "mean_slopes"
"""Name of that matrix where a sensor has a grid of subapertures."""


def mean_slopes(n: int) -> Array:
    """Return the matrix (2, 2 n) from the slopes of n subapertures, x before y, to their means."""
    return np.kron(np.eye(2), np.full((1, n), 1.0 / n))
