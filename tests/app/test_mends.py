"""Races in Panel that are mended: each test fails without its mend."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from bokeh.application import Application
from bokeh.document import Document
from bokeh.models import Range1d
from bokeh.server.contexts import ApplicationContext
from bokeh.util.token import generate_jwt_token, generate_session_id
from panel.custom import DataEvent, JSComponent
from panel.io import document
from panel.io.state import set_curdoc
from panel.io.state import state as pn_state
from tornado.ioloop import IOLoop

from wfsobs.app.mends import mend_panel


class Setter(JSComponent):
    """Sets the start of a range to what the page says."""

    _esm = "export function render() {}"

    def __init__(self, where: Range1d):
        super().__init__()
        self._where = where

    def _handle_msg(self, data: float) -> None:
        self._where.update(start=data)


def test_an_event_after_a_change_on_its_way_may_change_figures(caplog: pytest.LogCaptureFixture) -> None:
    """A field waits a while for further keys; Panel would answer the event before without the lock of the document."""
    mend_panel()
    mend_panel()  # by every session
    where, answered = Range1d(), []

    async def change() -> None:
        answered.append("change")

    async def main() -> None:
        name = generate_session_id()
        server = ApplicationContext(Application(), io_loop=IOLoop.current())
        page = await server.create_session_if_needed(name, token=generate_jwt_token(name))
        setter = Setter(where)

        def build() -> None:
            with set_curdoc(page.document):
                page.document.add_root(setter.get_root(page.document))
                page.document.add_root(where)

        await page.with_document_locked(build)
        pn_state._change_callbacks[page.document] = {"one": change}
        await page.with_document_locked(lambda: setter._server_event(page.document, DataEvent(None, 3.0)))
        for _ in range(1000):  # as many turns of the loop as the answer takes
            if where.start == 3.0:
                break
            await asyncio.sleep(0.005)

    asyncio.run(main())
    assert (where.start, answered) == (3.0, ["change"])
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


async def turns() -> None:
    """Give everything that is ready its turns: nothing here waits for time."""
    for _ in range(50):
        await asyncio.sleep(0)


class Socket:
    """A connection to a page, and its own socket; says what was written to it, and when that has gone out is up to the test."""

    def __init__(self) -> None:
        self.protocol = self._socket = self
        self.written: list[tuple[str, asyncio.Future[None]]] = []

    def create(self, _kind: str, events: list[str]) -> str:
        return events[0]

    def write_message(self, msg: str) -> list[asyncio.Future[None]]:
        self.written.append((msg, asyncio.get_running_loop().create_future()))
        return [self.written[-1][1]]

    def gone_out(self) -> None:
        for _, future in self.written:
            if not future.done():
                future.set_result(None)


def test_a_message_that_comes_as_the_one_before_has_been_written_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    mend_panel()
    mend_panel()  # by every session
    monkeypatch.setitem(document.extra_socket_handlers, Socket, Socket.write_message)
    socket: Any = Socket()
    events: Any = ["first"], ["second"]

    async def main() -> None:
        doc = Document()
        document.schedule_write_events(doc, [socket], events[0])
        await turns()
        socket.gone_out()
        document.schedule_write_events(doc, [socket], events[1])
        await turns()
        socket.gone_out()
        await turns()
        assert doc not in document._WRITE_MSGS and doc not in document._WRITE_BLOCK

    asyncio.run(main())
    assert [text for text, _ in socket.written] == ["first", "second"]


def test_what_changes_while_a_page_is_on_its_way_is_sent() -> None:
    """Before it is sent, a change is in it; after that it is a message, though the browser has not drawn the page yet."""
    mend_panel()
    mend_panel()
    told: list[Any] = []

    class Connection:
        protocol = type("", (), {"create": staticmethod(lambda _kind, _id, _document: "page")})

    async def main() -> None:
        name = generate_session_id()
        server = ApplicationContext(Application(), io_loop=IOLoop.current())
        page: Any = await server.create_session_if_needed(name, token=generate_jwt_token(name))
        where = Range1d()
        await page.with_document_locked(lambda: page.document.add_root(where))
        page.document.on_change(lambda event: told.append(getattr(event, "new", None)))

        def change(start: float) -> None:
            with set_curdoc(page.document), document.hold():
                where.start = start

        await page.with_document_locked(lambda: change(1.0))
        assert told == []
        assert await page._handle_pull(type("", (), {"header": {"msgid": "1"}}), Connection) == "page"
        await page.with_document_locked(lambda: change(2.0))

    asyncio.run(main())
    assert told == [2.0]
