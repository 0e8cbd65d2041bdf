"""What the page of sweeps does: one run after the other, each a job of its own, so that whoever clicks waits for one at most."""

from __future__ import annotations

from time import monotonic

import numpy as np

from wfsobs.app.cache import key_of
from wfsobs.app.jobs.job import CANCELLED, DONE, FAILED, RUNNING, SWEEP, Job, Tell
from wfsobs.app.jobs.task import BackgroundTask
from wfsobs.app.limits import Limits
from wfsobs.app.seeds import SeedScores
from wfsobs.app.service import Session
from wfsobs.campaign.sweep import Sweep
from wfsobs.campaign.sweep_results import SweepResults, run_cell
from wfsobs.progress import Watch
from wfsobs.settings.errors import SettingError


def compute(sweep: Sweep, cell: int, number: int, limits: Limits, watch: Watch, _tell: Tell) -> SeedScores:
    """Run a cell with one seed. Raises SettingError, Cancelled."""
    limits.check(sweep.scenario(cell, number))
    scores = run_cell(sweep, cell, number, watch)
    return SeedScores(scores, np.array([s.rms for s in scores]))


class SweepTask(BackgroundTask):
    """All runs of a sweep as one task; its result grows with every run.

    A run that was done before, by anybody, comes from what the server keeps: to stop and start again goes on.
    """

    def __init__(self, session: Session):
        super().__init__(session, title="Sweep")
        self._one = BackgroundTask(session)
        self._cell, self._base_key, self._start = 0, "", 0.0
        self._one.param.watch(self._take, ["state", "place"])

    def begin(self, sweep: Sweep) -> None:
        """Run a sweep, in place of the one before."""
        self.close()
        self._base_key, self._start = key_of(sweep.base), monotonic()
        self.param.update(state=RUNNING, progress=0.0, place=0, message="", result=SweepResults(sweep))
        self._go_on()

    def close(self) -> None:
        """Leave the run under way, and hear no more of it."""
        super().close()
        self._one.close()

    @property
    def seconds_left(self) -> float:
        """Time that the rest takes at the rate so far [s]; 0 where nothing is known of it."""
        return (monotonic() - self._start) * (1.0 / self.progress - 1.0) if self.progress else 0.0

    def _go_on(self) -> None:
        results: SweepResults = self.result
        following = results.next_run()
        if following is None:
            self.param.update(state=DONE, progress=1.0)
            return
        self._cell = following[0]
        self._one.start(self._job(results.sweep, *following))

    def _job(self, sweep: Sweep, cell: int, number: int) -> Job:
        limits = self.session.service.limits
        return Job(
            "sweep",
            lambda watch, tell: compute(sweep, cell, number, limits, watch, tell),
            key=f"{number} of {sorted(sweep.cells[cell].items())} by {sweep.observers} of {self._base_key}",
            cost=sweep.seconds / sweep.n_runs,
            priority=SWEEP,
            time_limit=limits.seconds,
            refusal=SettingError,
        )

    def _take(self, *_: object) -> None:
        """Take what a run has given, and have the next one done."""
        one, results = self._one, self.result
        if self.state != RUNNING:
            return
        if one.state == RUNNING:
            self.place = one.place
        elif one.state == CANCELLED:  # the server stops
            self.cancel()
        elif one.state in (DONE, FAILED):
            done = one.state == DONE
            results = results.add(self._cell, one.result.scores) if done else results.add_failure(self._cell, one.message)
            self.param.update(result=results, progress=results.n_done / results.sweep.n_runs)
            self._go_on()
