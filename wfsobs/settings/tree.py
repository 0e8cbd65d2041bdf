"""Settings as plain values: nested dictionaries, dotted paths."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from wfsobs.settings.errors import SettingError

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
