"""How large the first page is, and how long it takes: from opening it, from the release of a slider, while dragging.

    python scripts/measure_dashboard.py [-n 10]

Starts `wfsobs serve`, a server of a page that has as little as it can (minimal_page.py), and a headless Chromium ($CHROMIUM, else
its headless shell, else chromium).
Either server rests before each visitor; ours makes the page of the next one meanwhile. A picture is there when every
figure in the window has a line with points, at the second frame after that. A run's times end with the second frame after the
last change: of the traces, spectra and rows of the quick observers, of all but those that learn during the run, of everything,
and of the one filter that runs alone.
"""

from __future__ import annotations

import argparse
import os
import shutil
import socket
import statistics
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

ROOT = Path(__file__).parents[1]
REST = 6.0
"""Time without a visitor [s]."""

BROWSER = os.environ.get("CHROMIUM") or shutil.which("chromium-headless-shell") or shutil.which("chromium")
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]

# When every figure in the window has been painted with its lines, and of how many models the page was then.
PICTURE = """() => {
  const at = window.wfsobsPicture = {picture: null, models: 0}
  const inWindow = (view) => { const {top, width} = view.el.getBoundingClientRect(); return width > 0 && top < innerHeight }
  const points = (it) => it.visible && it.glyph?.type === "Line" && it.data_source.get_length() > 300
  const look = () => {
    const views = [...(window.Bokeh?.index?.query?.((it) => it.model.type === "Figure") ?? [])].filter(inWindow)
    if (views.length > 1 && views.every((it) => it.has_finished() && it.model.renderers.some(points))) {
      at.models = Bokeh.index.roots[0].model.document.all_models.size
      requestAnimationFrame(() => requestAnimationFrame(() => { at.picture = performance.now() }))
    } else setTimeout(look, 10)
  }
  look()
}"""

# A clock that starts at a release and notes when what it waits for has been painted: a function of the page that says so.
CLOCK = """() => {
  const models = () => [...(window.Bokeh?.index?.roots?.[0]?.model.document.all_models ?? [])]
  const deep = (selector, root = document) => {
    const found = root.querySelector(selector)
    if (found) return found
    for (const el of root.querySelectorAll("*")) {
      const inner = el.shadowRoot && deep(selector, el.shadowRoot)
      if (inner) return inner
    }
    return null
  }
  const rooms = {}
  const at = (name, selector) => {
    if (!rooms[name]?.host?.isConnected) rooms[name] = deep(selector)?.getRootNode()
    return rooms[name]?.querySelector(selector)
  }
  const status = () => at("status", "[role=status]")?.textContent ?? ""
  const cell = (name) => at("table", `tr[data-observer="${name}"][data-target="vibration"] td`)?.textContent ?? "–"
  const traceOf = (name) => models().find((m) => m.type === "ColumnDataSource" && m.data.truth && m.data[name])
  const last = (values) => values?.length > 0 && Number.isFinite(values[values.length - 1])
  let sources = {}
  const clock = window.wfsobsClock = {start: null, done: {}}
  const fresh = () => sources.own.data["gpr-offline"] !== clock.before
  const said = {
    quick: () => sources.own.data["kf-lgs"] !== clock.quick && cell("gp-both") !== "–" && cell("ridge-30") !== "–",
    most: () => fresh() && last(sources.own.data["gpr-offline"]) && cell("gpr-offline") !== "–",
    all: () => fresh() && cell("gpr-online") !== "–" && status().startsWith("Done"),
    filter: () => sources.filter.data["kf-ngs"] !== clock.filter,
  }
  const look = () => {
    for (const name of clock.waiting) {
      if (!said[name]()) continue
      clock.waiting = clock.waiting.filter((it) => it !== name)
      requestAnimationFrame(() => requestAnimationFrame(() => { clock.done[name] = performance.now() - clock.start }))
    }
    if (clock.waiting.length) setTimeout(look, 4)
  }
  window.wfsobsWait = (...names) => {
    sources = {own: traceOf("gpr-offline"), filter: traceOf("kf-ngs")}
    window.addEventListener("pointerup", () => {
      Object.assign(clock, {
        start: performance.now(), done: {}, waiting: names,
        before: sources.own.data["gpr-offline"], quick: sources.own.data["kf-lgs"], filter: sources.filter.data["kf-ngs"]})
      look()
    }, {capture: true, once: true})
  }
  window.wfsobsStatus = status
  window.wfsobsFrames = () => {  // the time between one frame and the next, from now on
    const frames = window.wfsobsGaps = []
    let before = performance.now()
    const next = (now) => { frames.push(now - before); before = now; requestAnimationFrame(next) }
    requestAnimationFrame(next)
  }
}"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("-n", type=int, default=10, help="releases of the slider, and pages opened")
    n = parser.parse_args().n
    minimal = ["panel", "serve", "scripts/minimal_page.py", "--port", "{port}", "--liveness"]
    with (
        sync_playwright() as p,
        _server(["wfsobs", "serve", "--port", "{port}"]) as own,
        _server(minimal) as other,
    ):
        browser = p.chromium.launch(executable_path=BROWSER, args=FLAGS)
        urls = {"first page": f"{own}/", "minimal page": f"{other}/minimal_page"}
        cold = {name: _opened(browser, url) for name, url in urls.items()}
        pairs = [{name: _rested(browser, url) for name, url in urls.items()} for _ in range(n)]
        page = _ready(browser, urls["first page"])
        every = [_release(page, i) for i in range(n + 1)][1:]
        one = [_one_filter(page, i) for i in range(n + 1)][1:]
        gaps = _drag(page)
        browser.close()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors, {n} times each")
    for name in urls:
        seconds = [pair[name]["picture"] / 1e3 for pair in pairs]
        new = cold[name]
        print(f"{name:32s} {new['models']:4.0f} models; first picture {new['picture'] / 1e3:.2f} s of a new server,", end=" ")
        print(f"then {statistics.median(seconds):.2f} s median")
    ratios = [pair["first page"]["picture"] / pair["minimal page"]["picture"] for pair in pairs]
    print(f"{'ratio of the first pictures':32s} {statistics.median(ratios):6.2f} median, {min(ratios):.2f} to {max(ratios):.2f}")
    _print_times("release to the quick observers", [t["quick"] for t in every])
    _print_times("release to all but who learns", [t["most"] for t in every])
    _print_times("release to everything", [t["all"] for t in every])
    _print_times("one filter alone", [t["filter"] for t in one])
    print(f"{'worst stall in a drag':32s} {max(gaps):6.0f} ms, median frame {statistics.median(gaps):.0f} ms, {len(gaps)} frames")


def _print_times(name: str, milliseconds: Sequence[float]) -> None:
    print(f"{name:32s} {statistics.median(milliseconds) / 1e3:6.2f} s median, {max(milliseconds) / 1e3:.2f} s worst")


@contextmanager
def _server(command: Sequence[str]) -> Iterator[str]:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    whole = [sys.executable, "-m", *(part.format(port=port) for part in command)]
    server = subprocess.Popen(whole, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        _wait(f"http://localhost:{port}/liveness")
        yield f"http://localhost:{port}"
    finally:
        server.terminate()
        server.wait(20)


def _page(browser: Any, script: str) -> Page:
    page = browser.new_page(viewport={"width": 1400, "height": 1000})
    page.set_default_timeout(60_000)
    page.add_init_script(f"({script})()")
    return page


def _opened(browser: Any, url: str) -> dict[str, float]:
    """Open a page until its first picture is there."""
    page = _page(browser, PICTURE)
    page.goto(url)
    page.wait_for_function("() => wfsobsPicture.picture !== null", polling=100)
    found = page.evaluate("() => wfsobsPicture")
    page.close()
    return found


def _rested(browser: Any, url: str) -> dict[str, float]:
    time.sleep(REST)
    return _opened(browser, url)


def _ready(browser: Any, url: str) -> Page:
    """Open the dashboard until nothing more is to come."""
    page = _page(browser, CLOCK)
    page.goto(url)
    page.get_by_role("slider").first.wait_for()
    page.wait_for_function("() => wfsobsStatus().startsWith('Done')", polling=100)
    while (rows := page.locator("[data-do=all]:visible")).count():  # of all observers, not of the main ones alone
        rows.first.click()
    card = page.locator(".card[data-name=gpr-offline]").first  # whose line tells when all but those that learn are drawn
    if card.get_attribute("aria-pressed") != "true":
        card.click()
    page.wait_for_timeout(1000)
    return page


def _times(page: Page, *names: str) -> dict[str, float]:
    wanted = "names => names.every((name) => wfsobsClock.done[name] !== undefined)"
    page.wait_for_function(wanted, arg=list(names), polling=100)  # at each frame by default, which has all of them drawn
    page.wait_for_function("() => wfsobsStatus().startsWith('Done')", polling=100)
    page.wait_for_timeout(200)
    return page.evaluate("() => wfsobsClock.done")


def _release(page: Page, i: int) -> dict[str, float]:
    """Drag the slider to a value that it has not had, so that the results are not there yet, and let go."""
    x, y, width = _slider(page)
    page.mouse.move(x + width * (0.30 + 0.05 * (i % 5)), y)
    page.mouse.down()
    page.mouse.move(x + width * (0.15 + 0.0617 * i % 0.8), y, steps=4)
    page.evaluate("() => wfsobsWait('quick', 'most', 'all')")
    page.mouse.up()
    return _times(page, "quick", "most", "all")


def _one_filter(page: Page, i: int) -> dict[str, float]:
    """Choose a setting that the filter of the NGS alone depends on, whose line is shown, after a change that makes it new."""
    name = "NGS KF between frames"
    if i == 0:
        page.locator(".card[data-name=kf-ngs]").first.click()
        page.get_by_role("combobox", name="Find a setting").fill("between frames")
        page.keyboard.press("Enter")
    else:  # of two values the other would be known
        _release(page, 100 + i)
    page.get_by_role("combobox", name=name).last.click()
    option = page.get_by_role("option", selected=False).last
    page.wait_for_timeout(400)
    page.evaluate("() => wfsobsWait('filter')")
    option.click()
    return _times(page, "filter")


def _drag(page: Page, frames: int = 60) -> list[float]:
    """Drag the slider to and fro, a step a frame; the times between the frames [ms]."""
    x, y, width = _slider(page)
    page.mouse.move(x + 0.3 * width, y)
    page.mouse.down()
    page.evaluate("() => wfsobsFrames()")
    for i in range(frames):
        page.mouse.move(x + width * (0.3 + 0.4 * abs((i / 15) % 2 - 1)), y)
        page.wait_for_timeout(16)
    page.mouse.up()
    return page.evaluate("() => wfsobsGaps")


def _slider(page: Page) -> tuple[float, float, float]:
    page.locator(".MuiSlider-root").first.scroll_into_view_if_needed()
    box = page.locator(".MuiSlider-root").first.bounding_box()
    assert box is not None
    return box["x"], box["y"] + box["height"] / 2, box["width"]


def _wait(url: str) -> None:
    end = time.monotonic() + 60
    while True:
        try:
            urllib.request.urlopen(url, timeout=5)
            return
        except OSError:
            if time.monotonic() > end:
                raise
            time.sleep(0.1)


if __name__ == "__main__":
    main()
