"""All the modes of an observer at the same time."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from wfsobs.progress import Watch
from wfsobs.typing import Array

CORES = 2
"""Processors of the machine that computing times were measured on (`wfsobs.cost`)."""

AT_ONCE = max(os.cpu_count() or 1, 2)
"""Modes at work at the same time: more would only need more memory."""


def turns(n_modes: int) -> int:
    """How many modes that machine does one after the other, where modes run side by side."""
    return -(-n_modes // CORES)


def over_modes(n_modes: int, work: Callable[[int, Watch], Array], watch: Watch) -> Array:
    """Columns work(mode, watch) of every mode, as many at a time as there are processors, (n_steps, n_modes).

    If one fails, or the wait for them is interrupted, the others are told to stop by the watch they were given.
    """
    stop = threading.Event()
    told = replace(watch, is_cancelled=lambda: stop.is_set() or watch.is_cancelled())
    with ThreadPoolExecutor(min(n_modes, AT_ONCE)) as pool:
        try:
            return np.column_stack(list(pool.map(lambda mode: work(mode, told), range(n_modes))))
        except BaseException:
            stop.set()
            raise
