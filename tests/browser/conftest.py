"""The dashboard in a browser: a server in a process of its own, and a page that tolerates no error.

A console error, a request that leaves the machine or a traceback in the server's log fails the test.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, JSHandle, Page, expect, sync_playwright

from wfsobs.app.style import observers_of
from wfsobs.priors_from.scenario import usual_observers
from wfsobs.scenario.presets import PRESETS

ROOT = Path(__file__).parents[2]
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SEEDS = "view.seeds="
QUICK = "?run.duration=2&run.warm_up=0.5&gpr_online.training_size=40&gpr_offline.training_size=40&adaptive.window=0.5"
"""Settings of a short record: what one test has had run, a server knows for the next."""
PRESET = {"run.duration": 4.0, "run.warm_up": 1.0, "adaptive.window": 1.0}
"""What the first preset has on the server of the tests: pages that open with it, and changes on them, take less than half.

An uncertain plant has fewer points there, too."""
SERVE = f"""
import sys
from functools import partial
from panel.command import main
from wfsobs.closed_loop import envelope
from wfsobs.scenario.presets import PRESETS
whole = PRESETS["paper"]
PRESETS["paper"] = lambda: whole().replace({PRESET})
envelope.plant_envelope = partial(envelope.plant_envelope, points=50)
sys.argv[0] = "panel"
main()
"""
CLOSED_MID_UPDATE = (
    "WebSocketClosedError",
    "StreamClosedError",
    "self.connection.session.notify_connection_lost()",
    "return connection.session._handle_patch(message, connection)",
)
"""What a page that closes during an update leaves in the log; nothing else is let through. The last two are Bokeh's own: a
page that closes before its session is there, and a change that is read when its connection has been closed."""


PATIENCE = 300_000
"""For what is to be there at last [ms]: a busy machine is no fault."""

expect.set_options(timeout=PATIENCE)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave the tests of this folder as long as one of them may wait, three times, and begin with the slow files."""
    for item in items:
        if item.path.parent == ROOT / "tests" / "browser":
            item.add_marker(pytest.mark.timeout(3 * PATIENCE / 1000))
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


def carded(target: str) -> list[str]:
    """The observers of a target that run on the paper's scenario, each with a card."""
    usual = usual_observers(PRESETS["paper"]())
    return [name for name in observers_of(target) if name in usual]


class Server:
    """A server on a port of this machine, a free one unless told, its output in a file; `packages` : a folder of more."""

    def __init__(self, command: list[str], log: Path, path: str, port: int = 0, packages: Path | None = None):
        self.log = log
        if not port:
            with socket.socket() as s:
                s.bind(("127.0.0.1", 0))
                port = s.getsockname()[1]
        self.port = port
        self.url = f"http://localhost:{port}{path}"
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(map(str, filter(None, (packages, ROOT)))),
            "OPENBLAS_NUM_THREADS": "1",
        }
        with log.open("w") as out:
            self.process = subprocess.Popen(
                [sys.executable, *(part.replace("{port}", str(port)) for part in command)],
                cwd=ROOT,
                env=environment,
                stdout=out,
                stderr=subprocess.STDOUT,
            )
        self._wait(f"http://localhost:{port}/liveness")

    def _wait(self, url: str) -> None:
        end = time.monotonic() + 240
        while time.monotonic() < end and self.process.poll() is None:
            try:
                urllib.request.urlopen(url, timeout=5)
                return
            except OSError:
                time.sleep(0.2)
        self.close()
        pytest.fail(f"the server did not come up:\n{self.log.read_text()}")

    def errors(self, start: int) -> list[str]:
        """Tracebacks in the log since position `start`, but for those of a page closed mid-update."""
        blocks = self.log.read_text()[start:].split("Traceback (most recent call last)")[1:]
        return [block for block in blocks if not any(name in block for name in CLOSED_MID_UPDATE)]

    def close(self) -> None:
        self.process.terminate()
        self.process.wait(60)


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    log = tmp_path_factory.mktemp("server") / "log"
    command = "serve app --port {port} --liveness --session-token-expiration 86400".split()
    server = Server(["-c", SERVE, *command], log, "/app")
    yield server
    server.close()


@pytest.fixture(scope="session")
def make_server() -> type[Server]:
    return Server


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    named = os.environ.get("CHROMIUM") or shutil.which("chromium-headless-shell") or shutil.which("chromium")
    if named is None or shutil.which(named) is None:
        pytest.fail("no browser: apt-get install chromium-headless-shell, or set CHROMIUM to one")
    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path=named, args=FLAGS)
        yield browser
        browser.close()


class Watched:
    """Collects what must not happen on a page."""

    def __init__(self, page: Page):
        self.faults: list[str] = []
        page.on("console", self._console)
        page.on("pageerror", lambda e: self.faults.append(f"page: {e}"))
        page.on("request", self._request)

    def _console(self, message: Any) -> None:
        """Keep errors, and that a property of a figure names no column; that an axis has no data yet is no fault."""
        if message.type == "error" or "nonexistent field" in message.text:
            self.faults.append(f"console: {message.text}")

    def _request(self, request: Any) -> None:
        if not request.url.startswith(("http://localhost:", "ws://localhost:", "data:", "blob:")):
            self.faults.append(f"request: {request.url}")


def with_seeds(url: str, seeds: int) -> str:
    """Return an address that asks for so many seeds, unless it says how many or there are to be as many as ever."""
    return url if not seeds or SEEDS in url else f"{url}{'&' if '?' in url else '?'}{SEEDS}{seeds}"


@pytest.fixture(scope="session")
def context(browser: Browser) -> BrowserContext:
    """The one browsing context: what a page has loaded, the next need not compile again."""
    context = browser.new_context()
    context.add_init_script("try { localStorage.setItem('wfsobs-tour', 'offered') } catch {}")  # no visitor's first
    return context


def leave(page: Page) -> None:
    """Close a page, and leave nothing of it to the next one of its context."""
    page.context.set_offline(False)
    if page.url.startswith("http"):
        page.evaluate("() => { localStorage.clear(); sessionStorage.clear() }")
    page.close()


@contextmanager
def opening(server: Server, context: BrowserContext) -> Iterator[Any]:
    """A function that opens the dashboard in a window of some size and waits for the first result; in the end they close.

    It has one seed, so that nothing runs on in idle time and takes the processor from the next test; 0: as many as a visitor has.
    """
    start = len(server.log.read_text())
    opened: list[tuple[Page, Watched]] = []

    def open_it(
        width: int = 1400, height: int = 1000, url: str = "", wait: bool = True, seeds: int = 1, script: str = "", **media: Any
    ) -> Page:
        page = context.new_page()
        page.set_viewport_size({"width": width, "height": height})
        page.emulate_media(**media)
        page.set_default_timeout(PATIENCE)
        if script:
            page.add_init_script(script)
        opened.append((page, Watched(page)))
        page.goto(with_seeds(url or server.url, seeds))
        if wait:
            finished(page)
        return page

    yield open_it
    faults = [fault for _, watched in opened for fault in watched.faults]
    for page, _ in opened:
        leave(page)
    assert faults == []
    errors = server.errors(start)
    assert not errors, "\n".join(errors)


@pytest.fixture
def open_page(server: Server, context: BrowserContext) -> Iterator[Any]:
    """As `opening`, for the pages of one test."""
    with opening(server, context) as open_it:
        yield open_it


@pytest.fixture(scope="module")
def open_shared(server: Server, context: BrowserContext) -> Iterator[Any]:
    """As `opening`, for pages that several tests of a module look at: a page takes longer to open than most tests to look."""
    with opening(server, context) as open_it:
        yield open_it


DONE = """() => [...(window.Bokeh?.index?.roots?.[0]?.model.document.all_models ?? [])]
    .some(m => typeof m.text === "string" && m.text.startsWith("Done in"))"""
"""Asked of the models: on a phone the line that says so may be in a drawer that has not been opened."""


DRAWN = """() => {
  const parse = (text) => new DOMParser().parseFromString(text, "text/html").body
  const table = (root) => {
    for (const it of root.querySelectorAll("*")) {
      if (it.matches("[aria-label='RMS errors'] table.rms") && it.querySelector("[data-observer], .target")) return it
      const below = it.shadowRoot && table(it.shadowRoot)
      if (below) return below
    }
  }
  const models = [...Bokeh.index.roots[0].model.document.all_models]
  const said = models.map((m) => m.html).find((text) => typeof text === "string" && /aria-label="RMS errors"/.test(text))
  return said && table(document)?.textContent === table(parse(said))?.textContent
}"""
"""Whether the table stands on the page as its model has it: on a busy machine that takes a while."""


SETTINGS = """() => [...(window.Bokeh?.index?.roots?.[0]?.model.document.all_models ?? [])]
    .some((m) => m.type === "panel.models.esm.ReactComponent" && m.data?.label === "Preset")"""
"""Whether the drawer has its settings: they come after the first picture."""


COMPLETE = "() => Bokeh.index.roots.every((it) => it.has_finished())"
"""Whether the page has all of its parts: the drawer's come one after the other, and move what is below them."""


ANSWERED = """() => {
  const link = Bokeh.index.roots[0].model.document.wfsobs
  window.question ??= (link.ask(), link.asked)
  return link.model.last_arrival >= window.question && delete window.question
}"""


CHANGED = f"""() => [...new URLSearchParams(location.search).keys()]
    .some((it) => !it.startsWith("view.") && it !== "preset" && !new URLSearchParams("{QUICK}").has(it))"""
"""Whether the link has settings beside those of `QUICK`; a preset by its name has none."""


def until(page: Page, holds: str, arg: object = None, every: float = 50) -> JSHandle:
    """Wait until a function holds on the page: asked with every picture, as is usual, it takes time from what it waits for.

    every : time from one question to the next [ms]
    """
    return page.wait_for_function(holds, arg=arg, polling=every)


def answered(page: Page) -> None:
    """Wait until the server has done what the page has told it so far."""
    until(page, ANSWERED)


def eventually(page: Page, holds: Callable[[], object], seconds: float = PATIENCE / 1000) -> None:
    """Wait until something holds that one look at the page cannot tell."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it never was so"
        page.wait_for_timeout(50)  # which hears what the page says meanwhile, unlike time.sleep


def finished(page: Page) -> None:
    """Wait until the settings are there, the run is over, its results are drawn and nothing moves any more."""
    until(page, SETTINGS, every=200)
    until(page, COMPLETE, every=200)
    until(page, DONE, every=200)
    until(page, DRAWN, every=200)  # it looks through all of the page
