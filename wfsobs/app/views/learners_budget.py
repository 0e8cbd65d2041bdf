"""Error budgets of the observers that are not linear: by simulation, one observer after the other, when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from html import escape

import panel as pn
import panel_material_ui as pmui

from wfsobs.app.jobs import BATCH, FAILED, RUNNING, BackgroundTask, Job, Tell
from wfsobs.app.pages.parts import html
from wfsobs.app.store import Store
from wfsobs.app.work import RunResults
from wfsobs.cost import part_seconds
from wfsobs.evaluation.budget import Budget, error_budget
from wfsobs.evaluation.rows import row_label
from wfsobs.progress import Watch
from wfsobs.settings.errors import SettingError

RUNS = 16
"""How often an observer runs for a budget: on every combination of sources."""

LIGHT = 0.05
"""About how long those take whose time is not estimated [s]."""

ByObserver = dict[str, Sequence[Budget]]
"""Observer -> budgets."""


class LearnersBudget:
    """A button that starts them, one that stops them, and what has been found."""

    def __init__(self, store: Store, draw: Callable[[], None]):
        self.store, self.draw = store, draw
        self.task = BackgroundTask(store.session)
        self.by_observer: ByObserver = {}
        self._of: tuple[RunResults, str] | None = None
        self._names: Sequence[str] = ()
        self.start = pmui.Button(label="By simulation", icon="add_chart", variant="outlined", size="small", margin=(0, 8, 8, 0))
        self.stop = pmui.Button(label="Stop simulations", icon="stop", variant="text", size="small", margin=(0, 8, 8, 0))
        self.start.on_click(lambda _event: self.simulate())
        self.stop.on_click(lambda _event: self.task.cancel())
        self.line = html()
        self.task.param.watch(self._take, "latest")
        self.task.param.watch(self._say, ["state", "place", "progress", "message"])
        self._say()

    def view(self) -> pn.FlexBox:
        """Return buttons and line."""
        return pn.FlexBox(self.start, self.stop, self.line, align_items="center", sizing_mode="stretch_width", margin=0)

    def offer(self, results: RunResults, mode: str, names: Sequence[str]) -> None:
        """Offer the budgets of these observers in one mode."""
        if not self._is_of(results, mode):
            self.task.cancel()
            self.by_observer, self._of = {}, (results, mode)
        self._names = names
        self._say()

    def rest(self) -> None:
        """Offer none; what has been found stays for the same results."""
        self.task.cancel()
        self._names = ()
        self._say()

    def budgets(self, results: RunResults, mode: str) -> list[Budget]:
        """Return what has been found of these results in a mode."""
        return [one for own in self.by_observer.values() for one in own] if self._is_of(results, mode) else []

    def _is_of(self, results: RunResults, mode: str) -> bool:
        return self._of is not None and self._of[0] is results and self._of[1] == mode

    def simulate(self) -> None:
        """Have those that are not known yet computed."""
        if self._of is None or not (left := self._left):
            return
        results, mode = self._of
        seconds = self._seconds(left)
        try:
            self.store.limits.check_seconds(seconds, "error budget by simulation")
        except SettingError as error:
            self.task.refuse(str(error))
            return
        work = partial(simulate_budgets, results, mode, left, self.by_observer)
        self.task.start(Job("budget", work, cost=seconds, priority=BATCH))

    @property
    def _left(self) -> list[str]:
        return [name for name in self._names if name not in self.by_observer]

    def _seconds(self, names: Sequence[str]) -> float:
        assert self._of is not None
        each = part_seconds(self._of[0].scenario)
        return RUNS * sum(each.get(name, LIGHT) for name in names)

    def _take(self, *_: object) -> None:
        if self.task.latest is not None and self._of is not None:
            self.by_observer = self.task.latest
            self.draw()
        self._say()

    def _say(self, *_: object) -> None:
        left, busy, said = self._left, self.task.state == RUNNING, []
        self.start.visible, self.stop.visible = bool(left) and not busy, busy
        if left and not busy:
            self.start.label = f"By simulation, about {max(self._seconds(left), 1.0):.0f} s"
        if self.by_observer and self._names:
            said.append(f"By {RUNS} runs each, averaged over all orders of switching the causes on: {_labels(self.by_observer)}.")
        if left:
            said.append(f"Nonlinear observers need a simulation: {_labels(left)}.")
        if busy:
            said.append(f"{self.task.line('Simulating')}.")
        elif self.task.state == FAILED:
            said.append(self.task.message)
        self.line.object = f'<p class="text">{escape(" ".join(said))}</p>' if said else ""


def simulate_budgets(
    results: RunResults, mode: str, names: Sequence[str], before: ByObserver, watch: Watch, tell: Tell
) -> ByObserver:
    """Compute the budgets of observers in one mode, and tell all that are known whenever there is one more."""
    out = dict(before)
    for i, name in enumerate(names):
        watch.step(i / len(names))
        alone = Watch(is_cancelled=watch.is_cancelled)
        out[name] = error_budget(results.result, observers=[name], mode=mode, watch=alone)
        tell(latest=dict(out))
    return out


def _labels(names: Sequence[str] | ByObserver) -> str:
    return ", ".join(row_label(name) for name in names)
