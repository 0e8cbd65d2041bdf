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
from urllib.parse import parse_qsl, quote, urlencode

import panel as pn

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.pages.pages import LIVE
from wfsobs.app.service import Post
from wfsobs.app.share import has_settings
from wfsobs.app.view_state import PAGE, PREFIX

log = logging.getLogger(__name__)


def session_page(build: Callable[[Post], Dashboard]) -> Any:
    """Build the page of a new session; one with the error where it cannot be built."""
    try:
        post = Poster()
        dashboard = build(post)
        query = page_query()
        dashboard.store.rests = opens_on_live(query, dashboard.store.session.service.live is not None)
        if has_settings(query) or (query and dashboard.store.session.service.live is None):
            dashboard.actions.open_link(query)  # else the settings are those of the loop that all pages show
        session_page = dashboard.page()
        if query:
            dashboard.actions.open_view(query)
        dashboard.start()
        post.deliver()
        pn.state.on_session_destroyed(lambda _context: dashboard.close())
        return session_page
    except Exception as error:
        log.exception("the page could not be built")
        return error_page(error)


def opens_on_live(query: str, is_shared: bool) -> bool:
    """Whether a page opens on the live loop: by its address, or because all pages show one."""
    return dict(parse_qsl(query.removeprefix("?"))).get(PREFIX + PAGE, LIVE if is_shared else "") == LIVE


def page_query() -> str:
    """Return the query of the page's address.

    If a browser connects so late that its session is made anew, it is the query with which the page was fetched.
    """
    if pn.state.location is not None and pn.state.location.search:
        return str(pn.state.location.search)
    texts = [(key, value) for key, values in pn.state.session_args.items() for value in values]
    return urlencode(texts, quote_via=quote)


class Poster:
    """Has other threads run something on this session's thread.

    What is changed while a browser is being told of the page does not reach it. So what is posted before it has been drawn waits,
    but for what `deliver` lets go with the page.
    """

    def __init__(self) -> None:
        """Post to the present session; at once where there is none."""
        self._doc = pn.state.curdoc
        try:
            self._loop: asyncio.AbstractEventLoop | None = asyncio.get_running_loop()
        except RuntimeError:
            self._loop = None
        self._waiting: list[Callable[[], None]] | None = []
        self._lock = threading.Lock()
        if self._doc is not None:
            pn.state.onload(self._on_load)

    def __call__(self, function: Callable[[], None]) -> None:
        """Have a function run; from any thread."""
        if self._doc is None:
            function()
            return
        with self._lock:
            if self._waiting is not None:
                self._waiting.append(function)
                return
        if self._loop is None:
            self._schedule(function)
        else:  # several threads post, and a document is not made for that: one of two callbacks may be lost
            with contextlib.suppress(RuntimeError):  # the server has stopped
                self._loop.call_soon_threadsafe(self._schedule, function)

    def deliver(self) -> None:
        """Run what has been posted so far, before anybody is told of the page: results that are known go with it."""
        with self._lock:
            if not self._waiting:
                return
            functions, self._waiting = self._waiting, []
        for function in functions:
            _run_held(function)

    def _on_load(self) -> None:
        with self._lock:
            functions, self._waiting = self._waiting or [], None
        for function in functions:
            _run_held(function)

    def _schedule(self, function: Callable[[], None]) -> None:
        doc: Any = self._doc
        if doc.session_context is not None and not doc.session_context.destroyed:
            doc.add_next_tick_callback(partial(_run_held, function))


def _run_held(function: Callable[[], None]) -> None:
    with pn.io.hold():
        function()


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
