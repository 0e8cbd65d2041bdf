"""Error against time as rows for machines and as tables for people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from math import inf

import numpy as np
from rich.table import Table

from wfsobs.evaluation.recovery import PooledRms, Recovery, recovery, running_rms
from wfsobs.evaluation.result import Result
from wfsobs.evaluation.rows import Row, row_label
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError

MOST_TIMES = 8
"""Columns of times in a table."""


class OverTime:
    """Error against time of runs of one scenario that differ in their seeds.

    window : of the running rms [s];  rows : of every run, at the end of every window, the keys of `wfsobs run --over-time --json`
    """

    scenario: Scenario
    window: float

    def __init__(self, scenario: Scenario, window: float):
        if not scenario.dt <= window < scenario.run.duration:
            raise SettingError(
                f"--over-time {window:g}: takes a number of seconds from {scenario.dt:g}, one step, to below "
                f"run.duration = {scenario.run.duration:g}"
            )
        self.scenario, self.window = scenario, window
        self.rows: list[Row] = []
        self._pools: dict[tuple[str, str], PooledRms] = {}

    def add(self, result: Result, seed: int) -> None:
        """One more run."""
        every = max(round(self.window / result.record.dt), 1)
        for e in result.estimates:
            running = running_rms(result.record, e, self.window)
            self._pools.setdefault((e.observer, e.target), PooledRms()).add(running)
            for mode, column in zip(self.scenario.modes, running[every - 1 :: every].T, strict=False):
                self.rows += [
                    {
                        "observer": e.observer,
                        "target": e.target,
                        "mode": mode.name,
                        "time_s": round((i + 1) * every * result.record.dt, 9),
                        "rms_um": None if np.isnan(value) else float(value),
                        "seed": seed,
                    }
                    for i, value in enumerate(column)
                ]

    def table(self) -> Table:
        """Return the table of recoveries after events; without events, the error at some times."""
        return self._recoveries() if self.scenario.events else self._times()

    def _series(self) -> list[tuple[str, str, str, np.ndarray]]:
        """(target, mode, observer, pooled running rms (n_steps,)) in the order of targets and modes."""
        found = [
            (target, i, observer, pool.rms[:, i])
            for (observer, target), pool in self._pools.items()
            for i in range(pool.rms.shape[1])
        ]
        modes = self.scenario.modes
        return [(target, modes[i].name, observer, x) for target, i, observer, x in sorted(found, key=lambda f: f[:2])]

    def _title(self, text: str) -> str:
        seeds = len({r["seed"] for r in self.rows})
        return f"{text}, rms over {self.window:g} s" + (f", {seeds} seeds together" if seeds > 1 else "")

    def recoveries(self) -> Iterator[tuple[str, str, str, str, Recovery | None]]:
        """(target, mode, event, observer, what it did), of every event who is back first."""
        events, run = self.scenario.events, self.scenario.run
        starts = sorted({event.start for event in events})
        names = [", ".join(dict.fromkeys(e.kind for e in events if e.start == start)) + f" at {start:g} s" for start in starts]
        for (target, mode), group in groupby(self._series(), key=lambda s: s[:2]):
            known = {name: recovery(x, self.scenario.dt, starts, self.window, run.warm_up) for _, _, name, x in group}
            for i, event in enumerate(names):
                for name in sorted(known, key=lambda name: _rank(known[name][i])):
                    yield target, mode, event, name, known[name][i]

    def _recoveries(self) -> Table:
        """One row per event and observer."""
        table = Table(title=self._title("Error before and after every event"))
        for name in ("Target", "Mode", "Event", "Observer"):
            table.add_column(name, no_wrap=True)
        for name in ("before, nm", "worst after, nm", "at the end, nm", "recovery time, s"):
            table.add_column(name, justify="right", no_wrap=True)
        for _, lines in groupby(self.recoveries(), key=lambda line: line[:3]):
            for target, mode, event, name, r in lines:
                table.add_row(target, mode, event, row_label(name), *recovery_texts(r))
            table.add_section()
        return table

    def _times(self) -> Table:
        """One row per observer, one column per time."""
        table = Table(title=self._title("Error, nm"))
        for name in ("Target", "Mode", "Observer"):
            table.add_column(name, no_wrap=True)
        ends = _spread(round(self.scenario.run.duration / self.window + 1e-9))
        for end in ends:
            table.add_column(f"{end * self.window:g} s", justify="right", no_wrap=True)
        every = max(round(self.window / self.scenario.dt), 1)
        for _, group in groupby(self._series(), key=lambda s: s[:2]):
            for target, mode, observer, x in group:
                values = [x[min(end * every, x.size) - 1] for end in ends]
                table.add_row(target, mode, row_label(observer), *("-" if np.isnan(v) else f"{v * 1e3:.2f}" for v in values))
            table.add_section()
        return table


def recovery_texts(r: Recovery | None) -> tuple[str, str, str, str]:
    """Error before, at its worst and at the end [nm], and the recovery time [s], as texts."""
    if r is None:
        return "-", "-", "-", "-"
    before, worst, last = (f"{value * 1e3:.2f}" for value in (r.before, r.worst, r.last))
    return before, worst, last, "never" if r.back is None else f"{r.back:.2f}"


def _rank(r: Recovery | None) -> tuple[float, float]:
    """Sort by the recovery time, then by the error."""
    return (inf, inf) if r is None else (inf if r.back is None else r.back, r.worst)


def _spread(n: int) -> Sequence[int]:
    """Up to MOST_TIMES of 1 ... n, evenly, the last one among them."""
    return sorted({round(float(v)) for v in np.linspace(1, n, min(n, MOST_TIMES))})
