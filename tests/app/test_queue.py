"""The line before the processors: in order, one per owner, everyone told where they stand."""

from __future__ import annotations

import threading
from collections import Counter
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.app.controls.panel import status_of
from wfsobs.app.queue import Queue
from wfsobs.app.run import RUNNING
from wfsobs.app.work import Shown

WAIT = 20.0


class Log:
    """What happened, in order, and a way to wait for it."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.started: list[str] = []
        self.running: Counter[str] = Counter()
        self.most_at_once = 0
        self.most_of_one = 0

    def until(self, condition: Any) -> None:
        with self.changed:
            assert self.changed.wait_for(condition, WAIT)


class Job:
    """Waits to be let go."""

    def __init__(self, log: Log, owner: str, name: str = "", gate: threading.Event | None = None):
        self.log, self.owner, self.name = log, owner, name or owner
        self.gate = gate or threading.Event()
        self.places: list[int] = []

    def moved(self, place: int) -> None:
        self.places.append(place)

    def run(self) -> None:
        log = self.log
        with log.changed:
            log.started.append(self.name)
            log.running[self.owner] += 1
            log.most_at_once = max(log.most_at_once, log.running.total())
            log.most_of_one = max(log.most_of_one, *log.running.values())
            log.changed.notify_all()
        assert self.gate.wait(WAIT)
        with log.changed:
            log.running[self.owner] -= 1
            log.changed.notify_all()


@pytest.fixture
def make_queue() -> Any:
    made: list[Queue] = []

    def make(workers: int) -> Queue:
        made.append(Queue(workers))
        return made[-1]

    yield make
    for queue in made:
        assert queue.close(WAIT)


def test_first_come_first_served_and_told_the_place(make_queue: Any) -> None:
    queue, log = make_queue(1), Log()
    jobs = [Job(log, name) for name in "abcd"]
    queue.put(jobs[0])
    log.until(lambda: log.started == ["a"])
    for job in jobs[1:]:
        queue.put(job)
    assert [job.places[-1] for job in jobs] == [0, 1, 2, 3]
    queue.drop(jobs[1])
    assert [job.places[-1] for job in jobs[2:]] == [1, 2]
    jobs[0].gate.set()
    log.until(lambda: log.started == ["a", "c"])
    assert jobs[2].places[-1] == 0 and jobs[3].places[-1] == 1
    for job in jobs:
        job.gate.set()
    log.until(lambda: log.started == ["a", "c", "d"])


def test_nobody_holds_two_places(make_queue: Any) -> None:
    queue, log = make_queue(2), Log()
    first, again, other = Job(log, "a", "a1"), Job(log, "a", "a2"), Job(log, "b", "b1")
    queue.put(first)
    log.until(lambda: log.started == ["a1"])
    queue.put(again)
    queue.put(other)
    log.until(lambda: log.started == ["a1", "b1"])
    first.gate.set()
    log.until(lambda: log.started == ["a1", "b1", "a2"])
    again.gate.set()
    other.gate.set()


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 4), st.lists(st.sampled_from("abcde"), max_size=12))
def test_everything_is_done_never_too_much_at_once(workers: int, owners: list[str]) -> None:
    queue, log, gate = Queue(workers), Log(), threading.Event()
    try:
        for i, owner in enumerate(owners):
            queue.put(Job(log, owner, f"{owner}{i}", gate))
        log.until(lambda: log.running.total() == min(workers, len(set(owners))))
        gate.set()
        log.until(lambda: len(log.started) == len(owners) and log.running.total() == 0)
        assert log.most_at_once <= workers and log.most_of_one <= 1
        for owner in set(owners):
            own = [name for name in log.started if name[0] == owner]
            assert own == [f"{owner}{i}" for i, o in enumerate(owners) if o == owner]
    finally:
        assert queue.close(WAIT)


def test_a_job_that_fails_leaves_the_thread_to_others(make_queue: Any, caplog: Any) -> None:
    class Fails(Job):
        def run(self) -> None:
            raise RuntimeError("no such luck")

    queue, log = make_queue(1), Log()
    queue.put(Fails(log, "a"))
    after = Job(log, "b")
    queue.put(after)
    log.until(lambda: log.started == ["b"])
    assert "no such luck" in caplog.text
    after.gate.set()


def test_a_closed_queue_starts_nothing(make_queue: Any) -> None:
    queue, log = make_queue(1), Log()
    busy, waiting = Job(log, "a"), Job(log, "b")
    queue.put(busy)
    queue.put(waiting)
    log.until(lambda: log.started == ["a"])
    assert not queue.close(0.0), "one is still at work"
    busy.gate.set()
    assert queue.close(WAIT) and log.started == ["a"]


def test_the_page_shows_the_place(make_store: Any, loop: Any) -> None:
    tells: list[Any] = []
    told, done = threading.Event(), threading.Event()

    def waits(scenario: Any, cancelled: Any, tell: Any) -> Shown:
        tells.append(tell)
        tell(0.0, None, 3)
        told.set()
        assert done.wait(WAIT)
        raise RuntimeError("over")

    store = make_store(waits)
    store.start()
    assert told.wait(WAIT)
    loop.until(lambda: store.run.place == 3)
    assert status_of(store)[0] == "Waiting: position 3" and store.run.state == RUNNING
    tells[0](0.25, None)
    loop.until(lambda: store.run.place == 0)
    assert status_of(store)[0] == "Running, 25 %"
    done.set()
    loop.finish(store)
