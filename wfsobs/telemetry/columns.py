"""Columns of unknown names: which of them is which signal, and the matrices from slopes and actuators to modes."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from wfsobs.record import RecordError
from wfsobs.sensors.zernike import TIP_TILT
from wfsobs.telemetry.formats.aot import TRANSLATED
from wfsobs.telemetry.formats.contents import (
    CLOCKS,
    FRAME,
    MEAN_SLOPES,
    NGS,
    TIME,
    Contents,
    FileColumns,
    column_mode,
    from_columns,
    is_rate,
    mean_slopes,
    names_around,
    parse_heading,
)
from wfsobs.typing import Array
from wfsobs.units import SECONDS, parse_unit, split_unit, stated_unit

SIGNALS = {
    "y_lgs": "measurement",
    "u": "command",
    NGS: "NGS measurement",
    "turbulence": "true turbulence",
    "vibration": "true vibration",
}

ROLES: dict[str, str] = {TIME: "time", FRAME: "frame counter"} | {
    f"{signal}/{mode.name}": f"{label}, {mode.name}" for signal, label in SIGNALS.items() for mode in TIP_TILT
}
"""What a column can be -> how it is called."""

WORDS = {
    signal: set(words.split())
    for signal, words in {
        "turbulence": "turbulence turb atmosphere atm",
        "vibration": "vibration vib",
        NGS: "ngs",
        "u": "u command commands cmd cmds com dm mirror ttm ftm actuator volts positions",
        "y_lgs": "measurement measurements meas slope slopes gradients centroid centroids wfs residual residuals res err error"
        " lgs y",
    }.items()
}
"""Words in the name of a column that tell a signal, those that tell most first."""

AXES = {"tip": {"tip", "x", "0"}, "tilt": {"tilt", "y", "1"}}
TIMES = set("time t timestamp stamp seconds clock mjd jd".split())
COUNTERS = set("frame framecounter framecount framenumber frameno frameid counter".split())
OTHER_COUNTS = {"rate", "lost", "missing", "skipped"}
"""Words beside those of a counter, of what it does not count."""


def to_contents(file: FileColumns, roles: Mapping[str, str]) -> Contents:
    """Return the contents of a file: columns of the roles {role: name in the file}, and what has the name of a part of a record.

    A column that counts the frames is used as what it is where no column has that role.

    Raises
    ------
    RecordError
        There is no such role or no such column, or a column has a unit that is none.
    """
    found: dict[str, tuple[Array, str]] = {}
    if unknown := [role for role in roles if role not in ROLES | SIGNALS]:
        columns, arrays = ", ".join(ROLES), ", ".join(SIGNALS)
        raise RecordError(f"{unknown[0][:80]!r} is no part of a record; a column is one of {columns}, an array one of {arrays}")
    roles = dict(pair for role, name in roles.items() for pair in _each_mode(file, role, file.own_name(name)))
    for role, name in roles.items():
        if name in file.texts:
            raise RecordError(file.texts[name])
        if name not in file.columns:
            there = (
                f"it has {', '.join([*file.columns][:20])}" if file.columns else "columns of its format have names of their own"
            )
            raise RecordError(f"has no column {name[:80]!r}; {there}")
        unit = stated_unit(name, file.column_units.get(name, "")) or file.unit_around(name, role in CLOCKS)
        found[role] = file.columns[name], "" if role == FRAME else unit
    unused = []
    for name, values in file.columns.items():
        role, unit = parse_heading(name, file.column_units.get(name, "")) or ("", "")
        if name in roles.values() or name.split("[")[0].lower() in file.arrays:
            continue
        if not role or role in roles:
            unused.append(name)
        elif role in found:
            raise RecordError(f"two columns are named {role}")
        else:
            found[role] = values, unit or file.unit_around(name, role in CLOCKS)
    contents = from_columns(found)
    contents.units |= {name: unit for name, unit in file.units.items() if name not in contents.arrays}
    contents.arrays = file.arrays | contents.arrays
    contents.guesses = [*file.guesses, *contents.guesses]
    _take_loose_units(file, contents)
    n_rows = len(contents.arrays["y_lgs"]) if np.ndim(contents.arrays.get("y_lgs", 0)) else 0
    counters = [name for name in unused if _has_counter_name(name) and is_counter(file.columns[name], n_rows)]
    if FRAME not in found and len(counters) == 1:
        unused.remove(counters[0])
        contents.arrays[FRAME] = file.columns[counters[0]]
        contents.guesses.append(f"frames counted by {counters[0]}")
    stated = found.get(TIME, (None, ""))[1] or file.column_units.get(TIME, "")
    by_step = "" if stated or TIME not in contents.arrays else _unit_of_steps(contents.arrays[TIME])
    for name in [clock for clock in CLOCKS if clock in contents.arrays]:
        if unit := _guess_unit(contents.arrays[name]) or by_step:
            contents.arrays[name] = contents.arrays[name] * SECONDS[unit]
            contents.guesses.append(f"{name} in {unit}")
    unsettled = _take_rate(file, contents)
    contents.leftovers = [*unused, *(f"{name} (text)" if why.endswith("number") else name for name, why in file.texts.items())]
    many = _many_in_one(unused)
    suggested = {role: name for role, name in (suggest_roles(unused) | many).items() if role not in roles}
    if suggested:
        contents.hint = "; as its names suggest: " + " ".join(f"--column '{role}={name}'" for role, name in _by_array(suggested))
    if "y_lgs" in many:
        contents.hint += "; slopes need a --reconstructor, as wfsobs convert takes it"
    if unused and "y_lgs" not in {role.partition("/")[0] for role in (*suggested, *contents.arrays)}:
        there = dict.fromkeys(re.sub(r"\[\d+\]$", "", name) for name in unused if name not in suggested.values())
        contents.hint += f"; which of its columns is what? It has {', '.join([*there][:20])}"
    contents.hint += unsettled
    return contents


def _take_loose_units(file: FileColumns, contents: Contents) -> None:
    """Take a unit that stands beside no column for that of signals without one; several are together a unit that is none."""
    within = {outer for name in (*file.columns, *file.texts) for outer in (name, *names_around(name))}
    loose = {unit: name for name, text in file.column_units.items() if name not in within and (unit := parse_unit(text))}
    silent = [name for name in SIGNALS if name in contents.arrays and name not in contents.units]
    if loose and silent and "unit" not in contents.arrays:
        unit = " or ".join(sorted(loose.keys() | set(contents.units.values())))
        contents.units |= dict.fromkeys(silent, unit)
        contents.guesses.append(f"unit of {' and '.join(loose.values())}")


def _take_rate(file: FileColumns, contents: Contents) -> str:
    """Take the rate that the root of a file states, or else all parts that state one; return what to do where these differ."""
    rates = {name: rate for name, rate in file.numbers.items() if is_rate(name) and rate > 0}
    rates = {name: rate for name, rate in rates.items() if not [*names_around(name)]} or rates
    if np.ndim(contents.arrays.get("dt", 0)):
        rates |= {f"dt = {step:g} s": 1.0 / step for step in contents.arrays.pop("dt") if step}
    different = {f"{rate:.6g} Hz": name for name, rate in rates.items()}
    if contents.arrays.keys() & {"dt", TIME} or not rates:
        return ""
    if len(different) > 1:
        stated = " and ".join(f"{rate} by {name}" for rate, name in different.items())
        return f"; it states {stated}: state one (--rate, rate=), or which --column is the time"
    name, rate = rates.popitem()
    contents.arrays["dt"] = np.array(1.0 / rate)
    contents.guesses.append(f"{rate:g} Hz by {name}")
    return ""


def _guess_unit(time: Array) -> str:
    """Return the unit of stamps that can be no seconds: those since 1970 of our time, or days; empty of any others."""
    size = float(np.median(time)) if time.size > 1 and time.dtype.kind in "fiu" else 0.0
    if 4e4 < size < 9e4 and 0 < np.median(np.diff(time)) < 1e-6:
        return "d"
    return next((unit for unit in ("ms", "us", "ns") if 1e9 < size * SECONDS[unit] < 4.2e9), "")


def _unit_of_steps(time: Array) -> str:
    """Return the unit of stamps a second or more apart, as those of no loop are: that in which they are up to 0.1 s apart."""
    step = float(np.median(np.diff(time))) if time.ndim == 1 and time.size > 1 and time.dtype.kind in "fiu" else 0.0
    return next((unit for unit in ("ms", "us", "ns") if step >= 1.0 and step * SECONDS[unit] < 0.1), "")


def _each_mode(file: FileColumns, role: str, name: str) -> list[tuple[str, str]]:
    """Return the roles and names of the columns of an array that is a signal of all modes; of a column, that itself."""
    if role not in SIGNALS:
        return [(role, name)]
    parts = [key for key in file.columns if key == name or re.fullmatch(rf"{re.escape(name)}\[\d+\]", key)]
    return [(f"{role}/{column_mode(i)}", key) for i, key in enumerate(parts or [name])]


def _by_array(roles: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return roles and names with those of one array, tip and tilt, as one."""
    whole = {role.partition("/")[0]: name.removesuffix("[0]") for role, name in roles.items() if name.endswith("[0]")}
    whole = {signal: name for signal, name in whole.items() if roles.get(f"{signal}/tilt") == f"{name}[1]"}
    return [*whole.items(), *((role, name) for role, name in roles.items() if role.partition("/")[0] not in whole)]


def _many_in_one(names: Iterable[str]) -> dict[str, str]:
    """Return the arrays of many columns, as of slopes and actuators, that their names suggest, {signal: name}."""
    many = [name.removesuffix("[2]") for name in names if name.endswith("[2]")]
    roles = {_role_of(f"{name}[0]"): name for name in reversed(many)}
    return {signal: roles[role] for signal in ("y_lgs", "u") if (role := f"{signal}/tip") in roles}


PART = re.compile(r"(?P<stem>.*?)(?P<unit>u|micro|n|nano|milli)(?P<word>_?sec(?:ond)?s?)", re.I)
"""Name of a count of parts of a second; without the unit it is that of the whole ones beside it."""

PARTS = {"u": 1e-6, "micro": 1e-6, "n": 1e-9, "nano": 1e-9, "milli": 1e-3}


def join_clock(file: FileColumns) -> FileColumns:
    """Return the columns of a file, one of whole seconds and one of parts beside it as their sum, the time; this is a guess."""
    names = {name.lower(): name for name in file.columns}
    if any((parse_heading(name) or "")[:1] == (TIME,) for name in names):
        return file
    for match in filter(None, map(PART.fullmatch, file.columns)):
        if (whole := names.get((match["stem"] + match["word"]).lower())) is not None:
            parts = PARTS[match["unit"].lower()] * file.columns.pop(match[0])
            file.columns[f"{TIME}_s"] = file.columns.pop(whole) + parts
            file.guesses.append(f"time by {whole} and {match[0]}")
            break
    return file


def is_counter(values: Array, n: int) -> bool:
    """Return whether values are `n` whole numbers that mostly rise, by few at a time.

    >>> is_counter(np.array([65534.0, 65535.0, 0.0, 1.0, 3.0]), 5), is_counter(np.zeros(9), 9)
    (True, False)
    """
    is_whole = values.size == n > 2 and (values == np.round(values)).all()
    return bool(is_whole and 1 <= np.median(np.diff(values)) <= 1000)


def _has_counter_name(name: str) -> bool:
    words = set(re.findall(r"[a-z]+", name.lower()))
    return bool(words & COUNTERS) and not words & (TIMES | OTHER_COUNTS)


def suggest_roles(names: Iterable[str]) -> dict[str, str]:
    """Return the roles {role: name} that the names of columns suggest, each role and column at most once.

    >>> suggest_roles(["t [ms]", "wfs_x", "wfs_y", "dm_cmd[0]", "dm_cmd[1]", "flux"])
    {'time': 't [ms]', 'y_lgs/tip': 'wfs_x', 'y_lgs/tilt': 'wfs_y', 'u/tip': 'dm_cmd[0]', 'u/tilt': 'dm_cmd[1]'}
    >>> suggest_roles(["tip_res_nm", "tilt_cmd_nm"])
    {'y_lgs/tip': 'tip_res_nm', 'u/tilt': 'tilt_cmd_nm'}
    >>> suggest_roles(["tip [nm]", "tilt [nm]", "DM tip [nm]", "DM tilt [nm]"])  # modes without another word are measured
    {'u/tip': 'DM tip [nm]', 'u/tilt': 'DM tilt [nm]', 'y_lgs/tip': 'tip [nm]', 'y_lgs/tilt': 'tilt [nm]'}
    """
    found: dict[str, str] = {}
    names = [*names]
    many = {name.removesuffix("[2]") for name in names if name.endswith("[2]")}
    for name in names:
        role = _role_of(name)
        if role is not None and re.sub(r"\[\d+\]$", "", name) not in many:  # of many columns it is not known which
            found.setdefault(role, name)
    modes = {split_unit(name)[0].rpartition(".")[2].strip().lower(): name for name in names}
    if modes.keys() >= AXES.keys() and not any(role.startswith("y_lgs") for role in found):
        found |= {f"y_lgs/{mode}": modes[mode] for mode in AXES}
    return found


def suggest_clock(columns: Mapping[str, Array]) -> str | None:
    """Return the first column that always rises, by a step of no less than 10 us and no more than 0.1 s; None without one.

    >>> suggest_clock({"frame": np.arange(9.0), "tip": np.zeros(9), "when": 12.5 + 1e-3 * np.arange(9)})
    'when'
    """
    for name, values in columns.items():
        steps = np.diff(values)
        if steps.size and np.all(steps > 0) and 1e-5 <= np.median(steps) * SECONDS.get(split_unit(name)[1], 1.0) <= 0.1:
            return name
    return None


def _role_of(name: str) -> str | None:
    words = re.findall(r"[a-z]+|\d+", split_unit(name)[0].lower())
    if not words:
        return None
    if _has_counter_name(name):
        return FRAME
    axis = next((mode for mode, known in AXES.items() if words[-1] in known), None)
    rest = words[:-1] if axis and len(words) > 1 else words
    if axis is None and words[0] in AXES:  # x, y and numbers in front are names of other things as well
        axis, rest = words[0], words[1:]
    for signal, known in WORDS.items():
        if axis and known & set(rest):
            return f"{signal}/{axis}"
    return TIME if set(words) & TIMES else None


def describe_values(values: Array) -> str:
    """Describe the values of a column in a few words.

    >>> describe_values(np.array([0.5, np.nan, -0.5]))
    '3 values, 0.5, nan, -0.5 ..., rms 0.5'
    >>> describe_values(np.array([1200.0, 1200.001, 1200.002]))
    '3 values, 1200, 1200.001, 1200.002 ..., rms 1.2e+03'
    """
    known = values[np.isfinite(values)]
    spread = f", rms {np.sqrt(np.mean(known**2)):.3g}" if known.size else ""
    written = ([f"{x:.{digits}g}" for x in values[:3]] for digits in range(4, 17))
    n_different = len({repr(float(x)) for x in values[:3]})
    first = next((texts for texts in written if len(set(texts)) == n_different), [str(x) for x in values[:3]])
    return f"{values.size} values, {', '.join(first)} ...{spread}"


WORST = 1e4
"""Condition beyond which modes are not told from each other."""


@dataclass(frozen=True)
class LoopMatrix:
    """A matrix of a loop.

    Attributes
    ----------
    source : str
        Where it comes from, FILE or FILE:NAME.
    values : tuple of tuple of float
        Its rows.
    keeps_unit : bool
        Whether modes have the unit of slopes, as their means have.
    """

    source: str
    values: tuple[tuple[float, ...], ...]
    keeps_unit: bool = False

    def with_columns(self, n: int, what: str) -> Array:
        """Return it with n columns, transposed where that fits. Raises RecordError."""
        matrix = np.array(self.values, dtype=float)
        if matrix.shape[1] != n:
            matrix = matrix.T
        if matrix.shape[1] != n or not np.isfinite(matrix).all():
            shape = " x ".join(map(str, np.shape(self.values)))
            raise RecordError(f"{self.source}: a matrix of {shape}; it takes one of finite numbers for {n} {what}")
        return matrix


def split_source(text: str) -> tuple[str, str]:
    """Return the file and the name of the array in it, empty where there is none.

    >>> split_source("night.fits:RECON"), split_source("matrix.npy")
    (('night.fits', 'RECON'), ('matrix.npy', ''))
    """
    path, colon, name = text.rpartition(":")
    is_whole = os.path.isfile(text) or path.lower() in TRANSLATED
    return (path, name) if colon and not is_whole else (text, "")


def matrix_of(file: FileColumns, source: str, name: str = "") -> LoopMatrix:
    """Return a matrix of a file. Raises RecordError where there is none of that name, or several without one.

    file : with the matrices of a loop; or an array of two dimensions as columns name[0], name[1], ...; or the positions x and y
        of subapertures: tip and tilt are then the mean slopes of the axes, their least-squares fit whatever the positions are
    """
    if file.matrices:
        name = name or next(iter(file.matrices))
        if name not in file.matrices:
            raise RecordError(f"{source}: has no matrix {name!r}; it has {', '.join(file.matrices)}")
        of = f"{source.removesuffix(f':{name}')}:{name}"
        return LoopMatrix(of, tuple(map(tuple, file.matrices[name].tolist())), name == MEAN_SLOPES)
    axes = {re.split("[^a-z]", split_unit(key)[0].lower())[-1]: values.size for key, values in file.columns.items()}
    if axes.keys() == {"x", "y"} and len(file.columns) == 2:
        return LoopMatrix(source, tuple(map(tuple, mean_slopes(axes["x"]).tolist())), keeps_unit=True)
    found: dict[str, list[Array]] = {}
    for key, values in file.columns.items():
        found.setdefault(key.partition("[")[0], []).append(values)
    if not name and (len(found) > 1 and all(len(columns) == 1 for columns in found.values())):  # a table without names
        found = {"": [column for columns in found.values() for column in columns]}
    name = file.own_name(name) or (next(iter(found)) if len(found) == 1 else "")
    if name not in found:
        what = f"has no matrix {name!r}; it" if name else "which of its arrays is the matrix? It"
        raise RecordError(f"{source}: {what} has {', '.join(sorted(found)[:20])}: give FILE:NAME")
    if len({column.size for column in found[name]}) > 1:
        raise RecordError(f"{source}: {name} has rows of unlike lengths")
    return LoopMatrix(source, tuple(map(tuple, np.array(found[name]).tolist())))


def apply_matrices(signals: dict[str, Array], reconstructor: LoopMatrix | None, command_modes: LoopMatrix | None) -> list[str]:
    """Turn slopes and commands of actuators into modes; return in a few words what was done.

    Modes are R s of slopes s, R (n_modes, n_slopes), and the least-squares solution a = M^+ c of commands c = M a of actuators,
    M (n_actuators, n_modes). A frame of which a slope is missing is missing; NGS and training data are left. Raises RecordError.
    """
    said = []
    for matrix, name, what in ((reconstructor, "y_lgs", "slopes"), (command_modes, "u", "commands")):
        if matrix is not None and name in signals:
            n = signals[name].shape[1]
            rows = matrix.with_columns(n, what)
            if name == "u":
                rows = np.linalg.pinv(rows.T)
            mean = ", the mean of each axis" * matrix.keeps_unit
            said.append(
                f"{len(rows)} modes of {n} {what} by {matrix.source}{mean}, condition {_condition(rows, matrix.source):.3g}"
            )
            signals[name] = signals[name] @ rows.T
    return said


def _condition(rows: Array, source: str) -> float:
    sizes = np.linalg.svd(rows, compute_uv=False)
    condition = float(sizes[0] / sizes[-1]) if sizes[-1] > 0.0 else np.inf
    if len(rows) > rows.shape[1] or condition > WORST:
        raise RecordError(f"{source}: does not tell {len(rows)} modes apart, its condition is {condition:.3g}")
    return condition
