"""Results kept for all sessions: the latest wanted ones, up to a number of bytes, their arrays read-only."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import threading
from collections.abc import Hashable, Iterator, Mapping
from contextlib import suppress
from typing import Any, TypeVar

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from wfsobs.scenario import Scenario

T = TypeVar("T")


def key_of(scenario: Scenario, record: str = "") -> str:
    """Name the results of a scenario: the same settings give the same key, and in practice no others do.

    record : names the record that the observers ran on, where it was not simulated from the scenario

    >>> key_of(Scenario()) == key_of(Scenario().replace({"turbulence.wind_speed": 15})) != key_of(Scenario(), "mine")
    True
    """
    text = json.dumps([record, scenario.to_dict()], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def arrays_in(value: Any) -> Iterator[NDArray[Any]]:
    """Every array in nested dataclasses, mappings, lists and tuples."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, (list, tuple, Mapping)):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from arrays_in(item)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from arrays_in(getattr(value, field.name))


def freeze(value: T) -> T:
    """Make the arrays of a value read-only."""
    for array in arrays_in(value):
        array.flags.writeable = False
    return value


def size_of(value: Any) -> int:
    """Memory that the arrays in a value hold [bytes], shared ones counted once."""
    return sum(owners_in(value).values())


def owners_in(value: Any) -> dict[int, int]:
    """Return the id of every array that owns memory in a value, and its size [bytes]."""
    owners: dict[int, int] = {}
    for array in arrays_in(value):
        owner: Any = array
        while isinstance(owner.base, np.ndarray):
            owner = owner.base
        owners[id(owner)] = owner.nbytes
    return owners


class Cache:
    """Least recently used goes first; for any thread.

    most_bytes : of arrays in all; what is larger by itself is not kept
    """

    def __init__(self, most_bytes: int):
        self.most_bytes = most_bytes
        self._entries: LRUCache[Hashable, Any] = LRUCache(most_bytes, size_of)
        self._lock = threading.Lock()

    def get(self, key: Hashable) -> Any:
        """Return the value under a key, or None."""
        with self._lock:
            return self._entries.get(key)

    def put(self, key: Hashable, value: T) -> T:
        """Keep a value, in place of the least wanted ones; gives it back, its arrays read-only."""
        freeze(value)
        with self._lock, suppress(ValueError):  # larger than all that is kept
            self._entries.pop(key, None)
            self._entries[key] = value
        return value

    def __contains__(self, key: Hashable) -> bool:
        with self._lock:
            return key in self._entries
