"""The dashboard's own server, for `wfsobs serve`."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import cache, partial
from html import escape
from ipaddress import ip_address
from pathlib import Path
from time import monotonic
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode

import panel as pn
from bokeh.application.application import ServerContext
from bokeh.application.handlers.handler import Handler
from bokeh.document import Document
from bokeh.server.contexts import ApplicationContext, BokehServerContext
from bokeh.server.server import Server
from bokeh.server.session import ServerSession
from bokeh.server.urls import per_app_patterns
from bokeh.server.views.autoload_js_handler import AutoloadJsHandler
from bokeh.server.views.metadata_handler import MetadataHandler
from bokeh.util.token import generate_jwt_token, generate_secret_key, generate_session_id
from panel.io.application import build_applications
from panel.io.resources import get_dist_path
from panel.io.server import DocHandler, get_server
from tornado.httputil import HTTPHeaders, HTTPServerRequest, RequestStartLine
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.web import OutputTransform, RequestHandler

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.limits import NONE, PUBLIC, Limits
from wfsobs.app.live_work import live_counts, share_loop
from wfsobs.app.logs import event, to_stream
from wfsobs.app.pages.pages import LIVE, PAGE, PREFIX
from wfsobs.app.service import Full, Post, Service, Session
from wfsobs.app.share import LONGEST, has_settings
from wfsobs.app.store import FIRST_PRESET
from wfsobs.app.work import one_blas_thread
from wfsobs.campaign.follow import CampaignFolder
from wfsobs.live.loop import LiveOrder
from wfsobs.live.source import prefer
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.values import SettingError

log: logging.Logger = logging.getLogger(__name__)


def session_page(build: Callable[[Post], Dashboard]) -> Any:
    """Build the page of a new session; one with the error where it cannot be built."""
    try:
        if pn.state.curdoc is not None:  # Panel sets it with the HTML, which a session made anew does without
            pn.state.curdoc.template_variables["dist_url"] = get_dist_path()
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
        pn.state.on_session_destroyed(lambda _context: dashboard.store.session.leave())
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
    return urlencode(pn.state.session_args, doseq=True, quote_via=quote)


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
            pn.state.onload(partial(self._run_waiting, None))

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
            with suppress(RuntimeError):  # the server has stopped
                self._loop.call_soon_threadsafe(self._schedule, function)

    def deliver(self) -> None:
        """Run what has been posted so far, before the page is sent: known results are part of it."""
        if self._waiting:
            self._run_waiting([])

    def _run_waiting(self, then: list[Callable[[], None]] | None) -> None:
        with self._lock:
            functions, self._waiting = self._waiting or [], then
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


QUIET = 2.0
"""Idle time of the server before a page is made in advance [s]: making one blocks all pages for half a second."""

EVERY = 0.5
"""How often to look whether a page can be made [s]."""

FRESH = 86_400.0
"""Maximum age of a page made in advance [s]: its token expires."""

NEXT: ContextVar[Session | None] = ContextVar("NEXT", default=None)
"""The session whose page is being made before its visitor comes."""


class NextPage(Handler):
    """The page of the next visitor of the address without a query, made while the server is idle.

    A handler of the application, which the server tells of the context that makes its sessions.
    """

    def __init__(self, service: Service, prefix: str, secret: bytes | None, token_lifetime: int, lifetime: float):
        """Make none yet. prefix, secret, token_lifetime : as the server has them; lifetime : of an unconnected page [s]."""
        super().__init__()
        self.service = service
        self.lifetime = lifetime
        self._prefix, self._secret, self._token_lifetime = f"/{prefix.strip('/')}".rstrip("/"), secret, token_lifetime
        self.context: ApplicationContext | None = None
        self._page: tuple[Session, ServerSession, float] | None = None
        self._looks = PeriodicCallback(self.look, 1e3 * EVERY)

    def modify_document(self, doc: Document) -> None:
        """Leave the page as the other handler of the application makes it."""

    def on_server_loaded(self, server_context: ServerContext) -> None:
        """Look from now on whether a page can be made."""
        assert isinstance(server_context, BokehServerContext)
        self.context = server_context.application_context
        self._looks.start()

    async def look(self) -> None:
        """Make a page if there is none and the server is idle."""
        if self._page and monotonic() - self._page[2] > FRESH:
            self._let_go()
        if self._page is None and not self.service.full and self.service.quiet_seconds > QUIET:
            await self._make()

    def take(self) -> ServerSession | None:
        """Give the page to a visitor; None if there is none."""
        if self._page is None or monotonic() - self._page[2] > FRESH:
            return None
        self._page[0].enter()
        return self._let_go()

    def _let_go(self) -> ServerSession:
        """Release the page; without a connection it expires as all pages do."""
        assert self._page is not None
        session = self._page[1]
        self._page = None
        IOLoop.current().call_later(self.lifetime, session.unblock_expiration)
        return session

    async def _make(self) -> None:
        assert self.context is not None
        session = Session(self.service)
        request = HTTPServerRequest(start_line=RequestStartLine("GET", f"{self._prefix}/", "HTTP/1.0"))
        name = generate_session_id(self._secret, signed=True)
        payload = {"headers": {}, "cookies": {}, "arguments": {}, **self.context.application.process_request(request)}
        token = generate_jwt_token(name, self._secret, signed=True, expiration=self._token_lifetime, extra_payload=payload)
        before = NEXT.set(session)
        try:
            page = await self.context.create_session_if_needed(name, request, token)
        finally:
            NEXT.reset(before)
        page.block_expiration()
        self._page = session, page, monotonic()


class PageHandler(DocHandler):
    """The page: refuses visitors beyond the limit, session names in addresses, and queries that are too long."""

    service: Service
    next_page: NextPage

    async def get_session(self) -> ServerSession:
        """Return the page made in advance, if the address has no query, or make one."""
        self.service.note_wish()
        page = None if self.request.arguments else self.next_page.take()
        if page is not None:
            return page
        made: Any = super().get_session()
        return await made

    async def prepare(self) -> None:
        """Turn the visitor away if the server is full."""
        await super().prepare()
        if self.service.full:
            self.set_status(503)
            self.set_header("Retry-After", "60")
            self.finish(full_html("There are as many visitors as this server takes. Please try again later."))
            return
        arguments = self.request.arguments
        for name in ("bokeh-token", "bokeh-session-id"):
            arguments.pop(name, None)
        self.request.headers.pop("Bokeh-Session-Id", None)
        if len(self.request.query) > LONGEST:  # the page says that it was not used; here it would be sent to and fro
            arguments.clear()


class SecurityHeaders(OutputTransform):
    """Headers of every answer: no guessing of types, no address for other sites, no frame but in the pages named."""

    def __init__(self, embedders: Sequence[str], request: HTTPServerRequest):
        super().__init__(request)
        self._ancestors = " ".join(embedders) or "'none'"

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """Add them; called by Tornado."""
        headers["X-Content-Type-Options"] = "nosniff"
        headers["Referrer-Policy"] = "same-origin"
        headers["Content-Security-Policy"] = f"frame-ancestors {self._ancestors}"
        return status_code, headers, chunk


class Liveness(RequestHandler):
    """Whether the server answers, and how busy it is."""

    def initialize(self, service: Service) -> None:
        """Take what was given beside the pattern; called by Tornado."""
        self.service = service

    def get(self) -> None:
        """Answer in JSON."""
        queue = self.service.queue
        counts = {"ok": True, "sessions": self.service.sessions, "running": queue.running, "waiting": queue.length}
        self.write(counts | live_counts(self.service.live_loop))


def full_html(line: str) -> str:
    """Return the page for visitors beyond the limit."""
    return f"<!doctype html><title>wfsobs</title><h1>wfsobs is full</h1><p>{escape(line)}</p>"


CACHE_MB = 256
MESSAGE_BYTES = 6_000_000
"""The largest message that is read from a browser; a scenario file comes as one."""

TOKEN = 30 * 86_400
"""For how long a page may come back to its session, where that is still there [s]."""

TURN = 0.001
"""How long the interpreter stays with one thread while another waits [s]: the page's own has short things to do."""

SAVE_TIME = 60.0
"""Longest wait at the end for the record of a loop to be written [s]."""

UNUSED = (AutoloadJsHandler, MetadataHandler)
"""Ways into a session that this page does not need."""


@dataclass(frozen=True)
class Options:
    """How to serve.

    origins    : HOST or HOST:PORT that browsers reach the server by, where it is not the address: behind a proxy
    embedders  : origins whose pages may show the dashboard in a frame
    prefix     : path of the page, where a proxy serves other things beside it
    runs       : jobs at once, of every kind; 0 for as many as there are processors
    lifetime   : of the settings of a page that is not connected any more, or has never been [s]
    cache_mb   : results kept [MB]
    log_level  : debug, info, warning or error
    log_requests : also a line per request, which holds the address it came from
    campaign   : folder of the campaign to show; empty for none
    """

    port: int = 5006
    address: str = "localhost"
    open_browser: bool = False
    origins: Sequence[str] = ()
    embedders: Sequence[str] = ()
    prefix: str = ""
    limits: Limits = NONE
    runs: int = 0
    cache_mb: int = CACHE_MB
    lifetime: float = 60.0
    log_level: str = "info"
    log_requests: bool = False
    campaign: str = ""


def options(*, public: bool | None = None, runs: int | None = None, **values: Any) -> Options:
    """Options as the command line gives them; those of the limits start with max_ and are None where not given.

    public : whether there are limits; None for where more than this machine reaches the page

    >>> options(origins=("ao.example.org",), max_duration=300.0, max_steps=300_000, max_depth=None).limits.steps
    300000
    """
    own = {key.removeprefix("max_").replace("memory", "megabytes"): values.pop(key) for key in list(values) if key[:4] == "max_"}
    if public is None:
        public = bool(values.get("origins")) or not is_local(values.get("address", "localhost"))
    limits = replace(PUBLIC if public else NONE, **{key: value for key, value in own.items() if value is not None})
    return Options(limits=limits, runs=runs or 0, **values)


PAINTS = -5
"""Niceness of the thread that draws the pages of a live loop: behind what keeps time, before the rest of the machine."""


def serve(options: Options, live: LiveOrder | None = None) -> None:
    """Serve the dashboard at http://address:port/prefix until SIGINT or SIGTERM. Raises SettingError.

    live : a loop that runs until then, and that every page opens with; where it cannot go on the server ends with exit status 2
    """
    to_stream(options.log_level, options.log_requests)
    prepare()
    service = make_service(options.limits, options.runs, options.cache_mb)
    if options.campaign:
        service.campaign = CampaignFolder(Path(options.campaign))
    with suppress(SettingError):  # larger than the limits allow
        service.queue.submit(service.run(PRESETS[FIRST_PRESET]()), "server", lambda _news: None)
    loop, status = IOLoop.current(), 0

    def fail() -> None:
        nonlocal status
        status = 2
        loop.add_callback(loop.stop)

    server = make_server(options, service, is_warm=live is None)
    if live is not None:
        share_loop(live, service, fail)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: loop.add_callback_from_signal(loop.stop))
    event(
        "serving",
        url=f"http://{options.address}:{server.port}{server.prefix}/",
        runs=service.queue.workers,
        cache_mb=options.cache_mb,
        limits="on" if options.limits != NONE else "off",
    )
    server.start()
    service.keep_page()
    if live is not None:
        prefer(PAINTS)
    loop.start()
    server.stop(wait=False)
    ended = service.close(SAVE_TIME if live is not None and live.record_file else 1.5)
    event("stopped", sessions=service.sessions)
    gc.freeze()  # what is left need not be looked through once more
    if not ended:  # a computation that does not listen must not keep the process
        logging.shutdown()
        sys.stdout.flush()
        os._exit(status)
    if status:
        sys.exit(status)


def make_service(limits: Limits, runs: int = 0, cache_mb: int = CACHE_MB) -> Service:
    """Make what the sessions of a server share."""
    return Service(limits, runs or os.cpu_count() or 1, cache_mb * 1_000_000)


def prepare() -> None:
    """Set up this process: its runs are threads beside the page's own."""
    one_blas_thread()
    sys.setswitchinterval(TURN)


@cache
def shared_service() -> Service:
    """Return the one service of a process that something else serves: `panel serve app`."""
    prepare()
    service = make_service(NONE)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, partial(_end, service, signal.getsignal(number)))
    return service


def _end(service: Service, then: Any, number: int, frame: Any) -> None:
    """Have the runs stop on a signal, and leave the rest to whoever was to hear of it."""
    service.queue.closing = True
    if callable(then):
        then(number, frame)
    else:
        sys.exit(0)


def new_page(service: Service, session: Session | None = None) -> Any:
    """Build the page of a session, by default of a new visitor's."""
    try:
        session = session or NEXT.get() or service.enter()
    except Full as error:
        return pn.pane.HTML(full_html(str(error)), margin=40)
    pn.state.on_session_destroyed(lambda _context: session.leave())
    return session_page(lambda post: Dashboard(post, session))


def make_server(options: Options, service: Service, *, is_warm: bool = True) -> Server:
    """Make a server that listens but has not started. Raises SettingError where it cannot listen.

    is_warm : whether a page is made and dropped first, as its imports take longer than the page; one of a live loop needs the
        event loop to run
    """
    secret = generate_secret_key()
    warm = iter([Session(service)] if is_warm else [])
    applications: Any = build_applications({"/": lambda: new_page(service, next(warm, None))}, title="wfsobs")
    ready = NextPage(service, options.prefix, secret.encode(), TOKEN, options.lifetime)
    applications["/"].add(ready)
    door = type("Door", (PageHandler,), {"service": service, "next_page": ready})
    routes = list(per_app_patterns)
    per_app_patterns[:] = [
        (entry[0], door if issubclass(entry[1], DocHandler) else entry[1]) for entry in routes if not issubclass(entry[1], UNUSED)
    ]
    try:
        return get_server(
            applications,
            port=options.port,
            address=options.address,
            show=options.open_browser,
            prefix=options.prefix,
            warm=is_warm,
            websocket_origin=origins(options),
            websocket_max_message_size=MESSAGE_BYTES,
            use_xheaders=bool(options.origins),
            # A session is reached by a name that this server has signed, and keeps nothing of who the visitor is.
            sign_sessions=True,
            secret_key=secret,
            include_headers=[],
            include_cookies=[],
            session_token_expiration=TOKEN,  # a page that was open for days may come back as well
            unused_session_lifetime_milliseconds=round(1000 * options.lifetime),
            check_unused_sessions_milliseconds=round(250 * options.lifetime),
            extra_patterns=[("/liveness", Liveness, {"service": service})],
            transforms=[partial(SecurityHeaders, options.embedders)],
        )
    except OSError as error:
        raise SettingError(f"{options.address}:{options.port}: {error.strerror or error}") from None
    finally:
        per_app_patterns[:] = routes


def origins(options: Options) -> list[str]:
    """HOST:PORT that a page may come from to open a websocket."""
    own = [f"{name}:{options.port}" for name in (options.address, "localhost", "127.0.0.1")]
    return sorted({*own, *options.origins})


def is_local(address: str) -> bool:
    """Whether only this machine reaches an address.

    >>> is_local("localhost"), is_local("127.0.0.1"), is_local("::1"), is_local("0.0.0.0"), is_local("ao.example.org")
    (True, True, True, False, False)
    """
    try:
        return ip_address(address.strip("[]")).is_loopback
    except ValueError:
        return address.lower() == "localhost"
