"""Error budgets of what is shown, computed in idle time: why every observer has the error that it has."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Final

import param

from wfsobs.app.jobs import DONE, IDLE_TIME, Job
from wfsobs.app.seeds import SeedRuns
from wfsobs.app.service import BackgroundTask
from wfsobs.app.store import Store
from wfsobs.app.work import RunResults
from wfsobs.cost import part_seconds, run_seconds
from wfsobs.evaluation.budget import Budget, error_budget
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.progress import Watch

RUNS = 16
"""How often an observer that is not linear runs for a budget: on every combination of sources."""

PATIENCE = 60.0
"""An observer whose runs take longer has no budget [s]."""

LIGHT = 0.05
"""About how long an observer takes whose time is not estimated [s]."""

ByObserver = dict[str, Sequence[Budget]]
"""Observer -> budgets of its targets and modes."""


class Budgets(param.Parameterized):
    """The budgets of linear observers and of the main ones; of all others too once they are asked for.

    main  : returns the main observers of a target
    seeds : which change the main ones; where one record is enough, nothing else runs in idle time
    """

    by_observer: param.Parameter[ByObserver] = param.Parameter(
        {}, doc="Observer -> its budgets (a sequence of Budget), as far as they are known."
    )
    every: param.Boolean[bool] = param.Boolean(
        False, doc="Whether observers that are not linear have theirs too, though they are not main ones."
    )

    def __init__(self, store: Store, main: Callable[[str], Collection[str]], seeds: SeedRuns | None = None):
        super().__init__()
        self.store = store
        self.run: Final = store.run
        self.main = main
        self.seeds = seeds
        self.task: Final = BackgroundTask(store.session)
        self._of: RunResults | None = None
        self._budgets: ByObserver = {}
        self._names: list[str] = []
        self.run.param.watch(self._follow, ["state", "result"])
        self.param.watch(self._follow, "every")
        if seeds is not None:
            seeds.param.watch(self._follow, ["evidence", "count"])
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
        wanted = [] if shown is None else self._order(shown)
        if shown is not None and not set(wanted) <= set(self._names):
            self._names = wanted
            self.task.start(budgets_job(shown, wanted, self._budgets))
        elif shown is None:
            self.task.close()

    def _order(self, results: RunResults) -> list[str]:
        """List the observers that are to have a budget, the main ones and the quick ones first."""
        ran, each = {e.observer for e in results.result.estimates}, part_seconds(results.scenario)
        is_one_record = self.seeds is not None and self.seeds.count == 1
        main = set() if is_one_record else {name for target in TARGETS for name in self.main(target)}
        seconds = {o.id: 0.0 if o.linear else RUNS * each.get(o.id, LIGHT) for o in OBSERVERS.values() if o.id in ran}
        most = min(PATIENCE, self.store.limits.seconds)
        wanted = [name for name, of in seconds.items() if of == 0.0 or (of <= most and (self.every or name in main))]
        return sorted(wanted, key=lambda name: (seconds[name] > 0.0, name not in main, seconds[name]))

    def _take(self, *_: object) -> None:
        if self._of is not None and self.task.latest is not None:
            self.by_observer = self.task.latest


def budgets_job(results: RunResults, names: Sequence[str], budgets: ByObserver) -> Job:
    """Make the job that computes the budgets of observers; budgets : those there are already, to which it adds."""

    def work(watch: Watch, tell: Callable[..., None]) -> None:
        for name in names:
            if name not in budgets:
                budgets[name] = error_budget(results.result, observers=[name], watch=Watch(is_cancelled=watch.is_cancelled))
                tell(latest=dict(budgets))

    return Job("budgets", work, cost=run_seconds(results.scenario), priority=IDLE_TIME)
