"""How long the page takes: from opening it, and from the release of the wind-speed slider, to what is drawn.

    python scripts/measure_dashboard.py [-n 10]

Starts a server and a headless Chromium ($CHROMIUM, else chromium). A time ends with the second frame after the
last change, when the browser has painted it: of all traces, spectra and rows but those of the observers that learn during
the run, and of everything.
"""

from __future__ import annotations

import argparse
import os
import socket
import statistics
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

ROOT = Path(__file__).parents[1]
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]

# What is on the page now, and a clock that starts at a release and notes when all but the last has come, and all.
WATCH = """() => {
  const deep = (selector, root = document) => {
    const found = root.querySelector(selector)
    if (found) return found
    for (const el of root.querySelectorAll("*")) {
      const inner = el.shadowRoot && deep(selector, el.shadowRoot)
      if (inner) return inner
    }
    return null
  }
  const roots = {}
  const at = (name, selector) => {
    if (!roots[name]) roots[name] = deep(selector)?.getRootNode()
    return roots[name]?.querySelector(selector)
  }
  const cell = (name) => at("table", `tr[data-observer="${name}"][data-target="vibration"] td`)?.textContent ?? "–"
  const models = () => [...(window.Bokeh?.index?.roots?.[0]?.model.document._all_models.values() ?? [])]
  let sources = null
  const find = () => {
    const all = models()
    const traces = all.filter((m) => m.type === "ColumnDataSource" && m.data.truth && m.data["kf-lgs"])
    const spectrum = all.find((m) => m.type === "GlyphRenderer" && m.name === "gpr-offline" && m.data_source.data.y)
    if (traces.length === 2 && spectrum) {
      sources = {traces, vibration: traces.find((s) => s.data["gpr-offline"]), spectrum: spectrum.data_source}
    }
    return sources
  }
  const last = (values) => values?.length > 0 && Number.isFinite(values[values.length - 1])
  const clock = window.wfsobsClock = {start: 0, most: null, all: null, before: null}
  const painted = (name) => {
    clock[name] = NaN
    requestAnimationFrame(() => requestAnimationFrame(() => { clock[name] = performance.now() - clock.start }))
  }
  const look = () => {
    const s = sources ?? find()
    if (s) {
      const fresh = s.traces.every((source) => source.data.x.length > 0) && s.traces[0].data.truth !== clock.before
      if (fresh && clock.most === null && last(s.vibration.data["gpr-offline"]) && s.spectrum.data.y.length > 0
          && cell("gpr-offline") !== "–") painted("most")
      if (fresh && clock.all === null && cell("gpr-online") !== "–"
          && at("status", "[role=status]")?.textContent.startsWith("Done")) painted("all")
    }
    setTimeout(look, s && roots.table && roots.status ? 5 : 50)
  }
  setTimeout(look, 50)
  window.addEventListener("pointerup", () => {
    Object.assign(clock, {start: performance.now(), most: null, all: null, before: sources.traces[0].data.truth})
  }, true)
}"""
DONE = "() => wfsobsClock.all !== null && !Number.isNaN(wfsobsClock.all)"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("-n", type=int, default=10, help="releases of the slider")
    n = parser.parse_args().n
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "panel", "serve", "app", "--port", str(port), "--liveness"]
    server = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        _wait(f"http://localhost:{port}/liveness")
        with sync_playwright() as p:
            browser = p.chromium.launch(executable_path=os.environ.get("CHROMIUM") or "/usr/bin/chromium", args=FLAGS)
            cold, warm = (_first_page(browser, f"http://localhost:{port}/app") for _ in range(2))
            page = _open(browser, f"http://localhost:{port}/app")
            times = [_release(page, i) for i in range(n + 1)][1:]
            browser.close()
    finally:
        server.terminate()
        server.wait(20)
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors, {n} releases")
    for name, opened in (("first page", cold), ("second page", warm)):
        print(f"{name:32s} {opened['most'] / 1e3:6.2f} s, complete after {opened['all'] / 1e3:.2f} s")
    for name, key in (("release to all but who learns", "most"), ("release to everything", "all")):
        seconds = [t[key] / 1e3 for t in times]
        print(f"{name:32s} {statistics.median(seconds):6.2f} s median, {max(seconds):.2f} s worst")


def _open(browser: Any, url: str) -> Page:
    page = browser.new_page(viewport={"width": 1400, "height": 1000})
    page.set_default_timeout(60_000)
    page.add_init_script(f"({WATCH})()")
    page.goto(url)
    page.wait_for_function(DONE, polling=100)  # at each frame by default, which has the browser draw them all
    return page


def _first_page(browser: Any, url: str) -> dict[str, float]:
    page = _open(browser, url)
    times = page.evaluate("() => ({most: wfsobsClock.most, all: wfsobsClock.all})")
    page.close()
    return times


def _release(page: Page, i: int) -> dict[str, float]:
    """Drag the slider to a value that it has not had, so that the results are not there yet, and let go."""
    box = page.locator(".MuiSlider-root").first.bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] * (0.30 + 0.05 * (i % 5)), y)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * (0.15 + 0.0617 * i % 0.8), y, steps=4)
    page.mouse.up()
    page.wait_for_function(DONE, polling=100)
    page.wait_for_timeout(200)
    return page.evaluate("() => ({most: wfsobsClock.most, all: wfsobsClock.all})")


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
