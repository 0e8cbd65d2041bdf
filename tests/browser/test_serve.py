"""The command's own server, as strangers meet it."""

from __future__ import annotations

import signal
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import BrowserContext, Page, expect

from tests.browser.conftest import PATIENCE, leave

pytestmark = pytest.mark.slow

FLAGS = ["--public", "--runs", "1", "--max-duration", "100", "--max-seconds", "3600", "--lifetime", "5"]
"""Runs of a page that is gone stop with its session, and only then the next one begins."""

LONG = "?run.duration=100&adaptive.interval=0.05&gpr_online.training_size=1000&run.seed="
"""A run that no test waits for the end of, however long its other steps take."""


@pytest.fixture(scope="module")
def serve(make_server: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A server with limits, which has to have gone without a fault."""
    server = make_server(["-m", "wfsobs", "serve", "--port", "{port}", *FLAGS], tmp_path_factory.mktemp("serve") / "log", "/")
    yield server
    if server.process.poll() is None:
        server.close()
    assert server.errors(0) == []


def new_page(context: BrowserContext, serve: Any, query: str) -> Page:
    page = context.new_page()
    page.set_viewport_size({"width": 1400, "height": 1000})
    page.set_default_timeout(PATIENCE)
    page.goto(serve.url + query)
    return page


@pytest.fixture
def visit(context: BrowserContext, serve: Any) -> Iterator[Callable[..., Page]]:
    """A function that opens the page for one more visitor: every page has a session of its own."""
    opened: list[Page] = []

    def open_it(query: str = "") -> Page:
        opened.append(new_page(context, serve, query))
        return opened[-1]

    yield open_it
    for page in opened:
        leave(page)


def status(page: Page, text: str) -> None:
    """Wait until the line on the run reads so."""
    page.locator("[role=status]", has_text=text).first.wait_for(state="attached")


def start(page: Page) -> None:
    status(page, "press Run")
    page.get_by_role("button", name="Run", exact=True).first.click()


@pytest.mark.parametrize("path", ["", "liveness", "static/js/bokeh.min.js", "none"])
def test_every_answer_has_the_headers_that_protect_a_page(serve: Any, path: str) -> None:
    try:
        headers = urllib.request.urlopen(serve.url + path).headers
    except urllib.error.HTTPError as error:
        headers = error.headers
    assert headers.get_all("X-Content-Type-Options") == ["nosniff"]
    assert headers.get_all("Referrer-Policy") == ["same-origin"]
    assert headers.get_all("Content-Security-Policy") == ["frame-ancestors 'none'"]


def test_visitors_wait_in_line_with_every_kind_of_work_and_a_click_goes_first(visit: Callable[..., Page], tmp_path: Path) -> None:
    first, second = visit(LONG + "4"), visit(LONG + "5")
    start(first)
    status(first, "Running")
    start(second)
    status(second, "Waiting: position 1")
    (tmp_path / "log.csv").write_text("seeing,airmass\n1,2\n", encoding="utf-8")
    second.get_by_label("Record file").set_input_files(tmp_path / "log.csv")
    expect(second.locator(".bar > [role=status]", has_text="Waiting: position 1")).to_be_visible()  # the reading of the file
    status(second, "Waiting: position 2")
    first.get_by_role("button", name="Cancel", exact=True).click()
    status(first, "Cancelled")
    expect(second.get_by_text("log.csv: has no y_lgs").first).to_be_visible()
    status(second, "Running")


@pytest.fixture(scope="module")
def limited(context: BrowserContext, serve: Any) -> Iterator[Page]:
    """A page whose link has more than the limits, for the tests below."""
    page = new_page(context, serve, "?run.duration=101&turbulence.wind_speed=21")
    status(page, "Done in")
    yield page
    leave(page)


def test_more_than_the_limits_is_refused(limited: Page) -> None:
    page = limited
    expect(page).to_have_title("wfsobs")
    note = page.get_by_text("Not used from the link: run.duration = 101: at most 100 s on this server")
    expect(note).to_be_visible()
    expect(page.get_by_role("textbox", name="m/s")).to_have_value("21")


@pytest.fixture
def elsewhere() -> Iterator[str]:
    """Another site, on another port."""
    site = ThreadingHTTPServer(("localhost", 0), BaseHTTPRequestHandler)
    thread = threading.Thread(target=site.serve_forever)
    thread.start()
    yield f"http://localhost:{site.server_port}"
    site.shutdown()
    thread.join()
    site.server_close()


def test_a_page_of_elsewhere_cannot_connect(limited: Page, serve: Any, elsewhere: str) -> None:
    """A page of another origin, which has got hold of a session's token, opens a websocket with it."""
    page = limited
    token = page.evaluate('() => document.documentElement.innerHTML.match(/"token":"([^"]+)"/)[1]')
    connect = """([url, token]) => new Promise((done) => {
        const socket = new WebSocket(url, ["bokeh", token])
        socket.onmessage = () => done("connected")
        socket.onclose = () => done("refused")
    })"""
    url = serve.url.replace("http://", "ws://") + "ws"
    assert page.evaluate(connect, [url, token]) == "connected", "the page's own origin may"
    page.goto(elsewhere)
    assert page.evaluate(connect, [url, token]) == "refused"
    assert f"Refusing websocket connection from Origin '{elsewhere}'" in serve.log.read_text()


def test_told_to_stop_in_the_middle_of_a_run(visit: Callable[..., Page], serve: Any) -> None:
    """The last of this module: the server of all ends here."""
    page = visit(LONG + "3")
    start(page)
    status(page, "Running")
    serve.process.send_signal(signal.SIGTERM)
    assert serve.process.wait(60) == 0  # the run would take minutes
    log = serve.log.read_text()
    assert "Traceback" not in log and "ERROR" not in log
    assert " INFO stopped sessions=" in log.rstrip().splitlines()[-1]
