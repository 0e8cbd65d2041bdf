"""Contents of a record file by name, whatever its format."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from wfsobs.record import RecordError
from wfsobs.sensors.modes import TIP_TILT
from wfsobs.typing import Array
from wfsobs.units import parse_unit

FAST = ("y_lgs", "u", "turbulence", "vibration", "open_loop_y")
"""Arrays with one row per fast step."""

NGS = "y_ngs"
TRAINING = ("training_y", "training_u", "training_open_loop_y")
SIGNALS = (*FAST, NGS, *TRAINING)
"""Arrays (n, n_modes)."""

TIME, TIME_NGS = "time", "time_ngs"
CLOCKS = (TIME, TIME_NGS)
"""Arrays (n,) [s]."""

STARS = "lgs_stars"
"""Array (n,) of whole numbers; in .npz alone."""

APART = "y_stars"
"""Array (n, n_lgs, n_modes); in .npz alone."""

NUMBERS = ("dt", "ratio", "delay", "command_sign")
TEXTS = ("unit", "origin", "scenario")
NAMES = (*SIGNALS, *CLOCKS, STARS, APART, *NUMBERS, *TEXTS)

COLUMN = re.compile(r"(?:truth/)?(?P<array>[a-z_]+)/(?P<mode>[A-Za-z0-9 -]+?)(?:_(?P<unit>[A-Za-zµμ]+))?$")
"""Name of a column of one mode, such as y_lgs/tip_um."""

MOST_COLUMNS = 64
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
    """

    arrays: dict[str, Array] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)

    def state_unit(self, name: str, text: str) -> None:
        """Note the unit of a signal. Raises RecordError for an unknown one, or one that differs from that of its other modes."""
        unit = parse_unit(text)
        if unit is None:
            raise RecordError(f"{name} is in {text!r}, which is no unit of a wavefront")
        if self.units.setdefault(name, unit) != unit:
            raise RecordError(f"{name} is in {self.units[name]} and in {unit}")


@dataclass
class FileColumns:
    """Columns of a file under its own names.

    Attributes
    ----------
    columns : dict of str to Array
        Name in the file -> values, (n,).
    plain : dict of str to Array
        Numbers and texts of known names (NUMBERS, TEXTS).
    units : dict of str to str
        Name in the file -> unit beside it, as written.
    """

    columns: dict[str, Array] = field(default_factory=dict)
    plain: dict[str, Array] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, values: Array, unit: str = "") -> None:
        """Add an array of one or two dimensions; the columns of two are name[0], name[1], ..., the longer axis being time."""
        if values.ndim == 2:
            for i, column in enumerate(values.T if values.shape[0] >= values.shape[1] else values):
                if i < MOST_COLUMNS:
                    self.add(f"{name}[{i}]", column, unit)
        elif values.ndim == 1 and values.size > 1 and values.dtype.kind in "fiu":
            self.columns[name] = values.astype(np.float64)
            if unit:
                self.units[name] = unit


def from_columns(columns: Mapping[str, Array]) -> Contents:
    """Return the contents of columns (n,) named as COLUMN, time_s or time_ngs_s; others are ignored.

    Modes are in the order of the columns of y_lgs. Raises RecordError where an array lacks one of them.
    """
    contents = Contents()
    found: dict[str, dict[str, Array]] = {}
    for heading, values in columns.items():
        clock = heading.removesuffix("_s")
        match = COLUMN.fullmatch(heading)
        if clock in CLOCKS:
            contents.arrays[clock] = values
        elif match and match["array"] in SIGNALS:
            name = match["array"]
            if match["mode"] in found.setdefault(name, {}):
                raise RecordError(f"two columns are named {name}/{match['mode']}")
            found[name][match["mode"]] = values
            if match["unit"]:
                contents.state_unit(name, match["unit"])
    if "y_lgs" not in found:
        return contents
    modes = list(found["y_lgs"])
    for name, by_mode in found.items():
        if set(by_mode) != set(modes):
            raise RecordError(f"{name} has the modes {', '.join(by_mode)}; y_lgs has {', '.join(modes)}")
        longest = max(map(len, by_mode.values()))
        contents.arrays[name] = np.column_stack([_pad(by_mode[mode], longest) for mode in modes])
    return contents


def pad_fast(contents: Contents) -> None:
    """Extend all fast signals to the length of the longest: what ends early has missing samples there."""
    fast = [name for name in FAST if name in contents.arrays]
    n = max((len(contents.arrays[name]) for name in (*fast, *((TIME,) if TIME in contents.arrays else ()))), default=0)
    for name in fast:
        values = contents.arrays[name]
        contents.arrays[name] = np.pad(values, ((0, n - len(values)), (0, 0)), constant_values=np.nan)


def to_columns(arrays: Mapping[str, Array], unit: str = "um") -> dict[str, Array]:
    """Return the signals and clocks as columns (n,), named as COLUMN."""
    columns = {f"{name}_s": np.asarray(arrays[name]) for name in CLOCKS if name in arrays}
    for name in SIGNALS:
        if name in arrays:
            for i, values in enumerate(np.asarray(arrays[name]).T):
                columns[f"{name}/{column_mode(i)}_{unit}"] = values
    return columns


def column_mode(column: int) -> str:
    """Return the name of a column's mode: tip, tilt, then Noll's numbers, Z4 and up."""
    return TIP_TILT[column].name if column < len(TIP_TILT) else f"Z{column + 2}"


def numbers_and_texts(arrays: Mapping[str, Array]) -> dict[str, float | int | str]:
    """Return all that is neither a signal nor a clock, as plain values."""
    return {name: np.asarray(arrays[name]).item() for name in (*NUMBERS, *TEXTS) if name in arrays}


def _pad(x: Array, n: int) -> Array:
    return np.concatenate([x, np.full(n - len(x), np.nan)])


class TooLargeError(RecordError):
    """Error: a file that exceeds the limit of memory."""

    def __init__(self, most: int):
        super().__init__(f"holds more than {most / 1e6:.4g} MB of numbers, which is the most that is read here")
