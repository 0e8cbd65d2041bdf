"""A page that stands before its visitor comes: to make one takes longer than to show it."""

from __future__ import annotations

from contextvars import ContextVar
from time import monotonic

from bokeh.application.application import ServerContext
from bokeh.application.handlers.handler import Handler
from bokeh.document import Document
from bokeh.server.contexts import ApplicationContext, BokehServerContext
from bokeh.server.session import ServerSession
from bokeh.util.token import generate_jwt_token, generate_session_id
from tornado.httputil import HTTPServerRequest, RequestStartLine
from tornado.ioloop import IOLoop, PeriodicCallback

from wfsobs.app.service import Service, Session

QUIET = 2.0
"""How long nobody must have wanted anything before a page is made [s]: it keeps the thread of all pages for half a second."""

EVERY = 0.5
"""How often to look whether a page can be made [s]."""

FRESH = 86_400.0
"""A page that has waited longer is made anew [s]: its token expires."""

NEXT: ContextVar[Session | None] = ContextVar("NEXT", default=None)
"""The session whose page is being made before its visitor comes."""


class NextPage(Handler):
    """The page of the next visitor who asks for the address alone; made while the server has nothing else to do.

    A handler of the application, which the server tells of the context that makes its sessions.
    """

    def __init__(self, service: Service, prefix: str, secret: bytes | None, token_lifetime: int, lifetime: float):
        """Make none yet. prefix, secret, token_lifetime : as the server has them; lifetime : of an unconnected page [s]."""
        super().__init__()
        self.service, self.lifetime = service, lifetime
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
        """Make a page if there is none, and nobody wants anything."""
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
        """Hold the page no more; it ends as all pages do if nobody connects to it."""
        assert self._page is not None
        session = self._page[1]
        self._page = None
        IOLoop.current().call_later(self.lifetime, session.unblock_expiration)
        return session

    async def _make(self) -> None:
        assert self.context is not None
        session = self.service.new_session()
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
