"""What a session knows: the settings as they stand, and the one run that follows them.

A `Scenario` in the store is replaced, never changed in place, so whoever holds one holds a snapshot.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import param

from wfsobs.app.work import Report, Shown, compute
from wfsobs.cost import run_seconds
from wfsobs.presets import PRESETS
from wfsobs.scenario import Scenario
from wfsobs.settings import SettingError
from wfsobs.watch import Cancelled

log = logging.getLogger(__name__)

Compute = Callable[[Scenario, Callable[[], bool], Report], Shown]
Step = tuple[Scenario, str]
"""Settings, and the preset that they are compared with."""

Post = Callable[[Callable[[], None]], None]
"""Has a function called soon on the thread that owns the session; may itself be called from any thread."""

IDLE, RUNNING, DONE, CANCELLED, FAILED = "idle", "running", "done", "cancelled", "failed"

AT_ONCE = 5.0
"""A run that takes longer waits to be asked for [s]."""

STEPS_BACK = 100
"""Changes that can be undone."""


class Run(param.Parameterized):
    """The state machine of the one computation of a session.

    Starting a run supersedes the one before: it is told to stop, and nothing of it lands any more, however
    late it comes. What the worker reports is gathered and lands in one `param.update` on the session's thread.
    """

    state = param.Selector(default=IDLE, objects=[IDLE, RUNNING, DONE, CANCELLED, FAILED])
    progress = param.Number(0.0, bounds=(0.0, 1.0), doc="Fraction done.")
    message = param.String("", doc="Why the run failed, in one line.")
    shown = param.ClassSelector(class_=Shown, default=None, allow_None=True, doc="The latest results.")

    def __init__(self, post: Post, work: Compute = compute):
        super().__init__()
        self._post, self._compute = post, work
        self._pool = ThreadPoolExecutor(2, thread_name_prefix="wfsobs-run")
        self._lock = threading.Lock()
        self._generation = 0
        self._cancel = threading.Event()
        self._news: dict[str, Any] = {}
        self._posted = False

    def start(self, scenario: Scenario) -> None:
        """Run a scenario, in place of whatever is running."""
        generation, cancel = self._supersede()
        self.param.update(state=RUNNING, progress=0.0, message="")
        self._pool.submit(self._work, scenario, generation, cancel)

    def cancel(self) -> None:
        """Stop; what has been delivered stays."""
        if self.state == RUNNING:
            self._supersede()
            self.param.update(state=CANCELLED)

    def aside(self, function: Callable[[], None]) -> None:
        """Have something done in a thread, beside the run."""
        self._pool.submit(function)

    def post(self, function: Callable[[], None]) -> None:
        """Have something done on the session's thread; may be called from any."""
        self._post(function)

    def close(self) -> None:
        """Stop and let the threads go: the session has ended."""
        self._supersede()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _supersede(self) -> tuple[int, threading.Event]:
        with self._lock:
            self._cancel.set()
            self._cancel = threading.Event()
            self._generation += 1
            self._news = {}
            return self._generation, self._cancel

    def _work(self, scenario: Scenario, generation: int, cancel: threading.Event) -> None:
        """In a thread of the pool."""
        def report(fraction: float, shown: Shown | None) -> None:
            news: dict[str, Any] = {"progress": min(max(fraction, 0.0), 1.0)}
            self._tell(generation, news if shown is None else news | {"shown": shown})

        try:
            shown = self._compute(scenario, cancel.is_set, report)
        except Cancelled:
            self._tell(generation, {"state": CANCELLED})
        except SettingError as error:
            self._tell(generation, {"state": FAILED, "message": str(error)})
        except Exception as error:  # a bug, but the session goes on
            log.exception("the run failed")
            self._tell(generation, {"state": FAILED, "message": f"{type(error).__name__}: {error}"})
        else:
            self._tell(generation, {"state": DONE, "progress": 1.0, "shown": shown})

    def _tell(self, generation: int, news: dict[str, Any]) -> None:
        with self._lock:
            if generation != self._generation:
                return
            self._news |= news
            if self._posted:
                return
            self._posted = True
        self._post(self._land)

    def _land(self) -> None:
        with self._lock:
            news, self._news, self._posted = self._news, {}, False
        if news:
            self.param.update(**news)


class Store(param.Parameterized):
    """The settings of a session, what was refused of them, and their run."""

    scenario: Scenario = param.ClassSelector(class_=Scenario, doc="The settings as accepted.")  # type: ignore
    errors = param.Dict({}, doc="Dotted path of a refused setting -> why, in one line.")
    preset = param.Selector(default=next(iter(PRESETS)), objects=list(PRESETS), doc="Where the settings started.")
    stale = param.Boolean(False, doc="Whether the results shown are not those of the settings.")
    waiting = param.Number(0.0, doc="How long the run would take that waits to be asked for [s]; 0 where none does.")
    can_undo = param.Boolean(False, doc="Whether there is a change to undo.")
    can_redo = param.Boolean(False, doc="Whether there is an undone change to make again.")

    def __init__(self, post: Post, scenario: Scenario | None = None, work: Compute = compute):
        super().__init__(scenario=scenario or PRESETS[next(iter(PRESETS))]())
        self._refused: dict[str, Any] = {}
        self._past: list[Step] = []
        self._future: list[Step] = []
        self.run = Run(post, work)
        self.run.param.watch(self._compare, "shown")

    def start(self) -> None:
        """Run the settings as they stand."""
        self.waiting = 0.0
        self.run.start(self.scenario)

    def follow(self) -> None:
        """Run the settings as they stand, unless that takes long: then stop, and wait to be asked."""
        seconds = run_seconds(self.scenario)
        if seconds <= AT_ONCE:
            self.start()
        else:
            self.run.cancel()
            self.waiting = seconds

    def undo(self) -> None:
        """Take back the last change that was accepted."""
        if self._past:
            self._future.append((self.scenario, self.preset))
            self._accept(self._past.pop(), {}, step=False)

    def redo(self) -> None:
        """Make the last change again that was taken back."""
        if self._future:
            self._past.append((self.scenario, self.preset))
            self._accept(self._future.pop(), {}, step=False)

    def value(self, path: str) -> Any:
        """The accepted value of a setting, by dotted path."""
        node: Any = self.scenario
        for key in path.split("."):
            node = node[int(key)] if isinstance(node, list) else getattr(node, key)
        return node

    def change(self, path: str, value: Any) -> bool:
        """Set one setting and run; a refused value changes nothing and is noted in `errors`.

        Values refused before are tried again with it, so that settings that only go together can be given
        one by one. Returns whether the value was accepted.
        """
        waiting = {p: v for p, v in self._refused.items() if not _covers(path, p)}
        reason = ""
        for changes in ({**waiting, path: value}, {path: value}) if waiting else ({path: value},):
            try:
                fresh = self.scenario.replace(changes)
                fresh.validate()
            except SettingError as error:
                reason = str(error)
            else:
                self._accept((fresh, self.preset), {p: v for p, v in waiting.items() if p not in changes})
                return True
        self._refused = {**waiting, path: value}
        self.errors = {p: e for p, e in self.errors.items() if p in waiting} | {path: reason}
        return False

    def load(self, scenario: Scenario, preset: str | None = None) -> None:
        """Replace every setting and run. Raises SettingError where they do not go together.

        preset : the one that they are to be compared with from now on; as it was if not given
        """
        scenario.validate()
        self._accept((scenario, preset or self.preset), {})

    def choose(self, name: str) -> None:
        """Start again from a preset."""
        self.load(PRESETS[name](), name)

    def changed(self) -> list[str]:
        """Dotted paths of the settings that differ from the preset's."""
        return _paths(self.scenario.difference(PRESETS[self.preset]()))

    def close(self) -> None:
        """The session has ended."""
        self.run.close()

    def _accept(self, to: Step, refused: dict[str, Any], step: bool = True) -> None:
        """The one way in for new settings. step : whether it is a change of its own, to be undone later."""
        scenario, preset = to
        same = scenario == self.scenario
        if step and not (same and preset == self.preset):
            self._past = [*self._past, (self.scenario, self.preset)][-STEPS_BACK:]
            self._future = []
        self._refused = refused
        errors = {path: reason for path, reason in self.errors.items() if path in refused}
        self.param.update(
            scenario=self.scenario if same else scenario, errors=errors, preset=preset,
            can_undo=bool(self._past), can_redo=bool(self._future))
        if same:
            return
        self.follow()  # first, so that a warning of stale results does not come and go
        self._compare()

    def _compare(self, *_: object) -> None:
        shown = self.run.shown
        self.stale = shown is not None and shown.scenario != self.scenario


def _covers(path: str, other: str) -> bool:
    """Whether setting `path` replaces what stands at `other`."""
    return other == path or other.startswith(f"{path}.")


def _paths(tree: dict[str, Any], prefix: str = "") -> list[str]:
    """Dotted paths of the leaves of nested dictionaries."""
    out: list[str] = []
    for name, value in tree.items():
        out += _paths(value, f"{prefix}{name}.") if isinstance(value, dict) else [f"{prefix}{name}"]
    return out
