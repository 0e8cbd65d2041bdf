"""How other threads reach a session's page."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from bokeh.application import Application
from bokeh.models import Range1d
from bokeh.server.contexts import ApplicationContext
from bokeh.util.token import generate_jwt_token, generate_session_id
from panel.custom import DataEvent, JSComponent
from panel.io.state import set_curdoc
from panel.io.state import state as pn_state
from tornado.ioloop import IOLoop

from wfsobs.app import session


class Page:
    """A document that notes who asks it for what."""

    def __init__(self) -> None:
        self.session_context = SimpleNamespace(destroyed=False)
        self.callbacks: list[Any] = []
        self.threads: set[int] = set()

    def add_next_tick_callback(self, callback: Any) -> None:
        self.threads.add(threading.get_ident())
        self.callbacks.append(callback)


def test_only_its_own_thread_touches_the_document(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight threads at once: nothing is lost, and the document, not made for several threads, sees one."""
    page, done = Page(), []
    state = SimpleNamespace(curdoc=page, onload=lambda function: function())
    monkeypatch.setattr(session, "pn", SimpleNamespace(state=state, io=session.pn.io))

    async def main() -> None:
        post = session.Poster()

        def many(i: int) -> None:
            for k in range(100):
                post(partial(done.append, (i, k)))

        with ThreadPoolExecutor(8) as pool:
            loop = asyncio.get_running_loop()
            await asyncio.gather(*(loop.run_in_executor(pool, many, i) for i in range(8)))

    asyncio.run(main())
    assert page.threads == {threading.get_ident()}
    for callback in page.callbacks:
        callback()
    assert sorted(done) == [(i, k) for i in range(8) for k in range(100)]


def test_what_is_known_goes_with_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is posted while a page is built runs before anybody is told of it; what comes of that waits until it is drawn."""
    page, done, loaded = Page(), [], []
    state = SimpleNamespace(curdoc=page, onload=loaded.append)
    monkeypatch.setattr(session, "pn", SimpleNamespace(state=state, io=session.pn.io))
    post = session.Poster()
    post(lambda: (done.append("result"), post(partial(done.append, "next"))))
    assert done == []
    post.deliver()
    assert done == ["result"]
    loaded[0]()
    assert done == ["result", "next"] and page.callbacks == []


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
    session.lock_events()
    session.lock_events()  # by every session
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
