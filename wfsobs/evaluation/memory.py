"""Memory of computations: what was made last under a name, where a setting moves; and that of arrays that are freed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

FREED = 31 * 2**20
"""Size of the largest array whose memory is used again; the C library of Linux allows 32 MiB [bytes]."""


def keep_freed_memory() -> None:
    """Have arrays up to FREED take the memory of those before them.

    The C library of Linux returns every array to the system that is larger than any freed before. One of a few MB after the
    other is then cleared page by page, which takes as long as what is done with them.
    """
    np.empty(FREED, dtype=np.uint8)


class Identity:
    """An object as a key: equal to the same object only, which it keeps from being thrown away."""

    def __init__(self, it: object):
        self.it = it

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Identity) and other.it is self.it

    def __hash__(self) -> int:
        return id(self.it)


class Memory:
    """Of one result per name, with the key that it was made for."""

    def __init__(self) -> None:
        self._results: dict[str, tuple[Any, Any]] = {}

    def keep(self, name: str, key: Any, make: Callable[[], Any]) -> Any:
        """Return what was made last under a name if its key is the same, else make it."""
        last = self._results.get(name)
        if last is None or last[0] != key:
            self._results[name] = last = key, make()
        return last[1]
