"""Columns of unknown names: which of them is which signal, as the user says or as their names suggest."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np

from wfsobs.record import RecordError
from wfsobs.sensors.modes import TIP_TILT
from wfsobs.telemetry.formats.contents import CLOCKS, NGS, TIME, Contents, FileColumns, from_columns, pad_fast
from wfsobs.typing import Array
from wfsobs.units import parse_unit

SECONDS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
"""Seconds per unit of time."""

SIGNALS = {
    "y_lgs": "measurement",
    "u": "command",
    NGS: "NGS measurement",
    "turbulence": "true turbulence",
    "vibration": "true vibration",
}

ROLES: dict[str, str] = {TIME: "time"} | {
    f"{signal}/{mode.name}": f"{label}, {mode.name}" for signal, label in SIGNALS.items() for mode in TIP_TILT
}
"""What a column can be -> how it is called."""

UNIT = re.compile(r"[_ \[(]+(?P<unit>[A-Za-zµμ]+)[\])]?$")
"""A unit at the end of a heading, such as `slope [nm]` or `t_ms`."""

WORDS = {
    "turbulence": {"turbulence", "turb", "atmosphere", "atm"},
    "vibration": {"vibration", "vib"},
    NGS: {"ngs"},
    "u": {"u", "command", "commands", "cmd", "cmds", "com", "dm", "mirror", "ttm", "ftm", "actuator", "volts"},
    "y_lgs": {"measurement", "measurements", "meas", "slope", "slopes", "centroid", "centroids", "wfs", "residual", "res", "err"}
    | {"error", "lgs", "y"},
}
"""Words in the name of a column that tell a signal, those that tell most first."""

AXES = {"tip": {"tip", "x", "0"}, "tilt": {"tilt", "y", "1"}}
TIMES = {"time", "t", "timestamp", "stamp", "seconds", "clock"}


def map_columns(file: FileColumns, roles: Mapping[str, str]) -> Contents:
    """Return the contents of a file whose columns have the roles {role: name in the file}.

    Raises
    ------
    RecordError
        There is no such role or no such column, or a column has a unit that is none.
    """
    named = {}
    for role, name in roles.items():
        if role not in ROLES:
            raise RecordError(f"{role[:80]!r} is no part of a record; a column is one of {', '.join(ROLES)}")
        if name not in file.columns:
            raise RecordError(f"has no column {name[:80]!r}; it has {', '.join([*file.columns][:20])}")
        unit = heading_unit(name, file.units.get(name, ""))
        if role in CLOCKS:
            named[role] = file.columns[name] * SECONDS.get(unit, 1.0)
        else:
            named[f"{role}_{unit}" if parse_unit(unit) else role] = file.columns[name]
    contents = from_columns(named)
    pad_fast(contents)
    contents.arrays |= file.plain
    return contents


def heading_unit(name: str, text: str = "") -> str:
    """Return the unit stated beside a column, otherwise the one that its name ends in; empty where neither is one.

    >>> heading_unit("slope x [nm]"), heading_unit("t_ms"), heading_unit("cmd_x")
    ('nm', 'ms', '')
    """
    match = UNIT.search(name)
    for unit in (text.strip(), match["unit"] if match else ""):
        if unit in SECONDS or parse_unit(unit):
            return parse_unit(unit) or unit
    return ""


def suggest_roles(names: Iterable[str]) -> dict[str, str]:
    """Return the roles {role: name} that the names of columns suggest, each role and column at most once.

    >>> suggest_roles(["t [ms]", "wfs_x", "wfs_y", "dm_cmd[0]", "dm_cmd[1]", "flux"])
    {'time': 't [ms]', 'y_lgs/tip': 'wfs_x', 'y_lgs/tilt': 'wfs_y', 'u/tip': 'dm_cmd[0]', 'u/tilt': 'dm_cmd[1]'}
    >>> suggest_roles(["tip_res_nm", "tilt_cmd_nm"])
    {'y_lgs/tip': 'tip_res_nm', 'u/tilt': 'tilt_cmd_nm'}
    """
    found: dict[str, str] = {}
    for name in names:
        role = _role_of(name)
        if role is not None:
            found.setdefault(role, name)
    return found


def suggest_clock(columns: Mapping[str, Array]) -> str | None:
    """Return the first column that always rises, by a step of no less than 10 us and no more than 0.1 s; None without one.

    >>> suggest_clock({"frame": np.arange(9.0), "tip": np.zeros(9), "when": 12.5 + 1e-3 * np.arange(9)})
    'when'
    """
    for name, values in columns.items():
        steps = np.diff(values)
        if steps.size and np.all(steps > 0) and 1e-5 <= np.median(steps) * SECONDS.get(heading_unit(name), 1.0) <= 0.1:
            return name
    return None


def _role_of(name: str) -> str | None:
    bare = UNIT.sub("", name) if heading_unit(name) else name
    words = re.findall(r"[a-z]+|\d+", bare.lower())
    if not words:
        return None
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
