"""What idle time is spent on: further seeds of the scenario shown, and why every observer has the error that it has."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import param

from wfsobs.app.cache import size_of
from wfsobs.app.jobs import DONE, IDLE_TIME, Job, Tell
from wfsobs.app.service import BackgroundTask, run_key
from wfsobs.app.sources import LoadedRecord, SimulatedRecord, Source
from wfsobs.app.store import Store
from wfsobs.app.style import watch
from wfsobs.app.work import RunResults
from wfsobs.cost import part_seconds, run_seconds
from wfsobs.dependence import Memo, RecordMemo, simulate_once
from wfsobs.evaluation.budget import Budget, error_budget
from wfsobs.evaluation.evidence import FEWEST, Evidence, gather_evidence
from wfsobs.evaluation.result import Result
from wfsobs.evaluation.scores import Score
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.pipeline import observe
from wfsobs.priors_from.scenario import usual_observers
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
    def usual(self) -> list[str]:
        """Ids of the observers that run where none is named: on the record shown, or on one of the settings."""
        shown = self.run.result
        return usual_observers(shown.scenario, shown.result.record) if shown else usual_observers(self.store.scenario)

    @property
    def n_known(self) -> int:
        """How many seeds are known."""
        return min(len(self._scores), self.count)

    @property
    def possible(self) -> bool:
        """Whether the record shown can be simulated with other seeds, in a time that is not too long."""
        of = self._of
        return of is not None and not isinstance(of.source, LoadedRecord) and run_seconds(of.scenario) <= PATIENCE

    @property
    def n_seeds(self) -> int:
        """How many seeds the errors are means over."""
        return self.evidence.n_seeds if self.evidence else 1

    def over_seeds(self, score: Score) -> Score:
        """Return a score with its mean over the seeds, where there are several."""
        return self.evidence.over_seeds(score) if self.evidence else score

    def _follow(self, *_: object) -> None:
        """Begin anew with what is shown, once it is complete."""
        shown = self.run.result if self.run.state == DONE and not self.store.stale else None
        if shown is self._of:
            return
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
        cache = self.task.session.service.cache
        while (job := self._next_job()) is not None and (found := cache.get(job.key)) is not None:
            self._scores.append(found.scores)
        self.evidence = gather_evidence(self._scores[: self.count]) if self.n_known >= FEWEST else None
        if job is None:
            self.task.close()
        else:
            self.task.start(job)

    def _next_job(self) -> Job | None:
        """Make the job of the first seed that is not known; None where there is none."""
        of, number = self._of, len(self._scores)
        if of is None or not self.possible or number >= self.count:
            return None
        simulated = of.source.simulation if isinstance(of.source, SimulatedRecord) else of.scenario
        seed = simulated.run.seed + number
        return Job(
            "seed",
            partial(run_seed, of.scenario, of.source, seed, memo=self.task.session.service.memo),
            key=f"seed {seed} of {run_key(of.scenario, of.source)}",
            cost=run_seconds(of.scenario),
            priority=IDLE_TIME,
            refusal=SettingError,
        )


RUNS = 16
"""How often an observer that is not linear runs for a budget: on every combination of sources."""

BUDGET_PATIENCE = 60.0
"""An observer whose runs take longer has no budget [s]."""

UNKNOWN = 0.05
"""About how long an observer takes whose time is not estimated [s]."""

ByObserver = dict[str, Sequence[Budget]]
"""Observer -> budgets of its targets and modes."""


class Budgets(param.Parameterized):
    """The budgets of linear observers and of the main ones; of all others too once they are asked for.

    seeds : which change the main ones; where one record is enough, nothing else runs in idle time
    main  : returns the main observers of a target
    """

    by_observer: param.Parameter[ByObserver] = param.Parameter(
        {}, doc="Observer -> its budgets (a sequence of Budget), as far as they are known."
    )
    every: param.Boolean[bool] = param.Boolean(
        False, doc="Whether observers that are not linear have theirs too, though they are not main ones."
    )

    def __init__(self, seeds: SeedRuns, main: Callable[[str], Collection[str]]):
        super().__init__()
        self.seeds = seeds
        self.run: Final = seeds.run
        self.main = main
        self.task: Final = BackgroundTask(seeds.store.session)
        self._of: RunResults | None = None
        self._budgets: ByObserver = {}
        self._names: list[str] = []
        watch(self._follow, (self.run, ["state", "result"]), (self, "every"), (seeds, ["evidence", "count"]))
        self.task.param.watch(self._take, ["latest", "state"])

    def budget(self, observer: str, target: str, mode: str) -> Budget | None:
        """Find a budget; None where it is not known."""
        return next((b for b in self.by_observer.get(observer, ()) if (b.target, b.mode) == (target, mode)), None)

    def ask_for_all(self) -> None:
        """Compute the budgets of observers that are not linear and no main ones too."""
        self.every = True

    @property
    def possible(self) -> bool:
        """Whether what is shown has budgets: of other records the sources are not known."""
        shown = self.run.result
        return shown is not None and not shown.is_recorded and shown.scenario.vibration.source != "psd"

    def _follow(self, *_: object) -> None:
        """Begin anew with what is shown, once it is complete."""
        shown = self.run.result if self.run.state == DONE and self.possible else None
        if shown is not self._of:
            self._of, self._budgets, self._names, self.by_observer = shown, {}, [], {}
        if shown is None:
            self.task.close()
        elif not set(wanted := self._order(shown)) <= set(self._names):
            self._names = wanted
            work = partial(compute_budgets, shown, wanted, self._budgets)
            self.task.start(Job("budgets", work, cost=run_seconds(shown.scenario), priority=IDLE_TIME))

    def _order(self, results: RunResults) -> list[str]:
        """List the observers that are to have a budget, the main ones and the quick ones first."""
        ran, each = {e.observer for e in results.result.estimates}, part_seconds(results.scenario)
        main = {name for target in TARGETS for name in self.main(target) if self.seeds.count > 1}
        seconds = {o.id: 0.0 if o.linear else RUNS * each.get(o.id, UNKNOWN) for o in OBSERVERS.values() if o.id in ran}
        most = min(BUDGET_PATIENCE, self.seeds.store.limits.seconds)
        wanted = [name for name, of in seconds.items() if of == 0.0 or (of <= most and (self.every or name in main))]
        return sorted(wanted, key=lambda name: (seconds[name] > 0.0, name not in main, seconds[name]))

    def _take(self, *_: object) -> None:
        if self._of is not None and self.task.latest is not None:
            self.by_observer = self.task.latest


def compute_budgets(results: RunResults, names: Sequence[str], budgets: ByObserver, watch: Watch, tell: Tell) -> None:
    """Compute the budgets of observers; budgets : those there are already, to which it adds."""
    for name in names:
        if name not in budgets:
            budgets[name] = error_budget(results.result, observers=[name], watch=Watch(is_cancelled=watch.is_cancelled))
            tell(latest=dict(budgets))
