"""How long work tells its progress and hears that it is no longer wanted."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray


class Cancelled(Exception):
    """The work was stopped on request."""


def _never() -> bool:
    return False


def _silent(_fraction: float) -> None:
    return None


def _keep(_target: str, _values: NDArray[np.float64]) -> None:
    return None


@dataclass(frozen=True)
class Watch:
    """Callbacks into whoever started the work; all are called from the working thread.

    progress  : told the fraction done, 0 to 1
    cancelled : asked at every block of work; true stops it
    partial   : given (target, values so far with NaN where nothing is known yet) by observers that
                deliver in blocks
    """

    progress: Callable[[float], None] = _silent
    cancelled: Callable[[], bool] = _never
    partial: Callable[[str, NDArray[np.float64]], None] = _keep

    def check(self) -> None:
        """Raises Cancelled if the work is no longer wanted."""
        if self.cancelled():
            raise Cancelled

    def step(self, fraction: float) -> None:
        """Report progress. Raises Cancelled if the work is no longer wanted."""
        self.check()
        self.progress(fraction)


QUIET = Watch()

_KEYS, _LISTENING = count(), dict[int, Watch]()


@contextmanager
def detach_watch(watch: Watch) -> Iterator[Watch]:
    """A watch that reports to another and holds no reference to it, nor to what its callbacks know of."""
    key = next(_KEYS)
    _LISTENING[key] = watch
    try:
        yield Watch(
            lambda fraction: _LISTENING[key].progress(fraction),
            lambda: _LISTENING[key].cancelled(),
            lambda target, values: _LISTENING[key].partial(target, values),
        )
    finally:
        del _LISTENING[key]
