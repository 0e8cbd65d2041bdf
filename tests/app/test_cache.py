"""Results shared by sessions: kept within a bound, computed once, and never changed by one who has them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.app.cache import Cache, arrays_in, key_of, size_of
from wfsobs.app.limits import NONE
from wfsobs.app.service import Service, Visit
from wfsobs.app.work import Report, Shown, Spectrum, compute
from wfsobs.pipeline import Result
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.settings import SettingError
from wfsobs.watch import Cancelled

WAIT = 20.0


def never() -> bool:
    return False


def silent(fraction: float, shown: Shown | None, place: int = 0) -> None:
    return None


def answer(scenario: Scenario) -> Shown:
    record = Record(y_lgs=np.zeros((8, 2)), u=np.zeros((8, 2)), dt=1e-3)
    return Shown(Result(scenario, record, (), ()))


class Gated:
    """Work that waits to be let go, and listens to `cancelled` when it is."""

    def __init__(self) -> None:
        self.entered, self.gate, self.left = threading.Semaphore(0), threading.Event(), threading.Semaphore(0)
        self.calls: list[tuple[Scenario, Callable[[], bool], Report]] = []

    def __call__(self, scenario: Scenario, cancelled: Callable[[], bool], report: Report) -> Shown:
        self.calls.append((scenario, cancelled, report))
        self.entered.release()
        try:
            assert self.gate.wait(WAIT)
            if cancelled():
                raise Cancelled
            return answer(scenario)
        finally:
            self.left.release()


class Bench:
    """A service with some visits, each call of them in a thread."""

    def __init__(self, work: Any, workers: int = 2, most_bytes: int = 10**8):
        self.service = Service(NONE, workers, most_bytes, work)
        self.pool = ThreadPoolExecutor(16)

    def visit(self) -> Visit:
        return self.service.enter()

    def ask(self, visit: Visit, scenario: Scenario, cancelled: Any = never, tell: Any = silent) -> Future[Shown]:
        return self.pool.submit(visit.compute, scenario, cancelled, tell)


@pytest.fixture
def make_bench() -> Any:
    made: list[Bench] = []

    def make(*args: Any, **kwargs: Any) -> Bench:
        made.append(Bench(*args, **kwargs))
        return made[-1]

    yield make
    for bench in made:
        assert bench.service.close(WAIT), "a thread did not stop"
        bench.pool.shutdown()


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
    cache: Cache[np.ndarray] = Cache(8 * most)
    model = Model(most)
    for put, key, size in steps:
        if put:
            cache.put(key, np.zeros(size))
            model.put(key, size)
        else:
            kept = cache.get(key)
            assert (None if kept is None else kept.size) == model.get(key)
        assert cache.bytes == 8 * sum(model.kept.values()) <= 8 * most
        assert len(cache) == len(model.kept) and all(key in cache for key in model.kept)


def test_what_is_kept_cannot_be_changed() -> None:
    shown = answer(Scenario())
    kept = Cache[Shown](10**6).put("a", shown)
    with pytest.raises(ValueError, match="read-only"):
        kept.result.record.u[0] = 1.0


def test_size_is_of_the_memory_held() -> None:
    base = np.zeros((10, 4))
    assert size_of({"whole": base, "part": base[:, 1], "again": (base, [base.T])}) == base.nbytes
    assert size_of(Spectrum(np.zeros(3), np.zeros((3, 2)), np.zeros((3, 2)))) == 8 * (3 + 6 + 6)


def test_every_array_of_a_run_is_found(short: Scenario) -> None:
    shown = compute(short, never, silent)
    found = {id(array) for array in arrays_in(shown)}
    record = shown.result.record
    own = [record.y_lgs, record.u, record.y_ngs, record.turbulence, record.vibration, record.open_loop_y,
           *(e.values for e in shown.result.estimates), *(s.error for s in shown.spectra.values())]
    assert record.training is not None
    assert {id(array) for array in (*own, record.training.u) if array is not None} <= found


@pytest.mark.parametrize("changes", [
    {"turbulence.wind_speed": 15.000001}, {"run.seed": 2}, {"loop.closed": False}, {"vibration.peaks": []},
    {"kalman.process_noise": "manual"}, {"butterworth.frequencies": [17.1]},
])
def test_other_settings_have_another_key(changes: dict[str, Any]) -> None:
    assert key_of(Scenario().replace(changes)) != key_of(Scenario())


# ---------------------------------------------------------------------- one run for all who want it

def test_the_same_settings_are_computed_once_at_the_same_time(make_bench: Any, short: Scenario) -> None:
    work = Gated()
    bench = make_bench(work)
    asked = [bench.ask(bench.visit(), short.copy()) for _ in range(8)]
    assert work.entered.acquire(timeout=WAIT)
    work.gate.set()
    results = [future.result(WAIT) for future in asked]
    assert len(work.calls) == 1 and len({id(shown) for shown in results}) == 1
    assert bench.ask(bench.visit(), short).result(WAIT) is results[0] and len(work.calls) == 1, "and kept"
    assert bench.service.held(short)


def test_other_settings_are_not_mixed_up(make_bench: Any, short: Scenario) -> None:
    bench = make_bench(lambda scenario, cancelled, report: answer(scenario))
    scenarios = [short.replace({"run.seed": seed % 5}) for seed in range(40)]
    asked = [bench.ask(bench.visit(), scenario) for scenario in scenarios]
    assert [future.result(WAIT).scenario for future in asked] == scenarios


def test_followers_hear_of_progress_those_who_come_late_too(make_bench: Any, short: Scenario) -> None:
    work = Gated()
    bench = make_bench(work)
    heard: list[list[tuple[float, Shown | None]]] = [[], []]
    come = threading.Event()

    def hears(who: int) -> Any:
        def tell(fraction: float, shown: Shown | None, place: int = 0) -> None:
            heard[who].append((fraction, shown))
            come.set()
        return tell

    first = bench.ask(bench.visit(), short, tell=hears(0))
    assert work.entered.acquire(timeout=WAIT)
    part = answer(short)
    _, _, report = work.calls[0]
    report(0.3, part)
    report(0.4, None)
    come.clear()
    second = bench.ask(bench.visit(), short, tell=hears(1))
    assert come.wait(WAIT)
    report(0.6, None)
    work.gate.set()
    assert first.result(WAIT) is second.result(WAIT)
    assert (0.3, part) in heard[0]
    assert heard[1][0] == (0.4, part) and heard[1][-1] == (0.6, None)


def test_one_who_leaves_does_not_stop_it_for_others(make_bench: Any, short: Scenario) -> None:
    work = Gated()
    bench = make_bench(work)
    gone = threading.Event()
    leader = bench.ask(bench.visit(), short, cancelled=gone.is_set)
    assert work.entered.acquire(timeout=WAIT)
    joined = threading.Event()
    _, given_up, report = work.calls[0]
    report(0.1, None)
    follower = bench.ask(bench.visit(), short, tell=lambda *_: joined.set())
    assert joined.wait(WAIT)
    gone.set()
    with pytest.raises(Cancelled):
        leader.result(WAIT)
    assert not given_up()
    work.gate.set()
    assert follower.result(WAIT).scenario == short and len(work.calls) == 1


def test_what_nobody_wants_stops_at_once_and_starts_anew_for_the_next(make_bench: Any, short: Scenario) -> None:
    work = Gated()
    bench = make_bench(work)
    gone = threading.Event()
    leader = bench.ask(bench.visit(), short, cancelled=gone.is_set)
    assert work.entered.acquire(timeout=WAIT)
    gone.set()
    _, given_up, _ = work.calls[0]
    assert given_up(), "the run knows before anybody has left"
    after = bench.ask(bench.visit(), short)
    with pytest.raises(Cancelled):
        leader.result(WAIT)
    work.gate.set()
    assert after.result(WAIT).scenario == short
    assert len(work.calls) == 2


def test_a_failure_reaches_all_and_is_not_kept(make_bench: Any, short: Scenario) -> None:
    gate, entered = threading.Event(), threading.Event()
    errors: list[Exception] = [SettingError("loop.gain: not today")]

    def fails(scenario: Scenario, cancelled: Any, report: Any) -> Shown:
        entered.set()
        assert gate.wait(WAIT)
        if errors:
            raise errors.pop()
        return answer(scenario)

    bench = make_bench(fails)
    joined = threading.Event()
    first = bench.ask(bench.visit(), short)
    assert entered.wait(WAIT)
    bench.service._flights[key_of(short)]._report(0.5, None)
    second = bench.ask(bench.visit(), short, tell=lambda *_: joined.set())
    assert joined.wait(WAIT)
    gate.set()
    for future in (first, second):
        with pytest.raises(SettingError, match="not today"):
            future.result(WAIT)
    assert not bench.service.held(short)
    assert bench.ask(bench.visit(), short).result(WAIT).scenario == short


def test_closing_the_service_ends_every_wait(make_bench: Any, short: Scenario) -> None:
    stopped = threading.Event()

    def works(scenario: Scenario, cancelled: Any, report: Any) -> Shown:
        while not cancelled():
            stopped.wait(0.001)
        stopped.set()
        raise Cancelled

    bench = make_bench(works, workers=1)
    asked = [bench.ask(bench.visit(), short.replace({"run.seed": seed})) for seed in range(3)]
    while bench.service.queue.length < 2:
        stopped.wait(0.001)
    assert bench.service.close(WAIT)
    assert stopped.is_set()
    for future in asked:
        with pytest.raises(Cancelled):
            future.result(WAIT)
