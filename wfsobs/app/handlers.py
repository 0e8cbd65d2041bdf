"""What the server answers with: the page, whether it is alive, and that there is no room."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from bokeh.server.session import ServerSession
from panel.io.server import DocHandler
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.web import OutputTransform, RequestHandler

from wfsobs.app.live_work import live_counts
from wfsobs.app.ready import NextPage
from wfsobs.app.service import Service
from wfsobs.app.share import LONGEST


class PageHandler(DocHandler):
    """The page: turns visitors away who are too many, and takes no session's name and no endless query from an address."""

    service: Service
    next_page: NextPage

    async def get_session(self) -> ServerSession:
        """Return the page that is ready where the address asks for nothing else, or make one."""
        self.service.note_wish()
        page = None if self.request.arguments else self.next_page.take()
        if page is not None:
            return page
        made: ServerSession = await super().get_session()  # type: ignore[misc]
        return made

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
    """Write the page for a visitor for whom there is no room."""
    return f"<!doctype html><title>wfsobs</title><h1>wfsobs is full</h1><p>{escape(line)}</p>"
