"""Further seeds in idle time: they give way, go with the settings, and say what is significant."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from time import monotonic, sleep
from typing import Any

import numpy as np
import pytest

from tests.patience import wait
from wfsobs.app.cache import Cache
from wfsobs.app.display import Display
from wfsobs.app.idle_work import Budgets, SeedRuns
from wfsobs.app.jobs import BATCH, CLICK, DONE, IDLE_TIME, Job, JobQueue
from wfsobs.app.store import Store
from wfsobs.app.views.errors import MainLines, Strip, Table, VerdictLine
from wfsobs.app.views.switches import SeedSwitch
from wfsobs.pipeline import run
from wfsobs.progress import Watch


@pytest.fixture
def queue() -> Iterator[JobQueue]:
    queue = JobQueue(1, Cache(1_000_000), rest=0.0)
    yield queue
    queue.close(5.0)


def test_a_job_for_idle_time_gives_way_to_a_click_and_begins_again(queue: JobQueue) -> None:
    begun, log, go = threading.Event(), [], threading.Event()

    def idle(watch: Watch, _tell: Any) -> str:
        log.append("idle begins")
        begun.set()
        while not go.is_set():
            watch.check()
            sleep(0.005)
        return "idle"

    heard: list[Any] = []
    queue.submit(Job("seed", idle, priority=IDLE_TIME), "a", heard.append)
    begun.wait(30)
    for priority in (CLICK, BATCH):
        before = len(log)
        queue.submit(Job("run", lambda *_: log.append("click"), priority=priority), "b", lambda _news: None)
        wait(lambda before=before: len(log) >= before + 2)
        assert log[before:] == ["click", "idle begins"]
    go.set()
    wait(lambda: any("result" in news for news in heard))
    # It was told nothing of giving way: no state but the last.
    assert [news["state"] for news in heard if "state" in news] == [DONE]


def test_idle_time_does_not_take_the_turn_of_who_asks(queue: JobQueue) -> None:
    log, go, begun = [], threading.Event(), threading.Event()

    def first(*_: Any) -> None:
        begun.set()
        go.wait(30)

    queue.submit(Job("run", first), "c", lambda _news: None)
    begun.wait(30)
    for _ in range(3):
        queue.submit(Job("seed", lambda *_: log.append("idle"), priority=IDLE_TIME), "a", lambda _news: None)
    queue.submit(Job("run", lambda *_: log.append("a")), "a", lambda _news: None)
    queue.submit(Job("run", lambda *_: log.append("b")), "b", lambda _news: None)
    go.set()
    wait(lambda: len(log) == 5)
    assert log == ["a", "b", "idle", "idle", "idle"]


def test_a_job_for_idle_time_begins_some_time_after_the_last_answer() -> None:
    queue, begun = JobQueue(2, Cache(1_000_000), rest=0.25), []
    queue.submit(Job("run", lambda *_: begun.append(monotonic())), "a", lambda _news: None)
    queue.submit(Job("seed", lambda *_: begun.append(monotonic()), priority=IDLE_TIME), "a", lambda _news: None)
    wait(lambda: len(begun) == 2)
    queue.close(5.0)
    assert begun[1] - begun[0] >= 0.25


@pytest.fixture
def store(make_store: Any) -> Store:
    store = make_store()
    store.session.service.queue.rest = 0.0
    return store


def test_every_seed_is_that_of_the_library_and_the_views_say_so(store: Store, loop: Any, short: Any) -> None:
    seeds, display = SeedRuns(store), Display()
    seeds.count = 3
    lines = MainLines(display, seeds)
    budgets = Budgets(seeds, lines.names)
    table, strip = Table(display, seeds), Strip("vibration", display, lines, budgets)
    verdict, switch = VerdictLine("vibration", display, budgets), SeedSwitch(seeds)
    store.start()
    loop.until(lambda: seeds.n_known == 3)
    assert seeds.evidence is not None and seeds.evidence.n_seeds == 3
    key = ("kf-lgs", "turbulence", "tip")
    scores = [run(short.replace({"run.seed": short.run.seed + i})).scores for i in range(3)]
    expected = [next(s.rms for s in of if (s.observer, s.target, s.mode) == key) for of in scores]
    # The same computation; rounding may depend on the threads of BLAS.
    np.testing.assert_allclose(seeds.evidence.errors[key], expected, rtol=1e-9)
    low, high = seeds.evidence.interval(("kf-lgs", "vibration", "tip")) or (0.0, 0.0)
    assert f"{1e3 * low:.1f}"[:3] in table.html() and "3 seeds" in table.html()
    card = next(item for item in strip.items() if item["name"] == "kf-lgs")
    assert "3 seeds" in card["meaning"]
    assert float(card["half"].removeprefix("± ")) == pytest.approx(500.0 * (high - low), abs=0.051)
    assert "over 3 seeds" in verdict.html() and "over 3 seeds" in switch.text()
    assert high > low


@pytest.mark.usefixtures("quick")
def test_a_change_of_settings_cancels_them_and_one_seed_is_none(store: Store, loop: Any) -> None:
    seeds = SeedRuns(store)
    store.start()
    loop.until(lambda: seeds.n_known >= 2)
    store.change("turbulence.wind_speed", 12.0)
    assert seeds.evidence is None and seeds.n_known == 0 and seeds.task.state != DONE
    seeds.count = 1
    loop.finish(store)
    assert seeds.n_known == 1 and seeds.evidence is None and store.session.service.queue.length == 0
    seeds.count = 3
    loop.until(lambda: seeds.n_known == 3)
    assert seeds.evidence is not None


@pytest.mark.usefixtures("quick")
def test_a_loaded_record_has_no_other_seeds(store: Store, loop: Any) -> None:
    from wfsobs.app.sources import LoadedRecord
    from wfsobs.simulation.loop import simulate

    seeds = SeedRuns(store)
    store.source = LoadedRecord(simulate(store.scenario), "mine", "key")
    store.start()
    loop.finish(store)
    assert store.run.state == DONE and seeds.n_known == 1 and seeds.evidence is None and not seeds.possible
    assert "only for simulations" in SeedSwitch(seeds).text()
