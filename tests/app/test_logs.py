"""What an operator reads: stable lines, nothing of what visitors send."""

from __future__ import annotations

import io
import logging
import re
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from tornado.websocket import WebSocketClosedError

from wfsobs.app.jobs import Job
from wfsobs.app.limits import NONE
from wfsobs.app.logs import event, to_stream
from wfsobs.app.service import Service
from wfsobs.app.work import RunResults
from wfsobs.scenario import Scenario

LINE = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} (INFO|WARNING|ERROR) ")


@pytest.fixture
def written() -> Iterator[io.StringIO]:
    """The log, as it would be written; all loggers as they were afterwards."""
    names = ["", "wfsobs", "panel", "bokeh", "tornado.access"]
    before = {
        name: (logging.getLogger(name).handlers[:], logging.getLogger(name).level, logging.getLogger(name).propagate)
        for name in names
    }
    root = logging.getLogger()
    root.handlers[:] = []  # which to_stream would close
    stream = io.StringIO()
    to_stream("info", stream=stream)
    yield stream
    for name, (handlers, level, propagate) in before.items():
        logger = logging.getLogger(name)
        logger.handlers[:], logger.propagate = handlers, propagate
        logger.setLevel(level)


def test_an_event_is_a_line_of_fields(written: io.StringIO) -> None:
    event("run-end", run=3, seconds=0.12345, state="done", said='two "words"')
    line = written.getvalue()
    assert LINE.match(line)
    assert line.endswith("INFO run-end run=3 seconds=0.123 state=done said=\"two 'words'\"\n")


def test_a_run_from_beginning_to_end(written: io.StringIO, short: Scenario) -> None:
    def fails(*_: Any) -> RunResults:
        raise RuntimeError("no such luck")

    service, failure, end = Service(NONE, 1, 0, fails), threading.Event(), threading.Event()
    session = service.enter()
    session.submit(service.run(short), lambda news: failure.set() if "message" in news else None)
    session.submit(Job("identify", lambda *_: None, cost=1.5), lambda news: end.set() if "result" in news else None)
    assert failure.wait(20) and end.wait(20)  # the line of its end is written before a job tells its result
    session.leave()
    assert service.close(20)
    said = [LINE.sub("", line) for line in written.getvalue().splitlines() if LINE.match(line) and " failed" not in line]
    shapes = [re.sub(r"=[\d.a-f]+\b", "=#", line) for line in said]
    assert shapes == [
        "session-start session=# sessions=#",
        "result session=# key=# cache=miss",
        "run-start run=# session=# wait=# estimate=#",
        "run-end run=# state=failed seconds=#",
        "identify-start identify=# session=# wait=# estimate=#",
        "identify-end identify=# state=done seconds=#",
        "session-end session=# seconds=# sessions=#",
    ]
    assert " ERROR run-end" in written.getvalue()


def test_what_visitors_send_stays_out(written: io.StringIO) -> None:
    bokeh = logging.getLogger("bokeh.server.views.ws")
    try:
        raise ValueError("no JSON")
    except ValueError as error:
        bokeh.error("Unhandled exception receiving a message: %r: %r", error, "my secret", exc_info=True)
    bokeh.error("Token for session %r had invalid signature", "x" * 44)
    logging.getLogger("tornado.application").error(
        "Uncaught exception GET /ws (10.0.0.7)\nHTTPServerRequest(remote_ip='10.0.0.7')"
    )
    logging.getLogger("tornado.access").warning("404 GET /mine (10.0.0.7) 0.3ms")
    said = [LINE.sub(r"\1 ", line) for line in written.getvalue().splitlines()]
    assert said == [
        "WARNING Unhandled exception receiving a message",
        "WARNING Token for session '...' had invalid signature",
        "WARNING Uncaught exception GET /ws",
    ]


def test_faults_of_our_own_keep_their_traceback(written: io.StringIO) -> None:
    bokeh = logging.getLogger("bokeh.server.protocol_handler")
    try:
        Scenario().set("no.such", 1)
    except ValueError as error:
        bokeh.error("error handling message\n message: %r \n error: %r", "my secret", error, exc_info=True)
    assert " ERROR error handling message" in written.getvalue()
    assert "Traceback" in written.getvalue() and "no such setting" in written.getvalue()
    assert "my secret" not in written.getvalue()


def test_a_page_that_closed_while_it_was_written_to_leaves_no_traceback_and_another_fault_does(written: io.StringIO) -> None:
    """As the loop of events reports tasks that nobody waited for."""
    for error in (WebSocketClosedError(), RuntimeError("no such luck")):
        logging.getLogger("asyncio").error("Task exception was never retrieved", exc_info=error)
    said = written.getvalue()
    assert "WebSocketClosedError" not in said and said.count("never retrieved") == 1
    assert " ERROR Task exception was never retrieved" in said and "RuntimeError: no such luck" in said
