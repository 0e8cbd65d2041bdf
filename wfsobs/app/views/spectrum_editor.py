"""A spectrum that can be taken hold of: its handles, what theory expects while one is moved, and the settings after it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite, pi
from time import monotonic
from typing import Any, Final

import numpy as np
import panel as pn
import param
from bokeh.plotting import figure

from wfsobs.app.display import Display
from wfsobs.app.jobs import CANCELLED, CLICK, DONE, FAILED, Job
from wfsobs.app.render import number, render
from wfsobs.app.service import Session
from wfsobs.app.store import Store
from wfsobs.app.style import HtmlComponent, look, observers_of, script, sheets
from wfsobs.app.views.plots import AFTERWARDS_MS, ExtraLines, Points, once
from wfsobs.evaluation.exact_errors import SETTLED, TRUTH, Prediction, Theory, is_predicted
from wfsobs.evaluation.scores import BOUND
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TURBULENCE, VIBRATION
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.atmosphere import Peak
from wfsobs.settings.values import SettingError
from wfsobs.simulation.disturbance import turbulence_process

Work = Callable[[], Any]
Land = Callable[[Any, str], None]
"""Told what the work gave, None where it gave nothing, and why it did not."""


class Frames:
    """The answers of one session. One thread works on them at a time, so that they may share what they keep."""

    def __init__(self, session: Session):
        self.session = session
        self._next: dict[str, tuple[Work, Land]] = {}
        self._busy = False

    def ask(self, name: str, work: Work, land: Land) -> None:
        """Have something computed for a figure, in place of what it still waits for; the work raises ValueError with a reason."""
        self._next[name] = work, land
        self._go()

    def _go(self) -> None:
        if self._busy or not self._next:
            return
        self._busy = True
        work, land = self._next.pop(next(iter(self._next)))
        job = Job("prediction", lambda _watch, _tell: work(), priority=CLICK, quiet=True)
        self.session.submit(job, partial(self._hear, land))

    def _hear(self, land: Land, news: Mapping[str, Any]) -> None:
        """In any thread."""
        if news.get("state") in (DONE, FAILED, CANCELLED):
            self.session.post(partial(self._land, land, news))

    def _land(self, land: Land, news: Mapping[str, Any]) -> None:
        self._busy = False
        land(news.get("result"), news.get("message", ""))
        self._go()


PEAK, MODEL, BAND, CORNER, PROCESS = "peak", "model", "band", "corner", "process"
"""Kinds of handles."""

FAINTEST = 1e-4
"""Strength from which a peak grows that has none in a mode [um]."""

NEW_DAMPING, NEW_RMS = 0.01, 5e-3
"""Damping of a peak that is added, and its rms [um]."""


@dataclass(frozen=True)
class Handle:
    """Something to take hold of.

    Attributes
    ----------
    kind : str
        PEAK, MODEL, BAND, CORNER or PROCESS.
    index : int
        Which of its list.
    label : str
        What it is called.
    frequency : float
        Where it is [Hz].
    rms : float or None
        Strength in the mode [um]; None where it has none to change.
    damping : float or None
        Damping; None where it has none to change.
    """

    kind: str
    index: int
    label: str
    frequency: float
    rms: float | None = None
    damping: float | None = None

    @property
    def id(self) -> str:
        """Name in messages."""
        return f"{self.kind}-{self.index}"

    @property
    def text(self) -> str:
        """Its values, for people."""
        strength = "" if self.rms is None else f", {number(1e3 * self.rms)} nm rms"
        return f"{self.frequency:.4g} Hz{strength}" + ("" if self.damping is None else f", damping {self.damping:.3g}")

    def at(self, frequency: float | None = None, strength: float = 1.0, damping: float = 1.0) -> Handle:
        """Return it at another frequency [Hz], its rms and its damping times a factor; what it does not have stays."""
        rms, own = self.rms, self.damping
        return replace(
            self,
            frequency=self.frequency if frequency in (None, self.frequency) else round_off(frequency),
            rms=rms if rms is None or strength == 1.0 else round_off(strength * max(rms, FAINTEST)),
            damping=own if own is None or damping == 1.0 else min(round_off(max(own, 1e-4) * damping), 1.0),
        )


def round_off(x: float) -> float:
    """Return a number with the four digits that a hand can set.

    >>> round_off(28.60612)
    28.61
    """
    return float(f"{x:.4g}")


def handles_of(scenario: Scenario, target: str, mode: int) -> list[Handle]:
    """List the handles of the spectrum of a target, in one mode."""
    return list((_turbulence if target == TURBULENCE else _vibration)(scenario, mode))


def highest_frequency(scenario: Scenario, kind: str) -> float:
    """Return how far a handle of a kind can be moved [Hz]: a peak to the cut-off, above which there is no vibration."""
    nyquist = 0.5 / scenario.dt
    cut_off = kind == PEAK and scenario.vibration.source == "peaks"
    return min(scenario.vibration.cutoff, nyquist) if cut_off else nyquist


def has_peaks(scenario: Scenario) -> bool:
    """Return whether the vibration is made of peaks, so that one can be added."""
    return scenario.vibration.source in ("peaks", "ar2")


def _vibration(s: Scenario, mode: int) -> Iterator[Handle]:
    if has_peaks(s):
        for i, peak in enumerate(s.vibration.peaks):
            rms = peak.rms[mode] if mode < len(peak.rms) else None
            yield Handle(PEAK, i, f"Peak {i + 1}", peak.frequency, rms, peak.damping)
    if s.kalman.peak == "manual":
        rms = s.kalman.vibration_rms if s.kalman.process_noise == "manual" and s.modes[mode].radial_order == 1 else None
        yield Handle(MODEL, 0, "Peak of the Kalman filters", s.kalman.frequency, rms, s.kalman.damping)
    for i, frequency in enumerate(s.butterworth.frequencies):
        yield Handle(BAND, i, f"Band {i + 1}", frequency)


def _turbulence(s: Scenario, mode: int) -> Iterator[Handle]:
    t = s.turbulence
    if t.source == "processes":
        for i, p in enumerate(t.processes):
            yield Handle(PROCESS, i, f"Process {i + 1}", p.frequency, p.rms[mode] if mode < len(p.rms) else None, p.damping)
    elif t.source in ("ar2", "ar3", "frozen-flow"):
        corner = turbulence_process(s, mode, s.dt).omega / (2.0 * pi)
        yield Handle(CORNER, 0, "Corner of the turbulence", corner, None if t.source == "frozen-flow" else t.rms)


def find_handle(scenario: Scenario, target: str, mode: int, name: object) -> Handle:
    """Find a handle by its name in messages. Raises SettingError where there is no such handle."""
    for handle in handles_of(scenario, target, mode):
        if handle.id == name:
            return handle
    raise SettingError("this handle is no longer there")


def changes_of(scenario: Scenario, target: str, mode: int, to: Handle) -> dict[str, Any]:
    """Return the settings, dotted path -> value, that bring the handle of the same name to where `to` is.

    Raises SettingError where there is no such handle.
    """
    now = find_handle(scenario, target, mode, to.id)
    if to.kind == BAND:
        bands = [*scenario.butterworth.frequencies]
        bands[to.index] = to.frequency
        return {"butterworth.frequencies": bands}
    if to.kind == CORNER:  # a corner goes with the wind
        t = scenario.turbulence
        wind = t.wind_speed if to.frequency == now.frequency else round_off(t.wind_speed * to.frequency / now.frequency)
        values: dict[str, Any] = {"turbulence.wind_speed": wind, "turbulence.rms": to.rms}
    elif to.kind == MODEL:
        values = {"kalman.frequency": to.frequency, "kalman.damping": to.damping, "kalman.vibration_rms": to.rms}
    else:
        where = f"vibration.peaks.{to.index}" if to.kind == PEAK else f"turbulence.processes.{to.index}"
        values = {f"{where}.frequency": to.frequency, f"{where}.damping": to.damping}
        if to.rms is not None:
            values[f"{where}.rms"] = rms = [*scenario.lookup(where).rms]
            rms[mode] = to.rms
    return {path: v for path, v in values.items() if v is not None}


def with_new_peak(scenario: Scenario, mode: int, frequency: float) -> dict[str, Any]:
    """Return the settings with one more peak.

    Raises SettingError where there are no peaks, and above the highest frequency of one.
    """
    if not has_peaks(scenario):
        raise SettingError(f"vibration.source = {scenario.vibration.source} has no peaks of its own: set it to peaks")
    if frequency > (highest := highest_frequency(scenario, PEAK)):
        raise SettingError(f"no peak above the cut-off of the vibration, {highest:g} Hz")
    strengths = [0.0] * max(mode + 1, 2)
    strengths[mode] = NEW_RMS
    peak = Peak.from_dict({"frequency": round_off(frequency), "damping": NEW_DAMPING, "rms": strengths})
    return {"vibration.peaks": [*(p.to_dict() for p in scenario.vibration.peaks), peak.to_dict()]}


def without_peak(scenario: Scenario, index: int) -> dict[str, Any]:
    """Return the settings without one of the peaks."""
    return {"vibration.peaks": [p.to_dict() for i, p in enumerate(scenario.vibration.peaks) if i != index]}


DRAGGED, LOOSE, ROUGH = 65_536, 0.001, 0.01
"""The most frequencies to predict with while a handle is on its way, and what may be left at the end of a response: numbers are
within 1 % of those once it is let go, in a fraction of the time, and a change of less is none."""

FRAME = 0.05
"""Time after which a frame of a drag begins no more observers [s]: those that are left come first in the next one."""


class HandleLayer(HtmlComponent):
    """The handles in the browser, and the numbers below the figure. All that it shows is one frame, made here."""

    figure: param.String[str] = param.String("", doc="Name of the figure that the handles lie over.")
    frame: param.Dict[dict[Any, Any]] = param.Dict(
        {}, doc="What is shown: handles, numbers, a note, and the number of the message that is answered."
    )

    _esm = script("page", "markup", "handles")
    _stylesheets = sheets("base", "handles")

    @param.depends("frame", watch=True, on_init=True)
    def _draw(self) -> None:
        self.html = render(
            "handles.html", frame={"note": "", "hint": "", "handles": [], "numbers": [], "add": None, **self.frame}
        )


class SpectrumEditor:
    """One figure's."""

    def __init__(self, target: str, fig: figure, store: Store, display: Display, frames: Frames, theory: Theory):
        self.target: str = target
        self.store = store
        self.display = display
        self.frames = frames
        self.theory = theory
        self.figure = fig
        self.trial: Scenario = store.scenario
        self._last = list[Prediction]()
        self.layer: Final = HandleLayer(
            self.hear, figure=str(fig.name), frame=self._frame(), sizing_mode="stretch_width", margin=0, visible=False
        )
        self.lines: Final = ExtraLines(fig, "predicted", line_alpha=1.0, line_width=1.6, line_dash=[2, 2], level="glyph")
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
        if action == "add":
            return with_new_peak(base, mode, positive(message["frequency"]))
        if action not in ("drag", "release", "remove"):
            return {}
        handle = find_handle(base, self.target, mode, message.get("id"))
        if action == "remove":
            return without_peak(base, handle.index)
        frequency, strength, damping = (positive(message[name]) for name in ("frequency", "strength", "damping"))
        return changes_of(base, self.target, mode, handle.at(frequency, strength, damping))

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
        scale, it, was = self.display.scale(self.trial), look(p.observer), self._was.get(p.observer, p.rms)
        return {
            "name": p.observer,
            "label": it.label,
            "colour": it.colour(self.display.dark),
            "value": number(p.rms * scale),
            "was": "" if abs(p.rms - was) <= ROUGH * was else number(was * scale),
            "unit": self.display.unit_label,
            "waits": p.observer in self._left,
        }

    def _curve(self, p: Prediction) -> Points:
        """Return what is drawn: frequencies and densities above zero frequency, or the rms from each on."""
        return p.frequency[1:], self.display.curve(p.frequency, p.density, self.trial)


def positive(x: object) -> float:
    """Return a number of a message. Raises ValueError where it is none above 0."""
    if isinstance(x, (int, float)) and isfinite(x) and x > 0:
        return float(x)
    raise ValueError("a handle can be moved to positive numbers only")
