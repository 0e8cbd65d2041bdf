"""The network goes, the server goes, and what a visitor has done meanwhile does not."""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import BrowserContext, Page, Route, expect

from tests.browser.conftest import PATIENCE, QUICK, answered, finished, leave, until, with_seeds

pytestmark = pytest.mark.slow


def hang_up(end: socket.socket) -> None:
    """Close the connection at once: `close` would wait for the thread that reads from it."""
    try:
        end.shutdown(socket.SHUT_RDWR)
    except OSError:
        pass
    end.close()


HEAD = re.compile(rb'\{"msgid"[^}]*\}')
"""The first part of a message."""


class Cable:
    """What lies between browser and server, and can be cut."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.to, self.whole, self.lock = 0, True, threading.Lock()
        self.quick = threading.Event()
        self.quick.set()
        self.within = threading.Event()
        self.ends: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self.listener.accept()
            except OSError:
                return
            with self.lock:
                try:
                    if not self.whole:
                        raise OSError
                    far = socket.create_connection(("127.0.0.1", self.to))
                except OSError:
                    near.close()
                    continue
                self.ends += [near, far]
            for one, other in ((near, far), (far, near)):
                threading.Thread(target=self._carry, args=(one, other, one is far), daemon=True).start()

    def _carry(self, one: socket.socket, other: socket.socket, back: bool) -> None:
        try:
            while part := one.recv(65536):
                if back:
                    self.quick.wait()
                if back and self.within.is_set() and (head := HEAD.search(part)):
                    other.sendall(part[: head.end()])
                    self.within.clear()
                    break
                other.sendall(part)
        except OSError:
            pass
        for end in (one, other):
            hang_up(end)

    def cut(self) -> None:
        with self.lock:
            self.whole = False
            for end in self.ends:
                hang_up(end)
            self.ends = []

    def cut_within(self) -> None:
        """Cut the connection by which the server's next message comes, after the first of its parts."""
        self.within.set()

    def mend(self, quick: bool = True) -> None:
        """Make it whole again; what the server says arrives later unless it is quick."""
        if not quick:
            self.quick.clear()
        self.whole = True


@pytest.fixture(scope="module")
def cable() -> Iterator[Cable]:
    cable = Cable()
    yield cable
    cable.listener.close()
    cable.cut()


class Host:
    """The server at the far end of the cable; it can be killed and started again where it was."""

    def __init__(self, make_server: Any, cable: Cable, folder: Path):
        self.make, self.cable, self.folder, self.started = make_server, cable, folder, 0
        self.start()

    def start(self) -> None:
        self.started += 1
        command = ["-m", "wfsobs", "serve", "--local", "--port", "{port}", "--origin", f"localhost:{self.cable.port}"]
        self.server = self.make(command, self.folder / f"log{self.started}", "/", port=self.cable.to)
        self.cable.to = self.server.port

    def kill(self) -> None:
        self.server.process.kill()
        self.server.process.wait(20)


@pytest.fixture(scope="module")
def host(make_server: Any, cable: Cable, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Host]:
    host = Host(make_server, cable, tmp_path_factory.mktemp("host"))
    yield host
    host.server.close()
    assert host.server.errors(0) == []


ALERTS = """() => {
  const toggle = HTMLElement.prototype.togglePopover
  window.alerts = []
  HTMLElement.prototype.togglePopover = function (...args) {
    const isShown = toggle.apply(this, args)
    if (isShown) window.alerts.push(this.textContent)
    return isShown
  }
}"""
"""Keeps what alerts have said: on a busy machine one that goes by itself is gone before somebody looks."""


LOST = """() => {
  const send = WebSocket.prototype.send
  let parts = []
  WebSocket.prototype.send = function (text) {
    if (String(text).includes('"msgtype"')) parts = []
    parts.push(text)
    if (parts.length < 3) return
    const isLost = parts[2].includes('"drawn"')
    if (isLost) WebSocket.prototype.send = send
    else for (const it of parts.length > 3 ? [text] : parts) send.call(this, it)
  }
}"""
"""Loses the message, of three parts, by which the page first says that its picture stands: it is said again."""


@pytest.fixture(scope="module")
def opened(context: BrowserContext, cable: Cable, host: Host) -> Iterator[Page]:
    """The page at the end of the cable, its first run over."""
    page = context.new_page()
    page.set_viewport_size({"width": 1400, "height": 1000})
    page.set_default_timeout(PATIENCE)
    page.add_init_script(f"({ALERTS})(), ({LOST})()")
    page.goto(with_seeds(f"http://localhost:{cable.port}/{QUICK}", 1))
    finished(page)
    yield page
    leave(page)


@pytest.fixture
def page(opened: Page) -> Page:
    """That page as the test before has left it, connected, with a settled address."""
    expect(peak(opened)).to_be_visible()  # the table of peaks follows the page
    expect(banner(opened, "Connected again")).to_be_hidden()
    answered(opened)
    opened.evaluate("() => { window.alerts = [] }")
    return opened


def done(page: Page) -> None:
    page.locator("[role=status]", has_text="Done in").first.wait_for(state="attached")


def speed(page: Page, text: str) -> None:
    box = page.get_by_role("textbox", name="m/s")
    box.fill(text)
    box.press("Enter")


LINK = "Bokeh.index.roots[0].model.document.wfsobs"
"""What watches the connection."""
CONNECTING = f"() => {LINK}.connection?.socket?.readyState === WebSocket.CONNECTING"
"""Whether the browser has a socket that waits for its answer: it cannot be sent by yet."""


def peak(page: Page) -> Any:
    return page.locator('input[data-cell="0.frequency"]')


def banner(page: Page, text: str) -> Any:
    return page.get_by_role("alert").filter(has_text=text)


def connected_again(page: Page) -> None:
    """Wait until the page has said so."""
    until(page, "() => window.alerts.some((it) => it.includes('Connected again'))")


def test_offline_for_a_while(page: Page) -> None:
    page.context.set_offline(True)
    expect(banner(page, "This computer is offline")).to_be_visible()
    speed(page, "22")
    page.context.set_offline(False)
    connected_again(page)
    until(page, "() => location.search.includes('turbulence.wind_speed=22')")
    expect(page.get_by_role("alert").filter(has_text="Connected again")).to_be_hidden()
    done(page)


def test_an_answer_that_comes_late(page: Page, cable: Cable) -> None:
    page.evaluate(f"() => {{ window.before = {LINK}.socket }}")
    cable.quick.clear()
    expect(banner(page, "The server does not answer")).to_be_visible()
    held: list[Route] = []
    page.route("**/static/**", lambda route: held.append(route))
    with page.expect_request(lambda request: request.method == "HEAD"):  # whether the server is there at all
        pass
    cable.quick.set()
    expect(banner(page, "The server does not answer")).to_be_hidden()
    for it in held:
        it.continue_()
    page.unroute("**/static/**")
    asked = page.evaluate(f"() => {LINK}.asked")
    until(page, f"asked => {LINK}.model?.last_arrival > asked + 1", arg=asked)  # longer than it takes to close a socket
    assert page.evaluate(f"() => {LINK}.socket === window.before")


def test_a_socket_that_carries_nothing(page: Page) -> None:
    page.evaluate(f"() => {{ {LINK}.socket.send = () => {{}} }}")
    expect(banner(page, "The server does not answer")).to_be_visible()
    speed(page, "23")
    connected_again(page)
    until(page, "() => location.search.includes('turbulence.wind_speed=23')")
    done(page)


def test_a_cut_line_comes_back_to_the_same_session(page: Page, cable: Cable) -> None:
    page.get_by_role("button", name="Pin this run to compare others with it").click()
    expect(page.get_by_text("Compared with, faint in the figures")).to_be_visible()
    cable.cut()
    expect(banner(page, "connection to the server is lost")).to_be_visible()
    speed(page, "24")
    peak(page).fill("6.5")
    peak(page).press("Enter")
    page.get_by_role("button", name="+ Add peak").click()
    peaks = page.locator('[data-cell$=".frequency"]').count()
    cable.mend()
    connected_again(page)
    until(page, "() => location.search.includes('turbulence.wind_speed=24')")
    until(page, "() => location.search.includes('vibration.peaks=6.5,')")
    expect(page.locator('[data-cell$=".frequency"]')).to_have_count(peaks + 1)
    expect(page.get_by_role("status").filter(has_text="Compared with")).to_contain_text(
        "Wind speed V₀ 23 → 24 m/s"
    )  # the same session: its pinned run is there
    done(page)


def test_a_line_cut_in_the_middle_of_a_message(page: Page, cable: Cable) -> None:
    cable.cut_within()
    speed(page, "25")
    connected_again(page)
    until(page, "() => location.search.includes('turbulence.wind_speed=25')")
    assert not cable.within.is_set()
    done(page)


def test_what_is_changed_while_the_line_comes_back_counts_once(page: Page, cable: Cable) -> None:
    peaks = page.locator('[data-cell$=".frequency"]').count()
    cable.cut()
    expect(banner(page, "connection to the server is lost")).to_be_visible()
    cable.mend(quick=False)
    until(page, CONNECTING)
    peak(page).fill("7")
    peak(page).press("Enter")
    page.get_by_role("button", name="+ Add peak").click()
    damping = page.locator('input[data-cell="0.damping"]')
    damping.fill("0.02")  # and on with the typing
    cable.quick.set()
    connected_again(page)
    until(page, "() => location.search.includes('vibration.peaks=7,0.02,')")
    expect(page.locator('[data-cell$=".frequency"]')).to_have_count(peaks + 1)
    expect(damping).to_have_value("0.02")
    done(page)


def test_a_server_that_was_started_again(page: Page, host: Host) -> None:
    speed(page, "26")
    until(page, "() => location.search.includes('turbulence.wind_speed=26')")
    host.kill()
    expect(banner(page, "connection to the server is lost")).to_be_visible()
    speed(page, "200")
    peak(page).fill("7.5")
    peak(page).press("Enter")
    host.start()
    again = page.get_by_role("button", name="Start again with these settings")
    expect(again).to_be_visible()
    again.click()
    expect(peak(page)).to_have_value("7.5")
    expect(banner(page, "Wind speed V₀ = 200: takes a number from 0.1 to 100 m/s").first).to_be_visible()
    expect(page.get_by_role("textbox", name="m/s")).to_have_value("200")
    until(page, "() => location.search.includes('turbulence.wind_speed=26')")
    until(page, "() => location.search.includes('vibration.peaks=7.5,')")
    done(page)
