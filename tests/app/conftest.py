"""A session without a server: what another thread posts waits in a queue until the test lets it land."""

from __future__ import annotations

import gc
import queue
from collections.abc import Callable, Iterator
from math import inf
from time import monotonic
from typing import Any

import numpy as np
import panel as pn
import pytest

from wfsobs.app.cache import freeze
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.idle_work import SeedRuns
from wfsobs.app.jobs import RUNNING, Tell
from wfsobs.app.limits import NONE, Limits
from wfsobs.app.service import Service, Session, run_key
from wfsobs.app.sources import LoadedRecord, Source
from wfsobs.app.store import Store
from wfsobs.app.work import RunResults, compute
from wfsobs.closed_loop.run import Outcome
from wfsobs.dependence import Memo
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS

WAIT = 200.0
"""How long a page is waited for [s]: a busy machine takes ten times as long as a quiet one."""

SHORT = {
    "run.duration": 2.0,
    "run.warm_up": 0.5,
    "gpr_offline.training_size": 40,
    "gpr_offline.depth": 20,
    "gpr_online.training_size": 40,
    "gpr_online.depth": 20,
    "adaptive.window": 0.5,
    "adaptive.interval": 1.0,
}


class Loop:
    """Stands for the event loop of a session."""

    def __init__(self) -> None:
        self.queue: queue.Queue[Callable[[], None]] = queue.Queue()
        self.closing: list[Any] = []

    def land(self, timeout: float = WAIT) -> None:
        """Do the next thing that was posted."""
        self.queue.get(timeout=timeout)()

    def until(self, condition: Callable[[], bool], timeout: float = WAIT) -> None:
        """Do what is posted until a condition holds."""
        end = monotonic() + timeout
        while not condition():
            self.land(max(end - monotonic(), 0.01))

    def finish(self, store: Store) -> None:
        """Do what is posted until the run is over."""
        self.until(lambda: store.run.state != RUNNING)


@pytest.fixture(scope="session", autouse=True)
def frozen() -> Iterator[None]:
    """The end of a session looks through what was made in it, not through what was there before all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gc, "unfreeze", lambda: None)
        yield


@pytest.fixture(autouse=True)
def light() -> None:
    """Outside a session a page that turns dark turns all later ones dark."""
    pn.config.theme = "default"


@pytest.fixture
def loop() -> Iterator[Loop]:
    loop = Loop()
    yield loop
    for thing in loop.closing:
        getattr(thing, "store", thing).session.leave()  # a page or a store


@pytest.fixture
def short() -> Scenario:
    return PRESETS["paper"]().replace(SHORT)


@pytest.fixture
def enter() -> Iterator[Callable[..., Session]]:
    """A session of a server of its own, which keeps no results."""
    services: list[Service] = []

    def enter(work: Any = compute, limits: Limits = NONE, workers: int = 2, memo: Memo | None = None) -> Session:
        services.append(Service(limits, workers, 0, work, memo))
        return services[-1].enter()

    yield enter
    for service in services:
        service.close(20.0)


@pytest.fixture
def make_store(loop: Loop, short: Scenario, enter: Callable[..., Session]) -> Callable[..., Store]:
    def make(work: Any = compute) -> Store:
        store = Store(loop.queue.put, enter(work), short)
        loop.closing.append(store)
        return store

    return make


MOST = 12
KEPT: dict[str, RunResults] = {}
"""The last MOST results of simulations by what they are of, their arrays read-only."""


def compute_once(scenario: Scenario, watch: Watch, tell: Tell, source: Source | None = None) -> RunResults:
    """`compute`, and what it gave the last time where that is kept; records that are loaded have any key in the tests."""
    if isinstance(source, LoadedRecord):
        return compute(scenario, watch, tell, source)
    key = run_key(scenario, source)
    shown = KEPT.pop(key, None) or freeze(compute(scenario, watch, tell, source))
    KEPT[key] = shown
    for oldest in list(KEPT)[:-MOST]:
        KEPT.pop(oldest, None)
    return shown


class Outcomes(Memo):
    """What controllers have done, held in memory: most of what a closed loop takes."""

    def __init__(self) -> None:
        super().__init__()
        self.held: dict[str, Any] = {}

    def put(self, name: str, value: Any) -> Any:
        if isinstance(value, Outcome):
            self.held[name] = value
        return super().put(name, value)


OUTCOMES = Outcomes()


@pytest.fixture
def dashboard(loop: Loop, short: Scenario, enter: Callable[..., Session]) -> Dashboard:
    """A dashboard whose first run is done; what waits for idle time is never done, as on a server that is never idle."""
    session = enter(compute_once, memo=OUTCOMES)
    session.service.queue.rest = inf
    dashboard = Dashboard(loop.queue.put, session, short)
    loop.closing.append(dashboard)
    dashboard.page()
    dashboard.start()
    loop.finish(dashboard.store)
    return dashboard


class OneSeed(SeedRuns):
    """Seeds of which none but the first runs."""

    possible = False  # type: ignore[assignment]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1)
