"""Axes that have come to rest: what follows them is done once, when a drag or a zoom is over."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import panel as pn
from bokeh.models import Range1d

SETTLE_MS = 60
"""A zoom is answered when the window has not moved for this long."""


AFTERWARDS_MS = 500
"""What a change has beside its picture is told this much later: until then the processors are the run's and the browser's."""


def on_settle(axes: Iterable[Range1d], function: Callable[[], None]) -> None:
    """Call a function a little after an axis has moved, once for all moves until then."""
    settled = once(function, SETTLE_MS)

    def moved(_attr: str, _old: object, _new: object) -> None:
        settled()

    for axis in axes:
        axis.on_change("start", moved)
        axis.on_change("end", moved)


def once(function: Callable[[], None], milliseconds: int) -> Callable[..., None]:
    """Return what has a function called a little later, once for all calls until then."""
    waiting = False

    def ask(*_: object) -> None:
        nonlocal waiting
        if not waiting:
            waiting = True
            later(answer, milliseconds)

    def answer() -> None:
        nonlocal waiting
        waiting = False
        function()

    return ask


def zoom_of(axis: Range1d) -> tuple[float, float] | None:
    """Return what of an axis is in view; None where all of it is."""
    start, end, first, last = (float(x) for x in (axis.start, axis.end, axis.reset_start, axis.reset_end) if x is not None)  # type: ignore[arg-type]
    start, end = min(start, end), max(start, end)
    return None if start <= first and end >= last else (start, end)


def later(function: Any, milliseconds: int) -> None:
    """Call a function a little later on the session's thread; at once where there is no session, or no page in its browser."""
    doc = pn.state.curdoc
    if doc is None or doc.session_context is None or not pn.state.loaded:
        function()
    else:
        doc.add_timeout_callback(function, milliseconds)
