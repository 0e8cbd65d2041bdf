"""Results shared by sessions: kept within a bound, computed once, and never changed by one who has them."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.patience import ENOUGH
from wfsobs.app.cache import Cache, arrays_in, key_of, size_of
from wfsobs.app.jobs import CANCELLED, FAILED, RUNNING, Tell
from wfsobs.app.limits import NONE
from wfsobs.app.service import Service
from wfsobs.app.work import RunResults, SignalAndError, compute
from wfsobs.evaluation.result import Result
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError


def answer(scenario: Scenario) -> RunResults:
    record = Record(y_lgs=np.zeros((8, 2)), u=np.zeros((8, 2)), dt=1e-3)
    return RunResults(Result(scenario, record, (), ()))


class Gated:
    """Work that waits to be let go, and looks whether it is wanted when it is."""

    def __init__(self) -> None:
        self.entered, self.gate = threading.Semaphore(0), threading.Event()
        self.calls: list[tuple[Scenario, Watch, Tell]] = []

    def __call__(self, scenario: Scenario, watch: Watch, tell: Tell, _loaded: object) -> RunResults:
        self.calls.append((scenario, watch, tell))
        self.entered.release()
        assert self.gate.wait(ENOUGH)
        watch.check()
        return answer(scenario)


class Asked:
    """Somebody who has asked for the results of a scenario, and what they heard."""

    def __init__(self, service: Service, scenario: Scenario):
        self.heard: list[dict[str, Any]] = []
        self.over = threading.Event()
        self.leave = service.enter().submit(service.run(scenario), self.hear)

    def hear(self, news: Any) -> None:
        self.heard.append(dict(news))
        if news.get("state", RUNNING) != RUNNING:
            self.over.set()

    def end(self) -> dict[str, Any]:
        """The last that they hear."""
        assert self.over.wait(ENOUGH)
        return self.heard[-1]


@pytest.fixture
def make_service() -> Iterator[Callable[..., Service]]:
    made: list[Service] = []

    def make(work: Any, workers: int = 2) -> Service:
        made.append(Service(NONE, workers, 10**8, work))
        return made[-1]

    yield make
    for service in made:
        assert service.close(ENOUGH), "a thread did not stop"


# ---------------------------------------------------------------------- what is kept


class Model:
    """The textbook version: a list in order of use."""

    def __init__(self, most: int):
        self.most = most
        self.kept: OrderedDict[int, int] = OrderedDict()

    def put(self, key: int, size: int) -> None:
        self.kept.pop(key, None)
        if size <= self.most:
            self.kept[key] = size
        while sum(self.kept.values()) > self.most:
            self.kept.popitem(last=False)

    def get(self, key: int) -> int | None:
        if key in self.kept:
            self.kept.move_to_end(key)
        return self.kept.get(key)


@settings(deadline=None)
@given(
    st.integers(0, 40),
    st.lists(st.tuples(st.booleans(), st.integers(0, 5), st.integers(0, 25)), max_size=60),
)
def test_least_recently_used_goes_first_and_the_bound_holds(most: int, steps: list[tuple[bool, int, int]]) -> None:
    cache = Cache(8 * most)
    model = Model(most)
    for put, key, size in steps:
        if put:
            cache.put(key, np.zeros(size))
            model.put(key, size)
        else:
            kept = cache.get(key)
            assert (None if kept is None else kept.size) == model.get(key)
        assert [key for key in range(6) if key in cache] == sorted(model.kept) and sum(model.kept.values()) <= most


def test_what_is_kept_cannot_be_changed() -> None:
    shown = answer(Scenario())
    kept = Cache(10**6).put("a", shown)
    with pytest.raises(ValueError, match="read-only"):
        kept.result.record.u[0] = 1.0


def test_size_is_of_the_memory_held() -> None:
    base = np.zeros((10, 4))
    assert size_of({"whole": base, "part": base[:, 1], "again": (base, [base.T])}) == base.nbytes
    assert size_of(SignalAndError(np.zeros(3), np.zeros((3, 2)), np.zeros((3, 2)))) == 8 * (3 + 6 + 6)


def test_every_array_of_a_run_is_found(short: Scenario) -> None:
    shown = compute(short, QUIET, lambda **_: None)
    found = {id(array) for array in arrays_in(shown)}
    record = shown.result.record
    own = [
        record.y_lgs,
        record.u,
        record.y_ngs,
        record.turbulence,
        record.vibration,
        record.open_loop_y,
        *(e.values for e in shown.result.estimates),
        *(s.error for s in shown.spectra.values()),
    ]
    assert record.training is not None
    assert {id(array) for array in (*own, record.training.u) if array is not None} <= found


@pytest.mark.parametrize(
    "changes",
    [
        {"turbulence.wind_speed": 15.000001},
        {"run.seed": 2},
        {"loop.closed": False},
        {"vibration.peaks": []},
        {"kalman.process_noise": "manual"},
        {"butterworth.frequencies": [17.1]},
    ],
)
def test_other_settings_have_another_key(changes: dict[str, Any]) -> None:
    assert key_of(Scenario().replace(changes)) != key_of(Scenario())


# ---------------------------------------------------------------------- one run for all who want it


def test_the_same_settings_are_computed_once_at_the_same_time(make_service: Any, short: Scenario) -> None:
    work = Gated()
    service = make_service(work)
    asked = [Asked(service, short.copy()) for _ in range(8)]
    assert work.entered.acquire(timeout=ENOUGH)
    work.gate.set()
    results = [one.end()["result"] for one in asked]
    assert len(work.calls) == 1 and len({id(shown) for shown in results}) == 1
    assert Asked(service, short).end()["result"] is results[0] and len(work.calls) == 1, "and kept"
    assert service.is_cached(short)


def test_other_settings_are_not_mixed_up(make_service: Any, short: Scenario) -> None:
    service = make_service(lambda scenario, *_: answer(scenario))
    scenarios = [short.replace({"run.seed": seed % 5}) for seed in range(40)]
    asked = [Asked(service, scenario) for scenario in scenarios]
    assert [one.end()["result"].scenario for one in asked] == scenarios


def test_who_joins_hears_of_progress_those_who_come_late_too(make_service: Any, short: Scenario) -> None:
    work = Gated()
    service = make_service(work)
    first = Asked(service, short)
    assert work.entered.acquire(timeout=ENOUGH)
    part = answer(short)
    _, watch, tell = work.calls[0]
    watch.progress(0.3)
    watch.progress(0.4)
    assert [news["progress"] for news in first.heard if "progress" in news] == [0.3], "not more often than a page can show"
    tell(result=part)
    second = Asked(service, short)
    assert second.heard == [{"progress": 0.3, "result": part}]
    tell(progress=0.6)
    assert second.heard[-1] == first.heard[-1] == {"progress": 0.6}
    work.gate.set()
    assert first.end()["result"] is second.end()["result"] is not part


def test_one_who_leaves_does_not_stop_it_for_others(make_service: Any, short: Scenario) -> None:
    work = Gated()
    service = make_service(work)
    leader = Asked(service, short)
    assert work.entered.acquire(timeout=ENOUGH)
    follower = Asked(service, short)
    leader.leave()
    assert not work.calls[0][1].is_cancelled()
    work.gate.set()
    assert follower.end()["result"].scenario == short and len(work.calls) == 1
    assert not leader.over.is_set(), "who has left hears nothing more"


def test_what_nobody_wants_stops_at_once_and_starts_anew_for_the_next(make_service: Any, short: Scenario) -> None:
    work = Gated()
    service = make_service(work)
    leader = Asked(service, short)
    assert work.entered.acquire(timeout=ENOUGH)
    leader.leave()
    assert work.calls[0][1].is_cancelled()
    after = Asked(service, short)
    work.gate.set()
    assert after.end()["result"].scenario == short and len(work.calls) == 2


def test_a_failure_reaches_all_and_is_not_kept(make_service: Any, short: Scenario) -> None:
    gate, entered = threading.Event(), threading.Event()
    errors: list[Exception] = [SettingError("loop.gain: not today")]

    def fails(scenario: Scenario, *_: object) -> RunResults:
        entered.set()
        assert gate.wait(ENOUGH)
        if errors:
            raise errors.pop()
        return answer(scenario)

    service = make_service(fails)
    first = Asked(service, short)
    assert entered.wait(ENOUGH)
    second = Asked(service, short)
    gate.set()
    for one in (first, second):
        assert one.end() == {"state": FAILED, "message": "loop.gain: not today"}
    assert not service.is_cached(short)
    assert Asked(service, short).end()["result"].scenario == short


def test_closing_the_service_ends_every_wait(make_service: Any, short: Scenario) -> None:
    entered = threading.Event()

    def works(scenario: Scenario, watch: Watch, *_: object) -> RunResults:
        entered.set()
        while True:
            watch.check()
            time.sleep(0.001)

    service = make_service(works, workers=1)
    asked = [Asked(service, short.replace({"run.seed": seed})) for seed in range(3)]
    assert entered.wait(ENOUGH) and service.queue.length == 2
    assert service.close(ENOUGH)
    assert [one.end() for one in (*asked, Asked(service, short))] == 4 * [{"state": CANCELLED}]
