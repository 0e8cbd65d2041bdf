"""The line before the processors: all kinds of work together, clicks first, in turn by owner, everyone told where they stand."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.patience import ENOUGH
from wfsobs.app import jobs as module
from wfsobs.app.cache import Cache
from wfsobs.app.controls.panel import status_of
from wfsobs.app.jobs import BATCH, CANCELLED, CLICK, DONE, FAILED, LONG, RUNNING, Job, JobQueue
from wfsobs.app.limits import NONE
from wfsobs.app.service import BackgroundTask, Service
from wfsobs.progress import Watch

KINDS = ("run", "loop", "identify", "tune", "upload", "report")


class Log:
    """What happened, in order, and a way to wait for it."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.started: list[str] = []
        self.running: Counter[str] = Counter()
        self.most_at_once = 0

    def until(self, condition: Any) -> None:
        with self.changed:
            assert self.changed.wait_for(condition, ENOUGH)


class Asked:
    """A job that waits to be let go, and what its owner hears of it."""

    def __init__(self, log: Log, owner: str, name: str = "", gate: threading.Event | None = None, **how: Any):
        self.log, self.owner, self.name = log, owner, name or owner
        self.gate, self.over = gate or threading.Event(), threading.Event()
        self.places: list[int] = []
        self.known: dict[str, Any] = {}
        self.job = Job(how.pop("kind", "run"), self.work, **how)

    def into(self, queue: JobQueue) -> Asked:
        self.leave = queue.submit(self.job, self.owner, self.hear)
        return self

    def hear(self, news: Any) -> None:
        self.known |= news
        self.places += [news["place"]] if "place" in news else []
        if news.get("state", RUNNING) != RUNNING:
            self.over.set()

    def work(self, watch: Watch, tell: Any) -> str:
        log = self.log
        with log.changed:
            log.started.append(self.name)
            log.running[self.owner] += 1
            log.most_at_once = max(log.most_at_once, log.running.total())
            log.changed.notify_all()
        try:
            while not self.gate.wait(0.001):
                watch.check()
        finally:
            with log.changed:
                log.running[self.owner] -= 1
                log.changed.notify_all()
        return self.name


@pytest.fixture
def make_queue() -> Iterator[Callable[[int], JobQueue]]:
    made: list[JobQueue] = []

    def make(workers: int) -> JobQueue:
        made.append(JobQueue(workers, Cache(10**6)))
        return made[-1]

    yield make
    for queue in made:
        assert queue.close(ENOUGH)


def test_first_come_first_served_and_told_the_place(make_queue: Any) -> None:
    queue, log = make_queue(1), Log()
    asked = [Asked(log, "a").into(queue)]
    log.until(lambda: log.started == ["a"])
    asked += [Asked(log, name).into(queue) for name in "bcd"]
    assert [one.places for one in asked] == [[], [1], [2], [3]]
    asked[1].leave()
    assert [one.places[-1] for one in asked[2:]] == [1, 2]
    asked[0].gate.set()
    log.until(lambda: log.started == ["a", "c"])
    assert asked[2].places[-1] == 0 and asked[3].places[-1] == 1
    for one in asked:
        one.gate.set()
    log.until(lambda: log.started == ["a", "c", "d"])


def test_thirty_sessions_with_six_kinds_of_work_and_one_worker(make_queue: Any) -> None:
    queue, log, gate = make_queue(1), Log(), threading.Event()
    first = Asked(log, "first", gate=gate).into(queue)
    log.until(lambda: log.started == ["first"])
    asked = [Asked(log, f"s{i}", f"s{i} {kind}", gate, kind=kind).into(queue) for i in range(30) for kind in KINDS]
    assert queue.running == 1 and queue.length == 180 == len(asked)
    assert sorted(one.places[-1] for one in asked) == list(range(1, 181)), "everyone is told a place of their own"
    gate.set()
    for one in (first, *asked):
        assert one.over.wait(ENOUGH) and one.known["state"] == DONE
    assert log.most_at_once == 1
    rounds = [log.started[1:][30 * i : 30 * i + 30] for i in range(6)]
    for kind, names in zip(KINDS, rounds, strict=True):
        assert names == [f"s{i} {kind}" for i in range(30)], "nobody's second before everybody's first"


def test_who_has_something_at_work_comes_after_who_has_not(make_queue: Any) -> None:
    queue, log = make_queue(2), Log()
    asked = [Asked(log, *names).into(queue) for names in (("a", "a1"), ("b", "b1"))]
    log.until(lambda: len(log.started) == 2)
    asked += [Asked(log, *names).into(queue) for names in (("a", "a2"), ("a", "a3"), ("c", "c1"))]
    assert [one.places[-1] for one in asked[2:]] == [2, 3, 1]
    asked[1].gate.set()
    log.until(lambda: log.started[2:] == ["c1"])
    asked[4].gate.set()
    log.until(lambda: log.started[2:] == ["c1", "a2"])  # no thread rests while anything waits
    for one in asked:
        one.gate.set()


def test_a_click_before_a_sweep_until_the_sweep_has_waited_long(make_queue: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [Job("run", lambda *_: None, cost=cost).priority for cost in (LONG, LONG + 1)] == [CLICK, BATCH]
    queue, log, gate = make_queue(1), Log(), threading.Event()
    Asked(log, "a", gate=gate).into(queue)
    log.until(lambda: log.started == ["a"])
    sweep = Asked(log, "b", "sweep", gate, kind="tune", cost=1.0, priority=BATCH).into(queue)
    long = Asked(log, "c", "long", gate, cost=LONG + 1).into(queue)
    click = Asked(log, "d", "click", gate).into(queue)
    assert [one.places[-1] for one in (sweep, long, click)] == [2, 3, 1]
    monkeypatch.setattr(module, "PATIENCE", 0.0)
    Asked(log, "e", "last", gate).into(queue)
    assert [one.places[-1] for one in (sweep, long, click)] == [1, 2, 3]
    gate.set()
    log.until(lambda: log.started == ["a", "sweep", "long", "click", "last"])


def test_what_takes_too_long_is_stopped_counted_from_its_turn(make_queue: Any) -> None:
    queue, log = make_queue(1), Log()
    first = Asked(log, "a").into(queue)
    log.until(lambda: log.started == ["a"])
    limited = Asked(log, "b", time_limit=0.05).into(queue)
    time.sleep(0.1)  # it waits for longer than it may take, which does not count
    first.gate.set()
    assert limited.over.wait(ENOUGH) and log.started == ["a", "b"]
    assert limited.known == {"place": 0, "state": FAILED, "message": "It took more than 0.05 s, which is what this server allows"}


def test_who_leaves_is_not_waited_for(make_queue: Any) -> None:
    queue, log = make_queue(1), Log()
    asked = [Asked(log, name).into(queue) for name in "ab"]
    log.until(lambda: log.started == ["a"])
    asked[0].leave()
    log.until(lambda: log.started == ["a", "b"])
    assert not asked[0].over.is_set(), "and hears nothing more"
    asked[1].gate.set()


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 4), st.lists(st.tuples(st.sampled_from("abcde"), st.sampled_from([CLICK, BATCH])), max_size=12))
def test_everything_is_done_never_too_much_at_once(workers: int, jobs: list[tuple[str, int]]) -> None:
    queue, log, gate = JobQueue(workers, Cache(0)), Log(), threading.Event()
    try:
        asked = [Asked(log, owner, f"{owner}{i}", gate, priority=p).into(queue) for i, (owner, p) in enumerate(jobs)]
        log.until(lambda: log.running.total() == min(workers, len(jobs)))
        gate.set()
        for one in asked:
            assert one.over.wait(ENOUGH) and one.known["result"] == one.name
        assert log.most_at_once <= workers and sorted(log.started) == sorted(one.name for one in asked)
    finally:
        assert queue.close(ENOUGH)


@pytest.mark.parametrize("error", [ZeroDivisionError("of a package"), SystemExit("of a package")])
def test_a_job_that_fails_leaves_the_thread_to_others(make_queue: Any, caplog: Any, error: BaseException) -> None:
    def fail(*_: object) -> None:
        raise error

    queue, log = make_queue(1), Log()
    fails, after = Asked(log, "a"), Asked(log, "b")
    fails.job.work = fail
    fails.into(queue)
    after.into(queue)
    log.until(lambda: log.started == ["b"])
    assert fails.known["message"] == f"{type(error).__name__}: of a package" and "Traceback" in caplog.text
    after.gate.set()


def test_a_closed_queue_starts_nothing(make_queue: Any) -> None:
    queue, log = make_queue(1), Log()
    busy = Asked(log, "a").into(queue)
    log.until(lambda: log.started == ["a"])
    waiting = Asked(log, "b").into(queue)
    assert queue.close(ENOUGH) and log.started == ["a"]
    assert busy.known["state"] == waiting.known["state"] == CANCELLED


# ---------------------------------------------------------------------- in a session


@pytest.fixture
def service() -> Iterator[Service]:
    service = Service(NONE, 1, 0)
    yield service
    assert service.close(ENOUGH)


def test_the_page_shows_the_place(service: Service, make_store: Any, loop: Any) -> None:
    log, store = Log(), make_store()
    asked = [Asked(log, name) for name in "abc"]
    for one in asked[:2]:
        one.into(service.queue)
    store.run.session = service.enter()
    store.run.session.post = loop.queue.put
    store.run.start(asked[2].job)
    loop.until(lambda: store.run.place == 2)
    assert status_of(store)[1] == "Waiting: position 2" and store.run.state == RUNNING
    for one in asked[:2]:
        one.gate.set()
    loop.until(lambda: store.run.place == 0)
    asked[2].job.tell(progress=0.25)
    loop.until(lambda: status_of(store)[1] == "Running, 25 %")
    store.run.cancel()
    log.until(lambda: not log.running.total())


def test_the_top_of_the_page_names_what_goes_on_beside_the_run(make_store: Any) -> None:
    store = make_store()
    store.run.state = DONE
    before = status_of(store)
    tasks = [BackgroundTask(store.session, title=name) for name in ("Sweep", "Tuning")]
    for task in tasks:
        task.param.update(state=RUNNING, progress=0.25)
    assert status_of(store)[:2] == (0.25, "Tuning, 25 %")
    tasks[1].refuse("no")
    assert status_of(store)[:2] == (0.25, "Sweep, 25 %")
    tasks[0].cancel()
    assert status_of(store) == before


def test_a_task_shows_one_job_at_a_time(service: Service, loop: Any, caplog: Any) -> None:
    session, gate = service.enter(), threading.Event()
    session.post = loop.queue.put
    task = BackgroundTask(session)

    def slow(watch: Watch, tell: Any) -> str:
        watch.step(0.5)
        tell(latest="half")
        assert gate.wait(ENOUGH)
        return "late"

    task.start(Job("tune", slow))
    loop.until(lambda: task.latest == "half")
    assert (task.state, task.progress) == (RUNNING, 0.5)
    task.cancel()
    assert task.state == CANCELLED
    task.start(Job("tune", lambda *_: "second"))
    gate.set()
    loop.until(lambda: task.state == DONE)
    assert task.result == "second" and task.latest is None
    task.start(Job("tune", lambda *_: 1 / 0))
    loop.until(lambda: task.state == FAILED)
    assert (task.message, task.result) == ("ZeroDivisionError: division by zero", "second")
    assert loop.queue.empty(), "nothing of what was cancelled lands"


def test_a_result_is_drawn_before_its_end_also_where_another_job_was_left(service: Service) -> None:
    session, posted = service.enter(), []
    session.post = posted.append
    task = BackgroundTask(session, drawn_first=True)
    task._hear(task._generation, {"progress": 0.5})
    task.close()
    task._hear(task._generation, {"state": DONE, "result": 1})
    (land,) = posted
    land()
    assert task.result == 1 and task.state != DONE
    posted[1]()
    assert task.state == DONE and len(posted) == 2


def test_a_session_that_ends_takes_its_jobs_out_of_the_line(service: Service, loop: Any) -> None:
    log = Log()
    busy = Asked(log, "a").into(service.queue)
    log.until(lambda: log.started == ["a"])
    session = service.enter()
    tasks = [BackgroundTask(session) for _ in KINDS]
    for task, kind in zip(tasks, KINDS, strict=True):
        task.start(Asked(log, "b", kind=kind).job)
    assert service.queue.length == 6
    session.leave()
    assert service.queue.length == 0
    tasks[0].start(Asked(log, "b").job)
    assert service.queue.length == 0, "nor does it begin anything after"
    busy.gate.set()


def test_who_changes_their_mind_keeps_their_turn(make_queue: Any) -> None:
    queue, log = make_queue(1), Log()
    busy = Asked(log, "a").into(queue)
    log.until(lambda: log.started == ["a"])
    mine = Asked(log, "b").into(queue)
    for _ in range(5):
        before, mine = mine, Asked(log, "b")
        mine.leave = queue.submit(mine.job, "b", mine.hear, before.leave)
    twice = [Asked(log, "c").into(queue) for _ in range(2)]
    assert [one.places[-1] for one in (mine, *twice)] == [1, 2, 3] and queue.length == 3
    for one in (mine, *twice, busy):
        one.gate.set()


def test_the_same_again_goes_on(service: Service, loop: Any) -> None:
    log, session = Log(), service.enter()
    session.post = loop.queue.put
    task, first, again = BackgroundTask(session), Asked(log, "a", "first", key="k"), Asked(log, "a", "again", key="k")
    task.start(first.job)
    log.until(lambda: log.started == ["first"])
    task.start(again.job)
    first.gate.set()
    loop.until(lambda: task.state == DONE)
    assert task.result == "first" == service.cache.get("k") and log.started == ["first"]
