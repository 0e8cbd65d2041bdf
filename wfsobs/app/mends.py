"""Three faults of Panel 1.9, mended until it does so itself: races that leave a page which says what is no longer so."""

from __future__ import annotations

from functools import wraps
from typing import Any
from weakref import WeakSet

from bokeh.document import Document
from bokeh.document.events import DocumentPatchedEvent, MessageSentEvent
from bokeh.server.session import ServerSession
from panel.io import document
from panel.io.document import with_lock
from panel.reactive import Syncable


def mend_panel() -> None:
    """Mend them; a second time does nothing."""
    lock_events()
    send_all_messages()
    keep_changes_of_sent_pages()


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


def keep_changes_of_sent_pages() -> None:
    """Have changes sent that come after a page has been sent, and before the browser has drawn it.

    Panel drops what changes before a page is drawn, as that would be in the page: what changes while it is on its way is not. A
    figure that comes meanwhile is then missing for good.
    """
    drain: Any = document._drain_unconnected_events
    if hasattr(drain, "__wrapped__"):
        return
    sent: WeakSet[Document] = WeakSet()
    pull: Any = ServerSession._handle_pull

    @wraps(pull)
    async def note_pull(session: ServerSession, *arguments: Any) -> Any:
        reply = await pull(session, *arguments)
        sent.add(session.document)
        return reply

    @wraps(drain)
    def drain_after_sending(doc: Document, lock: Any) -> list[Any]:
        if doc not in sent:
            return drain(doc, lock)
        with lock:
            held = doc.callbacks._held_events or []
            patches = [event for event in held if isinstance(event, DocumentPatchedEvent)]
            changes = [event for event in patches if not isinstance(event, MessageSentEvent)]
            doc.callbacks._held_events = [event for event in held if event not in changes]
        return [*changes, *drain(doc, lock)]

    ServerSession._handle_pull = note_pull  # type: ignore[method-assign]
    document._drain_unconnected_events = drain_after_sending
