"""Further seeds of the scenario shown, run in idle time: what they say of the errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import param

from wfsobs.app.cache import size_of
from wfsobs.app.jobs import DONE, IDLE_TIME, Job, Tell
from wfsobs.app.service import BackgroundTask
from wfsobs.app.sources import LoadedRecord, SimulatedRecord, Source
from wfsobs.app.store import Store
from wfsobs.app.work import RunResults
from wfsobs.cost import run_seconds
from wfsobs.dependence import Memo, RecordMemo, simulate_once
from wfsobs.evaluation.evidence import FEWEST, Evidence, gather_evidence
from wfsobs.evaluation.result import Result
from wfsobs.evaluation.scores import Score
from wfsobs.pipeline import observe
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError

SEEDS = 8
"""How many seeds there are unless chosen, the one shown among them."""

MOST = 50

PATIENCE = 20.0
"""A scenario whose run takes longer has no further seeds [s]."""


LIGHT = 5_000_000
"""A seed whose record and estimates take less is kept whole [bytes], so that a change of one observer runs that one alone."""


@dataclass(frozen=True)
class SeedScores:
    """The scores of one seed, their errors as an array, whose size the cache counts, and its result where that is light."""

    scores: tuple[Score, ...]
    errors: np.ndarray
    result: Result | None = None


def run_seed(
    scenario: Scenario, source: Source | None, seed: int, watch: Watch, _tell: Tell, memo: Memo | None = None
) -> SeedScores:
    """Run every observer on the record of another seed. Raises SettingError, Cancelled.

    memo : what is known in it by what it depends on does not run
    """
    memo = Memo() if memo is None else memo
    simulation = (scenario if source is None or source.simulation is None else source.simulation).replace({"run.seed": seed})
    record = simulate_once(simulation, memo, watch)
    result = observe(record, scenario, watch=watch, memo=RecordMemo(memo, record), gate=False)
    errors = np.array([s.rms for s in result.scores])
    return SeedScores(result.scores, errors, result if size_of(result) <= LIGHT else None)


class SeedRuns(param.Parameterized):
    """One seed after the other, once a run is done; what has been found of a scenario goes with it."""

    count: param.Integer[int] = param.Integer(
        SEEDS, bounds=(1, MOST), label="Seeds", doc="Seeds whose records are compared; 1 is the one shown."
    )
    evidence: param.Parameter[Evidence | None] = param.Parameter(None, doc="What the seeds done so far say; None for too few.")

    def __init__(self, store: Store):
        super().__init__()
        self.store = store
        self.run: Final = store.run
        self.task: Final = BackgroundTask(store.session)
        self._of: RunResults | None = None
        self._scores: list[Sequence[Score]] = []
        self.run.param.watch(self._follow, ["state", "result"])
        store.param.watch(self._follow, "stale")
        self.task.param.watch(self._take, "result")
        self.param.watch(self._go_on, "count")

    @property
    def n_known(self) -> int:
        """How many seeds are known."""
        return min(len(self._scores), self.count)

    @property
    def possible(self) -> bool:
        """Whether the record shown can be simulated with other seeds, in a time that is not too long."""
        of = self._of
        return of is not None and not isinstance(of.source, LoadedRecord) and run_seconds(of.scenario) <= PATIENCE

    def _follow(self, *_: object) -> None:
        """Begin anew with what is shown, once it is complete."""
        shown = self.run.result if self.run.state == DONE and not self.store.stale else None
        if shown is self._of:
            return
        self.task.close()
        self._of, self._scores = shown, [shown.result.scores] if shown is not None else []
        self._go_on()

    def _take(self, *_: object) -> None:
        found = self.task.result
        if found is not None and self._of is not None:
            self._scores.append(found.scores)
            self.task.result = None  # the next may be the same
            self._go_on()

    def _go_on(self, *_: object) -> None:
        """Say what is known, and have the next seed run; what is there already does not wait for a turn each."""
        self._take_known()
        self.evidence = gather_evidence(self._scores[: self.count]) if self.n_known >= FEWEST else None
        if not self.possible or len(self._scores) >= self.count:
            self.task.close()
        else:
            assert self._of is not None
            self.task.start(self._job(self._of, len(self._scores)))

    def _take_known(self) -> None:
        service = self.task.session.service
        while self._of is not None and self.possible and len(self._scores) < self.count:
            of = self._of
            found = service.cache.get(service.seed_key(of.scenario, of.source, self._seed(of, len(self._scores))))
            if not isinstance(found, SeedScores):
                return
            self._scores.append(found.scores)

    def _seed(self, of: RunResults, number: int) -> int:
        simulated = of.source.simulation if isinstance(of.source, SimulatedRecord) else of.scenario
        return simulated.run.seed + number

    def _job(self, of: RunResults, number: int) -> Job:
        source, seed = of.source, self._seed(of, number)
        return Job(
            "seed",
            lambda watch, tell: run_seed(of.scenario, source, seed, watch, tell, self.task.session.service.memo),
            key=self.task.session.service.seed_key(of.scenario, source, seed),
            cost=run_seconds(of.scenario),
            priority=IDLE_TIME,
            refusal=SettingError,
        )
