"""What a session knows: the settings as they stand, what they run on, and the one run that follows them.

A `Scenario` in the store is replaced, never changed in place, so whoever holds one holds a snapshot.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import panel as pn
import param
from param.parameterized import batch_call_watchers

from wfsobs.app.jobs import DONE
from wfsobs.app.service import IDLE, BackgroundTask, Post, Session
from wfsobs.app.sources import (
    LoadedRecord,
    NamedRecord,
    SimulatedRecord,
    Source,
    Step,
    fit_to_record,
    give_same_record,
    record_key,
)
from wfsobs.cost import rerun_seconds, run_seconds
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import changed_settings, reference_preset
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.values import SettingError
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import Preview

AFTER_FIT = ("telescope.radial_order", "run.warm_up")
"""Settings that follow a record, and may be changed afterwards."""


AT_ONCE = 5.0
"""A run that takes longer waits to be asked for [s]."""

FIRST_PRESET = next(iter(PRESETS))
"""The preset to start from."""

STEPS_BACK = 100
"""Changes that can be undone."""


class Store(param.Parameterized):
    """The settings of a session, what was refused of them, and their run."""

    scenario: param.Parameter[Scenario] = param.Parameter(doc="The settings as accepted.")
    errors: param.Parameter[dict[str, str]] = param.Parameter({}, doc="Dotted path of a refused setting -> why, in one line.")
    preset: param.Selector[str] = param.Selector(default=FIRST_PRESET, objects=list(PRESETS), doc="Where the settings started.")
    source: param.Parameter[Source | None] = param.Parameter(
        None, doc="What the observers run on; None for the simulation of the settings."
    )
    wanted_record: param.Parameter[NamedRecord | None] = param.Parameter(
        None, doc="The record of the link that was opened, until its file is given."
    )
    stale: param.Boolean[bool] = param.Boolean(False, doc="Whether the results shown are not those of the settings.")
    waiting: param.Number[float] = param.Number(
        0.0, doc="How long the run would take that waits to be asked for [s]; 0 where none does."
    )
    can_undo: param.Boolean[bool] = param.Boolean(False, doc="Whether there is a change to undo.")
    can_redo: param.Boolean[bool] = param.Boolean(False, doc="Whether there is an undone change to make again.")

    def __init__(self, post: Post, session: Session, scenario: Scenario | None = None):
        live = session.service.live  # whoever changes a setting of the loop that all watch, changes that one alone
        if live is not None and scenario is None:
            super().__init__(scenario=live.scenario, preset=live.preset or FIRST_PRESET)
        else:
            super().__init__(scenario=scenario or PRESETS[FIRST_PRESET]())
        self.session = session
        self.limits: Final = session.service.limits
        session.post = post
        self._refusals: dict[str, Any] = {}
        self._past: list[Step] = []
        self._future: list[Step] = []
        self._own: dict[str, Any] = {}  # settings that a loaded record has replaced
        self.run: Final = BackgroundTask(session, drawn_first=True)
        self.rests: bool = False
        """Whether runs wait until a page needs one."""
        self.run.param.watch(self._compare, "result")

    def start(self, seconds: float | None = None) -> None:
        """Run the settings as they stand. seconds : about how long that takes, where it is known."""
        self.waiting, seconds = 0.0, self.seconds if seconds is None else seconds
        self.run.attempt(lambda: self.run.start(self.session.service.run(self.scenario, self.source, seconds)))

    def follow(self) -> None:
        """Run the settings as they stand, unless that takes long: then stop, and wait to be asked; not at all while it rests."""
        if self.rests:
            return
        seconds = self.seconds
        if seconds <= AT_ONCE or self.session.service.is_cached(self.scenario, self.source):
            self.start(seconds)
        else:
            self.run.cancel()
            self.waiting = seconds

    def wake(self) -> None:
        """Rest no more: run what nobody has asked for yet."""
        self.rests = False
        if self.run.state == IDLE:
            self.follow()

    @property
    def seconds(self) -> float:
        """About how long the run of the settings takes, without what is known from the results shown [s]."""
        shown = self.run.result
        if shown is None or self.run.state != DONE or not give_same_record(shown.source, self.source):
            return run_seconds(self.scenario)
        return rerun_seconds(shown.scenario, self.scenario)

    def undo(self) -> None:
        """Take back the last change that was accepted."""
        self._go(self._past, self._future)

    def redo(self) -> None:
        """Make the last change again that was taken back."""
        self._go(self._future, self._past)

    def _go(self, there: list[Step], back: list[Step]) -> None:
        if there:
            back.append(self.step)
            self._accept(there.pop(), {}, step=False)

    def value(self, path: str) -> Any:
        """Look up the accepted value of a setting, by dotted path."""
        return self.scenario.lookup(path)

    def change(self, path: str, value: Any) -> bool:
        """Set one setting and run; a refused value changes nothing and is noted in `errors`.

        Values refused before are tried again with it, so that settings that only go together can be given
        one by one. Returns whether the value was accepted.
        """
        waiting = {p: v for p, v in self._refusals.items() if not f"{p}.".startswith(f"{path}.")}  # without what it replaces
        reason = ""
        for changes in ({**waiting, path: value}, {path: value}) if waiting else ({path: value},):
            try:
                fresh = self.scenario.replace(changes)
                self.validate(fresh)
            except SettingError as error:
                reason = str(error)
            else:
                self._accept((fresh, self.preset, self.source), {p: v for p, v in waiting.items() if p not in changes})
                return True
        self._refusals = {**waiting, path: value}
        self.errors = {p: e for p, e in self.errors.items() if p in waiting} | {path: reason}
        return False

    def validate(self, scenario: Scenario) -> None:
        """Raise SettingError where settings do not go together, or are more than is allowed here."""
        scenario.validate()
        self.limits.check(scenario)

    def load(self, scenario: Scenario, preset: str | None = None, simulation: SimulatedRecord | None = None) -> None:
        """Replace every setting and run; a loaded record stays, with its rate, ratio and length. Raises SettingError.

        preset : the one that they are to be compared with from now on; as it was if not given
        """
        if not isinstance(source := self.source, LoadedRecord):
            self.restore((scenario, preset or self.preset, simulation))
            return
        fitted = fit_to_record(source.record, scenario)
        if fitted.run.duration == scenario.run.duration:  # settings that were made for it
            fitted = fitted.replace({path: scenario.lookup(path) for path in AFTER_FIT})
        self.restore((fitted, preset or self.preset, source))
        self._own = changed_settings(scenario, fitted)

    def replace(self, changes: Mapping[str, Any]) -> None:
        """Set several settings (dotted path -> value) in one step and run. Raises SettingError."""
        self.run_on(self.source, self.scenario.replace(changes))

    def run_on(self, source: Source | None, scenario: Scenario) -> None:
        """Run on a record, or on the simulation of the settings (None), and take the settings with it. Raises SettingError."""
        self.restore((scenario, self.preset, source))

    def restore(self, step: Step) -> None:
        """Return to settings, their preset and their record in one step. Raises SettingError."""
        scenario, _, source = step
        self.validate(scenario)
        if source is not None:
            source.check(self.limits)
        self._accept(step, {})

    def take_record(self, preview: Preview, declaration: DeclaredFormat, sha256: str) -> None:
        """Run on a record; the settings of rate, ratio and length follow it, but to the ones of a link. Raises SettingError."""
        before, wanted = self.scenario, self.wanted_record
        scenario = fit_to_record(preview.record, before)
        if wanted is not None and wanted.sha256 == sha256:
            scenario = scenario.replace({path: before.lookup(path) for path in AFTER_FIT})
        key, line = record_key(preview.record), preview.lines()[0]
        self.run_on(LoadedRecord(preview.record, preview.name, key, line, declaration, sha256), scenario)

    def simulate(self) -> None:
        """Go back to the simulation: of settings that were kept, or of these with its own rate, ratio and length."""
        self.wanted_record = None
        if (source := self.source) is None:
            return
        scenario = source.simulation or self.scenario
        try:
            self.run_on(None, scenario.replace(self._own if isinstance(source, LoadedRecord) else {}))
        except SettingError:  # they do not go with what was changed since
            self.run_on(None, scenario)

    def choose(self, name: str) -> None:
        """Start again from a preset."""
        self.load(PRESETS[name](), name)

    def changed_paths(self) -> list[str]:
        """Dotted paths of the settings that differ from the preset's."""
        return [*changed_settings(self.scenario, reference_preset(self.preset))]

    @property
    def step(self) -> Step:
        """Settings, preset and record as they stand."""
        return self.scenario, self.preset, self.source

    def _accept(self, to: Step, refusals: dict[str, Any], step: bool = True) -> None:
        """Accept new settings, the one way in. step : whether it is a change of its own, to be undone later."""
        scenario, preset, source = to
        unchanged, stays = scenario == self.scenario, give_same_record(source, self.source)
        if step and not (unchanged and stays and preset == self.preset):
            self._past = _of_one_file([*self._past, self.step], source)[-STEPS_BACK:]
            self._future = []
        if isinstance(source, LoadedRecord) and not isinstance(self.source, LoadedRecord):
            self._own = changed_settings(self.scenario, fit_to_record(source.record, self.scenario))
        self._refusals = refusals
        errors = {path: reason for path, reason in self.errors.items() if path in refusals}
        with pn.io.hold(), batch_call_watchers(self):  # one message to the browser
            self.param.update(
                scenario=self.scenario if unchanged else scenario,
                source=self.source if stays else source,
                wanted_record=None if isinstance(source, LoadedRecord) else self.wanted_record,
                errors=errors,
                preset=preset,
                can_undo=bool(self._past),
                can_redo=bool(self._future),
            )
            if not (unchanged and stays):
                # First: it goes on while the page is told, and a warning of stale results does not come and go.
                self.follow()
                self._compare()

    def _compare(self, *_: object) -> None:
        shown = self.run.result
        self.stale = shown is not None and (shown.scenario != self.scenario or not give_same_record(shown.source, self.source))


def _of_one_file(steps: list[Step], source: Source | None) -> list[Step]:
    """Without those on another file than the one that is loaded: a session holds one."""
    if not isinstance(source, LoadedRecord):
        return steps
    return [step for step in steps if not isinstance(step[2], LoadedRecord) or give_same_record(step[2], source)]
