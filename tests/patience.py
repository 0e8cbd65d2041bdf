"""How long tests wait for what is to be there at last, and for what is to be gone: a busy machine is no fault."""

from __future__ import annotations

import time
from collections.abc import Callable

ENOUGH = 240.0
"""[s]"""


def wait(condition: Callable[[], object], pause: float = 0.02) -> None:
    """Wait until it holds, looking at it every `pause` [s]."""
    end = time.monotonic() + ENOUGH
    while not condition():
        assert time.monotonic() < end
        time.sleep(pause)


def is_running(pid: int) -> bool:
    """Return whether a process has not ended."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):  # it may end between opening and reading
        return False
