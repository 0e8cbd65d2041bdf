"""Takes the pictures of the dashboard that the documentation shows: `python docs/scripts/pictures.py [NAME ...]`.

Starts a server and a headless Chromium ($CHROMIUM, else chromium), as the browser tests do, in the environment of the tests.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from playwright.sync_api import Page, expect, sync_playwright

ROOT = Path(__file__).parents[2]
SLOW = 300_000
"""The longest that is waited for a result [ms]."""


class Picture(NamedTuple):
    """query : settings, as in a shared link; clicks : buttons; seen : what is there in the end; size, drawer included [pixels];
    drawer : whether the drawer and the header are shown."""

    query: str = ""
    clicks: tuple[str, ...] = ()
    seen: str = "text=Done in"
    size: tuple[int, int] = (1400, 1000)
    drawer: bool = False


PICTURES = {
    "screenshot": Picture(size=(1400, 1420), drawer=True),
    "pictures/peak-jump": Picture("?preset=peak-jump", ("Run", "Running rms"), size=(1400, 1000)),
    "pictures/identify": Picture(
        "?preset=paper&run.duration=20&gpr_online.training_size=50",
        ("Run", "Identify", "Identify the record"),
        "text=/is white|not white/",
    ),
    "pictures/sweep": Picture(
        "?run.duration=2&run.warm_up=0.5", ("Sweep", "Run the sweep"), "text=/Finished · 80 of 80 runs/", (1400, 1130)
    ),
    "pictures/closed-loop": Picture("", ("Closed loop",), 'tr[data-controller="integrator+gpr-online"] td', (1400, 1100)),
    "pictures/live": Picture("", ("Live", "Start"), r"text=/real time · [3-9]\d\.\d s · /", (1400, 1380)),
}


@contextmanager
def server() -> Iterator[str]:
    """The address of a dashboard of its own."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "wfsobs", "serve", "--port", str(port), "--log-level", "error"], cwd=ROOT, env=environment
    )
    try:
        end = time.monotonic() + 120
        while time.monotonic() < end:
            try:
                urllib.request.urlopen(f"http://localhost:{port}/", timeout=5)
                break
            except OSError:
                time.sleep(0.5)
        yield f"http://localhost:{port}/"
    finally:
        process.terminate()
        process.wait(20)


def take(page: Page, address: str, picture: Picture, path: Path) -> None:
    """Open the dashboard, click, wait for the result, save what is seen."""
    page.set_viewport_size({"width": picture.size[0], "height": picture.size[1]})
    page.goto(address + picture.query)
    for name in picture.clicks:
        page.get_by_role("button", name=name, exact=True).click(timeout=SLOW)
        if name == "Run":
            page.wait_for_timeout(1000)
            expect(page.locator("text=Done in").first).to_be_visible(timeout=SLOW)
    expect(page.locator(picture.seen).first).to_be_visible(timeout=SLOW)
    page.wait_for_timeout(3000)  # figures are drawn after their data have come
    path.parent.mkdir(exist_ok=True)
    box, header = page.get_by_role("main").bounding_box(), page.locator("header").first.bounding_box()
    left, top = (0.0, 0.0) if picture.drawer or box is None or header is None else (box["x"], header["y"] + header["height"])
    page.screenshot(path=path, clip={"x": left, "y": top, "width": picture.size[0] - left, "height": picture.size[1] - top})


if __name__ == "__main__":
    chosen = sys.argv[1:] or list(PICTURES)
    with server() as address, sync_playwright() as p:
        browser = p.chromium.launch(executable_path=os.environ.get("CHROMIUM") or "/usr/bin/chromium", args=["--no-sandbox"])
        for name in chosen:
            page = browser.new_page()
            page.add_init_script("localStorage.setItem('wfsobs-tour', 'offered')")
            page.set_default_timeout(SLOW)
            take(page, address, PICTURES[name], ROOT / "docs" / f"{name}.png")
            page.close()
        browser.close()
