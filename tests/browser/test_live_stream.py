"""A page in shadow of a running loop, whose stream dies, is made anew, sends garbage and loses frames."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, expect

import wfsobs
from wfsobs.scenario.presets import paper
from wfsobs.streams.shared_image import SharedImage
from wfsobs.typing import Array

RATE = 250
"""Frames a second: a thread of this process keeps that up beside the browser."""
RUNNING = re.compile("^Running at 1 × real time")
SETTINGS = {"sensors.lgs_rate": 250.0}
OBSERVERS = ("kf-lgs", "kf-multi", "gp-lgs", "gpr-online")
"""Three with errors of the next measurement, whose lines are shown, and the online GPR, which has none."""


class Publisher:
    """Sends modes from a thread, row after row, until it is stopped; `factor` is what they are multiplied by."""

    def __init__(self, path: Path, rows: Array):
        self.image = SharedImage.create(path, rows.shape[1:], dtype="float64")
        self.rows, self.factor, self.runs = rows, 1.0, True
        self.thread = threading.Thread(target=self._send)
        self.thread.start()

    def _send(self) -> None:
        began, k = time.monotonic(), 0
        while self.runs:
            self.image.write(self.factor * self.rows[k % len(self.rows)])
            k += 1
            time.sleep(max(began + k / RATE - time.monotonic(), 0.0))

    def stop(self) -> None:
        self.runs = False
        self.thread.join()


@pytest.fixture(scope="module")
def rows() -> Array:
    """Pseudo-open-loop modes [um], (n_frames, 2)."""
    record = wfsobs.simulate(paper().replace({"run.duration": 20.0, **SETTINGS}))
    return np.ascontiguousarray(record.z)


@pytest.fixture(scope="module")
def shadow(
    make_server: Any, rows: Array, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Any, Path, list[Publisher]]]:
    """A server in shadow, the file of the stream, and who sends; in the end there must be no fault in its log."""
    tmp_path = tmp_path_factory.mktemp("stream")
    path = tmp_path / "modes.im.shm"
    running = [Publisher(path, rows)]
    settings = [part for name, value in SETTINGS.items() for part in ("--set", f"{name}={value:g}")]
    stream = ["--in", str(path), "--modes", "0,1", *settings, "--log", str(tmp_path / "told.log")]
    stream += [part for name in OBSERVERS for part in ("--observer", name)]
    server = make_server(["-m", "wfsobs", "live", "--port", "{port}", *stream], tmp_path / "log", "/")
    yield server, path, running
    for publisher in running:
        publisher.stop()
    server.close()
    assert server.errors(0) == []


@pytest.fixture(scope="module")
def page(shadow: Any, open_shared: Any) -> Page:
    """A page for the tests below, in this order."""
    page = open_shared(url=shadow[0].url + "?view.page=live", wait=False)
    expect(page.get_by_role("figure", name="Waterfall")).to_be_visible()
    return page


def test_lines_are_of_observers_that_a_stream_has_errors_of(page: Page) -> None:
    """Of the usual three the one of both sensors does not run, and the online GPR says nothing of the next measurement."""
    legend = page.locator(".caption.legend").filter(visible=True)
    expect(legend).to_have_text(re.compile("^(LGS KF|Multi-peak|GP in time){3}$"))
    expect(page.get_by_role("combobox", name="Errors of")).to_have_text("Next measurement")


def test_a_stream_that_fails_is_told_and_followed_again(shadow: Any, page: Page, rows: Array) -> None:
    _, path, running = shadow
    events = page.get_by_role("list", name="Events")
    running[0].factor = np.nan
    expect(events).to_contain_text("numbers that are not finite")
    running[0].factor = 1.0
    running.pop().stop()
    expect(events).to_contain_text("no frame for")
    path.unlink()
    running.append(Publisher(path, rows))
    expect(events).to_contain_text("frames again")
    before = seconds(page)
    expect(page.get_by_text(RUNNING)).not_to_contain_text(f" {before:.1f} s ")
    assert seconds(page) > before


def seconds(page: Page) -> float:
    """Time of the loop that the page shows [s]."""
    found = re.search(r"· ([0-9.]+) s ·", page.get_by_text(RUNNING).inner_text())
    assert found is not None
    return float(found[1])
