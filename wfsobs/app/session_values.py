"""Values of a session's file, checked one by one: nothing of it is trusted."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, TypeVar

from wfsobs.evaluation.calibration import Calibration
from wfsobs.evaluation.scores import Score
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.units import UNITS

LONGEST_TEXT = 2_000

DAMAGED = "damaged, or no session of wfsobs"

T = TypeVar("T")


class SessionError(ValueError):
    """Error: a file that is no session that can be opened; one line saying why."""


def read_declaration(values: Mapping[str, Any]) -> DeclaredFormat:
    """Read what was said of a record's file. Raises SessionError."""
    unit, sign, delay, rate = (values.get(name) for name in ("unit", "command_sign", "command_delay", "rate"))
    columns, trust = get_value(values, "columns", dict), values.get("trust", False)
    valid = (
        (unit is None or unit in UNITS)
        and sign in (None, 1, -1)
        and (delay is None or (type(delay) is int and 1 <= delay < 1e6))
        and (rate is None or (type(rate) in (int, float) and 0 < rate < 1e6))
        and isinstance(trust, bool)
        and len(columns) <= 64
        and all(isinstance(name, str) and len(name) <= LONGEST_TEXT for name in columns.values())
    )
    if not valid:
        raise SessionError("what is said of a record makes no sense")
    return DeclaredFormat(unit, sign, delay, rate, columns, trust)


def read_score(values: Any) -> Score:
    """Read a score. Raises SessionError."""
    if not isinstance(values, dict):
        raise SessionError(DAMAGED)
    text, one, some = partial(get_text, values), partial(get_number, values), partial(_get_numbers, values)
    calibration = some("calibration", 4)
    return Score(
        text("observer"),
        text("target"),
        text("mode"),
        one("rms"),
        one("truth_rms"),
        _get_optional(values, "normalised_rms"),
        _get_optional(values, "lag"),
        one("seconds_per_step"),
        _get_optional(values, "start"),
        _get_optional(values, "stop"),
        get_value(values, "apart", bool),
        some("interval", 2),  # type: ignore[arg-type]
        some("phases", None),
        Calibration(*calibration) if calibration else None,
    )


def get_value(values: Mapping[str, Any], name: str, kind: type[T]) -> T:
    """Return a value of one type and no other. Raises SessionError."""
    value = values.get(name)
    if type(value) is not kind:
        raise SessionError(f"{name} is missing or of the wrong kind")
    return value


def get_text(values: Mapping[str, Any], name: str, most: int = LONGEST_TEXT) -> str:
    """Return a text, cut at some characters. Raises SessionError."""
    return get_value(values, name, str)[:most]


def get_number(values: Mapping[str, Any], name: str) -> float:
    """Return a number. Raises SessionError."""
    value = values.get(name)
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise SessionError(f"{name} takes a number")
    return float(value)


def _get_optional(values: Mapping[str, Any], name: str) -> float | None:
    return None if values.get(name) is None else get_number(values, name)


def _get_numbers(values: Mapping[str, Any], name: str, count: int | None) -> tuple[float, ...] | None:
    listed = values.get(name)
    if listed is None:
        return None
    if type(listed) is not list or len(listed) > 1000 or (count is not None and len(listed) != count):
        raise SessionError(f"{name} takes a list of numbers")
    return tuple(get_number({name: item}, name) for item in listed)
