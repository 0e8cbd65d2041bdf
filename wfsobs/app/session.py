"""A new session's page: built, tied to its address, and told of what other threads do; or what went wrong instead."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import traceback
from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any
from urllib.parse import quote, urlencode

import panel as pn

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.service import Post

log = logging.getLogger(__name__)


def session_page(build: Callable[[Post], Dashboard]) -> Any:
    """Build the page of a new session; one with the error where it cannot be built."""
    try:
        dashboard = build(post_to_session())
        if query := page_query():
            dashboard.actions.open_link(query)
        session_page = dashboard.page()
        if query:
            dashboard.actions.open_view(query)
        dashboard.start()
        pn.state.on_session_destroyed(lambda _context: dashboard.close())
        return session_page
    except Exception as error:
        log.exception("the page could not be built")
        return error_page(error)


def page_query() -> str:
    """Return the query of the page's address.

    If a browser connects so late that its session is made anew, it is the query with which the page was fetched.
    """
    if pn.state.location is not None and pn.state.location.search:
        return str(pn.state.location.search)
    texts = [(key, value) for key, values in pn.state.session_args.items() for value in values]
    return urlencode(texts, quote_via=quote)


def post_to_session() -> Post:
    """Return a function by which other threads run something on this session's thread, once its page has been drawn.

    What is changed before does not reach a browser that is just being told of the page, so it waits.
    """
    doc = pn.state.curdoc
    if doc is None:
        return lambda function: function()
    try:
        loop = asyncio.get_running_loop()
    except RuntimeError:
        loop = None
    waiting: list[Callable[[], None]] | None = []
    lock = threading.Lock()

    def loaded() -> None:
        nonlocal waiting
        with lock:
            functions, waiting = waiting or [], None
        for function in functions:
            held(function)

    def held(function: Callable[[], None]) -> None:
        with pn.io.hold():
            function()

    def post(function: Callable[[], None]) -> None:
        with lock:
            if waiting is not None:
                waiting.append(function)
                return
        if loop is None:
            schedule(function)
        else:  # several threads post, and a document is not made for that: one of two callbacks may be lost
            with contextlib.suppress(RuntimeError):  # the server has stopped
                loop.call_soon_threadsafe(schedule, function)

    def schedule(function: Callable[[], None]) -> None:
        if doc.session_context is not None and not doc.session_context.destroyed:
            doc.add_next_tick_callback(partial(held, function))

    pn.state.onload(loaded)
    return post


def error_page(error: Exception) -> pn.Column:
    """Show the error in place of a page that could not be built."""
    line = "".join(traceback.format_exception_only(error)).strip()
    return pn.Column(
        pn.pane.HTML(
            "<h1>wfsobs could not start</h1><p>The page could not be built. The server's log has the details.</p>"
            f"<pre>{escape(line)}</pre>"
        ),
        margin=40,
    )
