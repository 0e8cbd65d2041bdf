"""Progress and cancelling of long computations."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count

import numpy as np
from numpy.typing import NDArray


class Cancelled(Exception):
    """Error: the computation was stopped on request."""


def _never() -> bool:
    return False


def _silent(_fraction: float) -> None:
    return None


def _keep(_target: str, _values: NDArray[np.float64]) -> None:
    return None


@dataclass(frozen=True)
class Watch:
    """Callbacks of a computation; all are called from the working thread.

    Attributes
    ----------
    progress : callable
        Receives the fraction done, 0 to 1.
    is_cancelled : callable
        Asked at every block of work; true stops it.
    partial : callable
        Receives (target, values so far, with NaN where not yet computed) from observers that compute in blocks.
    """

    progress: Callable[[float], None] = field(default=_silent, repr=False)
    is_cancelled: Callable[[], bool] = field(default=_never, repr=False)
    partial: Callable[[str, NDArray[np.float64]], None] = field(default=_keep, repr=False)

    def check(self) -> None:
        """Raise `Cancelled` if the computation is to stop."""
        if self.is_cancelled():
            raise Cancelled

    def part(self, start: float, share: float) -> Watch:
        """Return the watch of a part: its progress is `share` of this one's, from `start` on, and it stops with this one."""
        return Watch(lambda fraction: self.progress(start + share * fraction), self.is_cancelled)

    @property
    def silent(self) -> Watch:
        """A watch that stops with this one and reports nothing."""
        return Watch(is_cancelled=self.is_cancelled)

    def step(self, fraction: float) -> None:
        """Report progress; raise `Cancelled` if the computation is to stop."""
        self.check()
        self.progress(fraction)


QUIET = Watch()

_KEYS, _LISTENING = count(), dict[int, Watch]()


@contextmanager
def detach_watch(watch: Watch) -> Iterator[Watch]:
    """Yield a watch that reports to another without a reference to it or to what its callbacks know."""
    key = next(_KEYS)
    _LISTENING[key] = watch
    try:
        yield Watch(
            lambda fraction: _LISTENING[key].progress(fraction),
            lambda: _LISTENING[key].is_cancelled(),
            lambda target, values: _LISTENING[key].partial(target, values),
        )
    finally:
        del _LISTENING[key]
