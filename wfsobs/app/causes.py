"""Why observers do harm: the error budgets of those that are worse than no estimate, computed in idle time."""

from __future__ import annotations

from collections.abc import Sequence

import param

from wfsobs.app.display import Display
from wfsobs.app.jobs import DONE, IDLE_TIME, BackgroundTask, Job
from wfsobs.app.store import Store
from wfsobs.app.work import RunResults
from wfsobs.cost import run_seconds
from wfsobs.evaluation.budget import Budget
from wfsobs.evaluation.verdict import explain_harm


class Causes(param.Parameterized):
    """The budgets of what is shown, in the mode shown, once a run is done."""

    budgets: Sequence[Budget] = param.Parameter((), doc="What is known so far.")  # type: ignore[assignment]

    def __init__(self, store: Store, display: Display):
        super().__init__()
        self.run, self.display, self.task = store.run, display, BackgroundTask(store.session)
        self._of: tuple[RunResults, str] | None = None
        self.run.param.watch(self._follow, ["state", "result"])
        display.param.watch(self._follow, "mode")
        self.task.param.watch(self._take, "result")

    def _follow(self, *_: object) -> None:
        """Begin anew with what is shown, once it is complete; of other records the sources are not known."""
        shown = self.run.result if self.run.state == DONE else None
        if shown is None or shown.is_recorded:
            self.task.close()
            self.budgets, self._of = (), None
        elif self._of is None or self._of[0] is not shown or self._of[1] != self.display.mode:
            self.budgets, self._of = (), (shown, self.display.mode)
            self.task.start(causes_job(shown, self.display.mode))

    def _take(self, *_: object) -> None:
        if self.task.result is not None and self._of is not None:
            self.budgets, self.task.result = self.task.result, None  # the next may be the same


def causes_job(results: RunResults, mode: str) -> Job:
    """Make the job that finds why observers do harm in one mode."""
    return Job(
        "causes",
        lambda watch, _tell: explain_harm(results.result, mode, watch),
        cost=run_seconds(results.scenario),
        priority=IDLE_TIME,
    )
