"""Two faults of Panel 1.9, mended until it does so itself: races, rare, that leave a page which says what is no longer so."""

from __future__ import annotations

from functools import wraps
from typing import Any

from bokeh.document import Document
from panel.io import document
from panel.io.document import with_lock
from panel.reactive import Syncable


def mend_panel() -> None:
    """Mend both; a second time does nothing."""
    lock_events()
    send_all_messages()


def lock_events() -> None:
    """Have every event of a page answered under its document's lock.

    While a changed property is on its way, Panel answers an event without it, and a figure that is changed then raises.
    """
    if not getattr(Syncable._event_coroutine, "lock", False):
        Syncable._event_coroutine = with_lock(Syncable._event_coroutine)


def send_all_messages() -> None:
    """Have every message sent that waits for the one before to be written.

    Panel takes the mark that messages wait away when it has written some, also where another has come meanwhile: that one stays
    until something else changes.
    """
    dispatch: Any = document._dispatch_msgs
    if hasattr(dispatch, "__wrapped__"):
        return

    @wraps(dispatch)
    async def dispatch_all(doc: Document) -> None:
        await dispatch(doc)
        if doc in document._WRITE_MSGS and doc not in document._WRITE_BLOCK:
            document._WRITE_BLOCK[doc] = True
            document._dispatch_write_task(doc, dispatch_all, doc)

    document._dispatch_msgs = dispatch_all
