"""Messages of the page's own components."""

from __future__ import annotations

import asyncio

import pytest
from bokeh.application import Application
from bokeh.models import Range1d
from bokeh.server.contexts import ApplicationContext
from bokeh.util.token import generate_jwt_token, generate_session_id
from panel.custom import DataEvent
from panel.io.state import set_curdoc
from panel.io.state import state as pn_state
from tornado.ioloop import IOLoop

from wfsobs.app.style import Component


class Setter(Component):
    """A component that does nothing in the browser."""

    _esm = "export function render() {}"


def test_an_event_after_a_change_on_its_way_may_change_figures(caplog: pytest.LogCaptureFixture) -> None:
    """A field waits a while for further keys; Panel would answer the event before without the lock of the document."""
    where, answered = Range1d(), []

    async def change() -> None:
        answered.append("change")

    async def main() -> None:
        name = generate_session_id()
        server = ApplicationContext(Application(), io_loop=IOLoop.current())
        page = await server.create_session_if_needed(name, token=generate_jwt_token(name))
        setter = Setter(lambda message: where.update(start=message["start"]))

        def build() -> None:
            with set_curdoc(page.document):
                page.document.add_root(setter.get_root(page.document))
                page.document.add_root(where)

        await page.with_document_locked(build)
        pn_state._on_load(page.document)  # it has been drawn
        pn_state._change_callbacks[page.document] = {"one": change}
        await page.with_document_locked(lambda: setter._server_event(page.document, DataEvent(None, {"start": 3.0})))
        for _ in range(1000):  # as many turns of the loop as the answer takes
            if where.start == 3.0:
                break
            await asyncio.sleep(0.005)

    asyncio.run(main())
    assert (where.start, answered) == (3.0, ["change"])
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []
