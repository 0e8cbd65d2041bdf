"""Kinds of value of a setting and their limits, its error, and settings as plain values: nested dictionaries, dotted paths."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import param


class SettingError(ValueError):
    """Error: a setting that cannot be used; one line naming the setting, its value and what is allowed."""


@contextmanager
def errors_of(what: str, kind: type[ValueError] = SettingError) -> Iterator[None]:
    """Prefix the message of an error, such as with the name of a file."""
    try:
        yield
    except kind as error:
        raise kind(f"{what}: {error}") from None


SOURCES: Mapping[str, str] = MappingProxyType(
    {
        "Record": "as of wfsobs.load(path)",
        "Scenario": 'such as wfsobs.PRESETS["paper"]()',
    }
)
"""Where arguments of public functions come from."""


def check_kind(function: str, value: object, kind: type) -> None:
    """Raise SettingError where an argument of a public function is of another type, such as a path."""
    if not isinstance(value, kind):
        raise SettingError(f"{function} takes a {kind.__name__}, {SOURCES[kind.__name__]}, not {shorten(value)}")


_WORDS = reprlib.Repr()  # stops at a depth, where `repr` would end in a RecursionError
_WORDS.maxlist = _WORDS.maxtuple = _WORDS.maxdict = 40
_WORDS.maxstring = _WORDS.maxother = _WORDS.maxlong = 400


def shorten(value: Any, most: int = 80) -> str:
    """Return a value in at most `most` characters."""
    text = _WORDS.repr(value)
    return text if len(text) <= most else text[: most - 3] + "..."


def error_line(error: BaseException) -> str:
    """Return an error in one line; an error of the code has its type."""
    text = " ".join(str(error).split())
    return text if isinstance(error, (ValueError, AssertionError)) and text else f"{type(error).__name__}: {text}".strip(": ")


Plain = dict[str, Any]
"""A tree as plain values: nested dictionaries, lists, numbers, strings and booleans."""


def to_native(value: Any) -> Any:
    """Convert NumPy scalars, alone or in a list, to Python's own: a setting is read again without NumPy."""
    if isinstance(value, np.generic):
        return value.item()
    return [to_native(v) for v in value] if isinstance(value, (list, tuple)) else value


def leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted path, value) of a (partial) dictionary of settings; lists as a whole."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def put_value(node: Any, keys: list[str], value: Any, path: str) -> bool:
    """Put `value` into nested plain values, and return whether a list grew; unknown names are left for `update` to refuse."""
    key = keys[0]
    grown = False
    if isinstance(node, list):
        if not key.isdecimal() or int(key) > len(node):
            raise SettingError(f"{path}: the list has {len(node)} entries, numbered from 0; {len(node)} adds one")
        index = int(key)
        if index == len(node):
            node.append({} if len(keys) > 1 else None)
            grown = True
        if len(keys) == 1:
            node[index] = value
        else:
            grown |= put_value(node[index], keys[1:], value, path)
    elif isinstance(node, dict):
        if len(keys) == 1:
            node[key] = value
        elif key in node:
            grown = put_value(node[key], keys[1:], value, path)
        elif node:
            raise SettingError(f"{path}: no such setting; {key!r} is not one of {', '.join(node)}")
        else:
            raise SettingError(f"{path}: the entry is new; give it a whole {key} first")
    else:
        raise SettingError(f"{path}: no such setting")
    return grown


Bounds = tuple[float, float]


class Real(param.Number[float]):
    """A finite number; integers become floats, booleans and NaN are refused."""

    def __init__(self, default: float = 0.0, bounds: Bounds | None = None, label: str = "", doc: str = "", **kwargs: Any):
        super().__init__(default, bounds=bounds, label=label or None, doc=doc, **kwargs)

    if not TYPE_CHECKING:
        __get__ = param.Parameter.__get__
        """Without param's look for a function that makes the number, which takes most of the time of reading settings."""

    def __set__(self, obj: Any, val: Any) -> None:
        super().__set__(obj, _as_float(val))

    def _validate_value(self, val: Any, allow_None: bool) -> None:
        if isinstance(val, bool) or not isinstance(val, float) or not math.isfinite(val):
            raise ValueError(f"{self.name} takes a finite number, not {val!r}")
        super()._validate_value(val, allow_None)


class Whole(param.Integer[int]):
    """A whole number; booleans are refused."""

    def __init__(self, default: int = 0, bounds: tuple[int, int] | None = None, label: str = "", doc: str = "", **kwargs: Any):
        super().__init__(default, bounds=bounds, label=label or None, doc=doc, **kwargs)

    if not TYPE_CHECKING:
        __get__ = param.Parameter.__get__

    def _validate_value(self, val: Any, allow_None: bool) -> None:
        if isinstance(val, bool):
            raise ValueError(f"{self.name} takes a whole number, not {val!r}")
        super()._validate_value(val, allow_None)


class Reals(param.List[list[float]]):
    """A list of finite numbers, each within `item_bounds`; its length within `bounds`."""

    __slots__ = ["item_bounds"]
    item_bounds: Bounds

    def __init__(
        self,
        default: Sequence[float],
        item_bounds: Bounds,
        bounds: tuple[int, int | None] = (0, None),
        label: str = "",
        doc: str = "",
        **kwargs: Any,
    ):
        self.item_bounds = item_bounds
        super().__init__([float(v) for v in default], bounds=bounds, label=label or None, doc=doc, **kwargs)

    def __set__(self, obj: Any, val: Any) -> None:
        if isinstance(val, (list, tuple)):
            val = [_as_float(v) for v in val]
        super().__set__(obj, val)

    def _validate_value(self, val: Any, allow_None: bool) -> None:
        super()._validate_value(val, allow_None)
        low, high = self.item_bounds
        for v in val:
            if not isinstance(v, float) or not low <= v <= high:
                raise ValueError(f"{self.name} takes numbers from {low:g} to {high:g}, not {v!r}")


class Choice(param.Selector[str]):
    """One of some words, by default the first."""

    def __init__(self, objects: list[str], label: str, doc: str):
        super().__init__(default=objects[0], objects=objects, label=label, doc=doc)


def _as_float(value: Any) -> Any:
    """Return an integer as a float; any other value, and one that no float can hold, unchanged."""
    if isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            pass
    return value


def allowed_values(p: param.Parameter[Any]) -> str:
    """Return the values that a setting takes, as the end of a one-line message."""
    unit = f" {u}" if (u := unit_of(p)) else ""
    if isinstance(p, Reals):
        low, high = p.item_bounds
        shortest, longest = p.bounds or (0, 0)
        return f"takes a list of {shortest:g} to {longest:g} numbers from {low:g} to {high:g}{unit}"
    if isinstance(p, param.Selector):
        return f"takes one of {', '.join(map(str, p.objects))}"
    if isinstance(p, param.Boolean):
        return "takes true or false"
    if isinstance(p, param.Number):
        kind = "a whole number" if isinstance(p, param.Integer) else "a number"
        low, high = p.bounds or (None, None)
        above, below = p.inclusive_bounds
        start = f"{'from' if above else 'above'} {low:g}"
        return f"takes {kind} {start} {'to' if below else 'and below'} {high:.10g}{unit}"
    return f"takes a {getattr(p, 'class_', object).__name__.lower()}"


def hint(value: object) -> str:
    """Return advice on a number typed with a comma, alone or in a list; empty for any other value.

    >>> hint("15,5"), hint([1.0, "0,5"]), hint("fast"), hint(15.5)
    ('; use a point: 15.5', '; use a point: 0.5', '', '')
    """
    if isinstance(value, list):
        return next((said for v in value if isinstance(v, str) and (said := hint(v))), "")
    if isinstance(value, str) and re.fullmatch(r"\s*[-+−]?\d*,\d+\s*", value):
        return f"; use a point: {value.strip().replace(',', '.')}"
    return ""


def unit_of(p: param.Parameter[Any]) -> str:
    """Return the unit of a setting: the text in [brackets] in its documentation, or nothing."""
    match = re.search(r"(?<=\s)\[([^\]]+)\]", p.doc or "")
    return match.group(1) if match else ""


def declared_settings(cls: type[param.Parameterized]) -> dict[str, param.Parameter[Any]]:
    """Return name -> param.Parameter of every setting of a class, in order of declaration."""
    return {name: p for name, p in cls.param.objects("existing").items() if name != "name"}


settings_once = cache(declared_settings)
"""Return `declared_settings` of a class that gets no more of them: asked some thousand times for a change of one."""
