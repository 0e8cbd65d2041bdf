"""A session without a server: what another thread posts waits in a queue until the test lets it land."""

from __future__ import annotations

import gc
import itertools
import queue
from collections.abc import Callable, Iterator
from math import inf
from time import monotonic
from types import SimpleNamespace
from typing import Any

import numpy as np
import panel as pn
import pytest

from tests.patience import ENOUGH
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
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.dependence import Memo
from wfsobs.priors_from import scenario as priors
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS

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

    def land(self, timeout: float = ENOUGH) -> None:
        """Do the next thing that was posted."""
        self.queue.get(timeout=timeout)()

    def until(self, condition: Callable[[], bool], timeout: float = ENOUGH) -> None:
        """Do what is posted until a condition holds."""
        end = monotonic() + timeout
        while not condition():
            self.land(max(end - monotonic(), 0.01))

    def finish(self, store: Store) -> None:
        """Do what is posted until the run is over."""
        self.until(lambda: store.run.state != RUNNING)


SESSIONS = 8
"""So many sessions leave their pages to the collector before it looks for them."""


@pytest.fixture(scope="module", autouse=True)
def unhurried() -> Iterator[Callable[[], None]]:
    """No run waits for a drawing; what sessions leave is collected now and then, among what is new, not as each ends."""
    sessions, thresholds = itertools.count(), gc.get_threshold()

    def collect() -> None:
        if next(sessions) % SESSIONS == 0:
            gc.collect()
            gc.freeze()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("wfsobs.app.service.gc", SimpleNamespace(collect=int, freeze=lambda: None, unfreeze=lambda: None))
        patch.setattr("wfsobs.app.work.DRAWING", 0.0)
        gc.set_threshold(20_000, 20, 10**6)
        yield collect
    gc.set_threshold(*thresholds)


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
def enter(unhurried: Callable[[], None]) -> Iterator[Callable[..., Session]]:
    """A session of a server of its own, which keeps no results."""
    unhurried()
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

KNOWN = Memo()
"""Of what is kept, as a server knows it of its sessions."""


def compute_once(scenario: Scenario, watch: Watch, tell: Tell, source: Source | None = None) -> RunResults:
    """`compute`, and what it gave the last time where that is kept; records that are loaded have any key in the tests."""
    if isinstance(source, LoadedRecord):
        return compute(scenario, watch, tell, source, KNOWN)
    key = f"{run_key(scenario, source)} {priors.usual_observers(scenario)}"
    shown = KEPT.pop(key, None) or freeze(compute(scenario, watch, tell, source, KNOWN))
    KEPT[key] = shown
    for oldest in list(KEPT)[:-MOST]:
        KEPT.pop(oldest, None)
    return shown


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody learns during the run, which takes two thirds of the time of observers and nearly all of that of controllers."""
    is_usual, learners = priors.is_usual, ("lqg-kf-adaptive", "lqg-multirate-adaptive", "integrator+gpr-online")
    monkeypatch.setattr(priors, "is_usual", lambda observer, *of: not observer.slow and is_usual(observer, *of))
    monkeypatch.setattr(CONTROLLERS, "_entries", {name: it for name, it in CONTROLLERS.items() if name not in learners})


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


def open_dashboard(loop: Loop, session: Session, scenario: Scenario) -> Dashboard:
    """A dashboard whose first run is done; what waits for idle time is never done, as on a server that is never idle."""
    session.service.queue.rest = inf
    dashboard = Dashboard(loop.queue.put, session, scenario)
    loop.closing.append(dashboard)
    dashboard.page()
    dashboard.start()
    loop.finish(dashboard.store)
    return dashboard


@pytest.fixture
def dashboard(loop: Loop, short: Scenario, enter: Callable[..., Session]) -> Dashboard:
    return open_dashboard(loop, enter(compute_once, memo=OUTCOMES), short)


@pytest.fixture(scope="module")
def shared_loop() -> Iterator[Loop]:
    loop = Loop()
    yield loop
    for dashboard in loop.closing:
        dashboard.store.session.leave()
        dashboard.store.session.service.close(20.0)


@pytest.fixture(scope="module")
def shared_board(shared_loop: Loop) -> Dashboard:
    session = Service(NONE, 2, 0, compute_once, OUTCOMES).enter()
    return open_dashboard(shared_loop, session, PRESETS["paper"]().replace(SHORT))


@pytest.fixture
def shared(shared_board: Dashboard) -> Iterator[Dashboard]:
    """A dashboard for all tests of a module that change no setting; what is displayed is put back after each."""
    board, display, frequencies = shared_board, shared_board.display, shared_board.explore.spectra.x_range
    scenario, whole = board.store.scenario, (frequencies.start, frequencies.end)
    values = {name: value for name, value in display.param.values().items() if name != "name"}
    yield board
    board.upload.discard()
    board.view_state.open("")
    display.param.update(dark=False, editing=False)
    frequencies.update(start=whole[0], end=whole[1])
    assert board.store.scenario is scenario and display.param.values().items() >= values.items()


class OneSeed(SeedRuns):
    """Seeds of which none but the first runs."""

    possible = False  # type: ignore[assignment]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1)
