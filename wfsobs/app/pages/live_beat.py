"""When the pictures of a live loop are due: at times that all pages have in common, so that they share what is in them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from wfsobs.app.service import Post
from wfsobs.live.view import SHARED

PERIOD = SHARED
"""Between two pictures [s]: of pages that are late with one, those up to the next one still share a reading."""


class Beat:
    """Has a page drawn when a picture is due, on the thread of its session, which has an event loop.

    A picture that is late does not delay those that follow.

    Parameters
    ----------
    post : callable
        Has a function run on that thread.
    draw : callable
        Draws.
    """

    def __init__(self, post: Post, draw: Callable[[], None]):
        self._post, self._draw = post, draw
        self._loop = asyncio.get_running_loop()
        self._due = 0.0
        self._next: asyncio.TimerHandle | None = None

    @property
    def runs(self) -> bool:
        """Whether pictures are due."""
        return self._next is not None

    def start(self) -> None:
        """Draw again and again."""
        if self._next is None:
            self._plan()

    def stop(self) -> None:
        """Draw no more."""
        if self._next is not None:
            self._next.cancel()
            self._next = None

    def _plan(self) -> None:
        """Wait for the next due time; of those that have passed only the last one is left."""
        now = self._loop.time()
        self._due = next_due(self._due, now)
        self._next = self._loop.call_at(self._due, self._post, self._ring)

    def _ring(self) -> None:
        if self._next is not None:
            try:
                self._draw()
            finally:
                self._plan()


def next_due(due: float, now: float) -> float:
    """Return the multiple of PERIOD that follows `due`, or the last one before `now` if that is later [s].

    >>> round(next_due(0.32, 0.36), 2), round(next_due(0.32, 0.52), 2), round(next_due(0.32, 0.9), 2)
    (0.48, 0.48, 0.8)
    """
    return PERIOD * max(round(due / PERIOD) + 1, int(now / PERIOD))
