"""A spectrum that can be taken hold of: its handles, what theory expects while one is moved, and the settings after it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from math import isfinite
from time import monotonic
from typing import Any

import numpy as np
import panel as pn
import param
from bokeh.plotting import figure

from wfsobs.app.component import Component
from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.handles import PEAK, Handle, changes_of, handles_of, has_peaks, highest_frequency, with_new_peak, without_peak
from wfsobs.app.numerals import number
from wfsobs.app.store import Store
from wfsobs.app.style import asset, look, observers_of
from wfsobs.app.views.frames import Frames
from wfsobs.app.views.plots import ExtraLines
from wfsobs.app.views.settle import AFTERWARDS_MS, once
from wfsobs.evaluation.error_spectra import cumulative_rms
from wfsobs.evaluation.linear_response import SETTLED
from wfsobs.evaluation.scores import BOUND
from wfsobs.evaluation.theory import TRUTH, Prediction, Theory, is_predicted
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import VIBRATION
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError
from wfsobs.typing import Array

CAPTION = "Predicted rms error"

DRAGGED, LOOSE, ROUGH = 65_536, 0.001, 0.01
"""The most frequencies to predict with while a handle is on its way, and what may be left at the end of a response: numbers are
within 1 % of those once it is let go, in a fraction of the time, and a change of less is none."""

FRAME = 0.05
"""Time after which a frame of a drag begins no more observers [s]: those that are left come first in the next one."""


class HandleLayer(Component):
    """The handles in the browser, and the numbers below the figure. All that it shows is one frame, made here."""

    figure = param.String("", doc="Name of the figure that the handles lie over.")
    frame = param.Dict({}, doc="What is shown: handles, numbers, a note, and the number of the message that is answered.")

    _esm = asset("handles.js")
    _stylesheets = [asset("handles.css")]


class SpectrumEditor:
    """One figure's."""

    def __init__(self, target: str, fig: figure, store: Store, display: Display, frames: Frames, theory: Theory):
        self.target, self.store, self.display, self.frames, self.theory = target, store, display, frames, theory
        self.figure = fig
        self.trial, self._last = store.scenario, list[Prediction]()
        self.layer = HandleLayer(
            self.hear, figure=str(fig.name), frame=self._frame(), sizing_mode="stretch_width", margin=0, visible=False
        )
        self.lines = ExtraLines(fig, "predicted", line_alpha=1.0, line_width=1.6, line_dash=[2, 2], level="glyph")
        self._number, self._moves, self._rests = 0, False, False
        self._left, self._shown_trial = list[str](), self.trial  # observers whose last numbers are of settings before these
        self._go_on = once(self._ask_for_those_left, AFTERWARDS_MS)
        self._was: dict[str, float] = {}
        store.param.watch(self._follow, "scenario")
        display.param.watch(self._ask, ["mode", "unit", "spectrum", "show", "hidden_lines", "dark"])
        display.param.watch(self._turn, "editing")
        self._turn()

    def turn_to(self, target: str | None) -> None:
        """Have the handles of another target, where the figure shows another one; none for None."""
        rests = target is None
        if rests != self._rests or (target is not None and target != self.target):
            self.target, self._rests, self._last = target or self.target, rests, []
            self._follow()
            self._turn()

    @property
    def is_on(self) -> bool:
        """Whether there is something to take hold of."""
        return self.display.editing and not self._rests

    # ------------------------------------------------------------------ what comes in

    def hear(self, message: Mapping[str, Any]) -> None:
        """Take a wish of the browser: a handle on its way, let go or given up, a peak to add or to remove."""
        self._number, self._moves = int(message.get("number", 0)), message.get("action") == "drag"
        base, note = self.store.scenario, ""
        try:
            changes = self._changes(base, message)
            trial = base.replace(changes) if changes else base
            self.store.validate(trial)
            self.trial = trial
            if changes and message.get("action") != "drag":
                self.store.replace(changes)
        except (SettingError, ValueError, TypeError) as error:
            note = str(error)
            if message.get("action") != "drag":
                self.trial = base
        self._ask(note=note)

    def _changes(self, base: Scenario, message: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings that a message is about; none for one that gives up. Raises SettingError, ValueError."""
        action, mode = message.get("action"), self.display.column
        if action in ("drag", "release"):
            handle = self._handle(base, message)
            frequency, strength, damping = (positive(message[name]) for name in ("frequency", "strength", "damping"))
            return changes_of(base, self.target, mode, handle.at(frequency, strength, damping))
        if action == "add":
            height = message.get("height")
            own = None if height is None or self.display.cumulative else positive(height) / self._scale(base) ** 2
            return with_new_peak(base, mode, positive(message["frequency"]), own)
        if action == "remove":
            return without_peak(base, self._handle(base, message).index)
        return {}

    def _handle(self, scenario: Scenario, message: Mapping[str, Any]) -> Handle:
        found = [h for h in handles_of(scenario, self.target, self.display.column) if h.id == message.get("id")]
        if not found:
            raise SettingError("this handle is no longer there")
        return found[0]

    def _follow(self, *_: object) -> None:
        """Take over settings that have changed, here or elsewhere."""
        self.trial, self._was, self._moves = self.store.scenario, {}, False
        self._ask()

    def _turn(self, *_: object) -> None:
        self.layer.visible = self.is_on
        if self.is_on:
            self.trial = self.store.scenario
            self._ask()
        else:
            self.lines.draw({}, self.display.dark)

    # ------------------------------------------------------------------ what goes out

    def _ask(self, *_: object, note: str = "") -> None:
        """Have theory say what it expects of the settings as they would be."""
        if not self.is_on or self.display.column >= len(self.trial.modes):
            return
        if note:
            self._show(note)
            return
        hidden = self.display.hidden_lines.get(self.target, [])
        shown = [*(name for name in observers_of(self.target) if name not in hidden), BOUND]
        names = sorted(shown, key=lambda name: name not in self._left)
        trial, mode, of_error = self.trial, self.display.column, self.display.error
        most, left = (DRAGGED, LOOSE) if self._moves else (None, SETTLED)

        def predict() -> list[Prediction]:
            self.theory.most, self.theory.left = most, left
            until = np.inf if most is None else monotonic() + FRAME
            return self.theory.predict(trial, mode, self.target, names, of_error, until)

        self.frames.ask(self.target, predict, partial(self._land, trial, self._number, shown))

    def _ask_for_those_left(self) -> None:
        if self._left:
            self._ask()

    def _land(self, trial: Scenario, reply_to: int, names: list[str], predictions: list[Prediction] | None, why: str) -> None:
        if not self.is_on:
            return
        now, before = ({p.observer: p for p in part} for part in (predictions or [], self._last))
        owed = self._left if trial is self._shown_trial else names
        self._left = [name for name in owed if now and name not in now and is_predicted(OBSERVERS.get(name), self.target)]
        self._shown_trial = trial
        self._last = predictions = [p for name, p in (before | now).items() if now and name in (TRUTH, *names)]
        if self._left:
            self._go_on()
        if trial == self.store.scenario and not self._left:
            self._was = {p.observer: p.rms for p in predictions}
        with pn.io.hold():
            self.lines.draw({p.observer: self._curve(p) for p in predictions}, self.display.dark)
            self._show(why, reply_to)

    def _show(self, note: str, reply_to: int | None = None) -> None:
        self.layer.frame = self._frame(note, self._number if reply_to is None else reply_to)

    def _frame(self, note: str = "", reply_to: int = 0) -> dict[str, Any]:
        """Describe all that is shown."""
        found, of = self._last, {p.observer: p for p in self._last}
        frame: dict[str, Any] = {
            "handles": [self._entry(handle, found) for handle in handles_of(self.trial, self.target, self.display.column)],
            "numbers": [self._number_of(of[name]) for name in (*OBSERVERS, BOUND) if name in of],
            "note": note,
            "answered": reply_to,
            "exponent": 1.0 if self.display.cumulative else 0.5,
            "limits": [0.01, 0.5 / self.trial.dt],
        }
        if self.target == VIBRATION:
            none = f"With Source {self.trial.vibration.source} there are no peaks to move"
            frame |= {"add": "" if has_peaks(self.trial) else none, "added": f"{PEAK}-{len(self.trial.vibration.peaks) - 1}"}
        return frame

    def _entry(self, handle: Handle, predictions: list[Prediction]) -> dict[str, Any]:
        truth = next((self._curve(p) for p in predictions if p.observer == TRUTH), None)
        return {
            "id": handle.id,
            "kind": handle.kind,
            "label": handle.label,
            "text": handle.text,
            "frequency": handle.frequency,
            "highest": highest_frequency(self.trial, handle.kind),
            "y": None if truth is None else float(np.interp(handle.frequency, *truth)),
            "strength": handle.rms is not None,
            "damping": handle.damping is not None,
        }

    def _number_of(self, p: Prediction) -> dict[str, Any]:
        scale, it, was = self._scale(self.trial), look(p.observer), self._was.get(p.observer, p.rms)
        return {
            "name": p.observer,
            "label": it.label,
            "colour": it.colour(self.display.dark),
            "value": number(p.rms * scale),
            "was": "" if abs(p.rms - was) <= ROUGH * was else number(was * scale),
            "unit": self.display.unit_label,
            "waits": p.observer in self._left,
        }

    def _scale(self, scenario: Scenario) -> float:
        return per_micrometre(self.display.unit, scenario.telescope.diameter)

    def _curve(self, p: Prediction) -> tuple[Array, Array]:
        """Return what is drawn: frequencies and densities above zero frequency, or the rms from each on."""
        scale, frequency = self._scale(self.trial), p.frequency[1:]
        density = p.density[1:]
        return frequency, scale * cumulative_rms(frequency, density) if self.display.cumulative else scale**2 * density


def positive(x: object) -> float:
    """Return a number of a message. Raises ValueError where it is none above 0."""
    if isinstance(x, (int, float)) and isfinite(x) and x > 0:
        return float(x)
    raise ValueError("a handle can be moved to positive numbers only")
