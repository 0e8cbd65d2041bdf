"""Handles on the gain of the integrator, in the figures of its rejection and of its loop gain."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import degrees
from typing import Any, Final

import numpy as np
import panel as pn
from bokeh.plotting import figure

from wfsobs.app.display import Display
from wfsobs.app.loop_work import LoopResults
from wfsobs.app.render import number
from wfsobs.app.store import Store
from wfsobs.app.style import look
from wfsobs.app.views.plots import ExtraLines, Points
from wfsobs.app.views.spectrum_editor import Frames, HandleLayer, positive
from wfsobs.closed_loop.design import LawDesign, design_mode, nominal_loop
from wfsobs.control.laws import highest_stable_gain
from wfsobs.control.margins import Curves, curves
from wfsobs.evaluation.exact_errors import Theory
from wfsobs.priors_from.controllers import plant_of
from wfsobs.priors_from.scenario import told_spectra
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError
from wfsobs.signal.wiener import Complex
from wfsobs.simulation.true_spectra import has_known_spectra
from wfsobs.typing import Array

MOST = 0.98
"""The highest gain that a handle gives, over that at which the loop becomes unstable."""


@dataclass(frozen=True)
class GainAxis:
    """How a figure shows the gain: in a place on its horizontal axis, in the height of 0.

    gain_at : returns the gain for a place, or the highest; raises ValueError for no such place
    line    : returns what is drawn of the loop's curves
    place   : returns where the handle stands, and what it says of that
    limits  : returns the first and the last place
    """

    title: str
    gain_at: Callable[[Scenario, object], float]
    line: Callable[[Curves], Points]
    place: Callable[[Curves, LawDesign], tuple[float, str]]
    limits: Callable[[Scenario], list[float]]

    def entry(self, gain: float, at: Curves, design: LawDesign) -> dict[str, Any]:
        """Describe the handle."""
        position, said = self.place(at, design)
        text = f"gain {gain:.3g}, {said}"
        handle = {"id": "gain-0", "kind": "gain", "label": self.title, "text": text, "frequency": position, "y": 0.0}
        return {**handle, "strength": False, "damping": False}


class GainHandle:
    """The handle in one figure, and the line of the gain that it would set."""

    def __init__(self, fig: figure, axis: GainAxis, hear: Callable[[GainHandle, Mapping[str, Any]], None]):
        self.axis = axis
        self.layer: Final = HandleLayer(
            partial(hear, self), figure=str(fig.name), sizing_mode="stretch_width", margin=0, visible=False
        )
        self.lines: Final = ExtraLines(fig, "predicted", line_alpha=1.0, line_width=2.2, line_dash=[2, 2], level="glyph")
        self.number = 0


def _gain_of_crossover(scenario: Scenario, position: object) -> float:
    """Return the gain whose rejection crosses 0 dB at a frequency [Hz]; see `gain_for_crossover`."""
    mirror, leak = plant_of(scenario).mirror, scenario.control.leak
    omega = 2.0 * np.pi * positive(position) * scenario.dt
    loop = complex(mirror.response(np.array([omega]))[0] / (1.0 - leak * np.exp(-1j * omega)))
    return gain_for_crossover(loop, MOST * highest_stable_gain(mirror, leak))


def _rejection(at: Curves) -> Points:
    """Return the rejection [dB] over the frequency [Hz]."""
    return at.frequency, decibel(at.rejection)


def _crossover_of(at: Curves, _design: LawDesign) -> tuple[float, str]:
    frequency = crossover(*_rejection(at))
    return frequency, f"0 dB at {frequency:.3g} Hz"


def _gain_at_crossing(scenario: Scenario, position: object) -> float:
    """Return the gain for a crossing of the real axis at this real part: the loop gain is in proportion to it."""
    if not isinstance(position, (int, float)) or not np.isfinite(position):
        raise ValueError("a handle can be moved to numbers only")
    share = min(max(-position, 1e-3), MOST)
    return share * highest_stable_gain(plant_of(scenario).mirror, scenario.control.leak)


def _crossing_of(_at: Curves, design: LawDesign) -> tuple[float, str]:
    margin = design.margins.gain if design.margins is not None else None
    crossing = -1.0 / margin if margin else 0.0
    return crossing, f"crosses the real axis at {crossing:.3f}"


def decibel(x: Complex) -> Array:
    """Return amplitudes in dB."""
    return 20.0 * np.log10(np.maximum(np.abs(x), 1e-6))


def plane(loop_gain: Complex) -> Points:
    """Return the real and imaginary parts of a loop gain, without what is far outside of the figure."""
    near = np.where(np.abs(loop_gain) < 20.0, loop_gain, np.nan)
    return np.real(near), np.imag(near)


REJECTION = GainAxis("Integrator gain", _gain_of_crossover, _rejection, _crossover_of, lambda scenario: [0.01, 0.5 / scenario.dt])
"""Where the rejection crosses 0 dB."""

NYQUIST = GainAxis(
    "Integrator gain, Nyquist", _gain_at_crossing, lambda at: plane(at.loop_gain), _crossing_of, lambda _: [-1.0, 0.0]
)
"""Where the loop gain crosses the negative real axis, which is at -1 where the loop becomes unstable."""


def gain_for_crossover(loop: complex, most: float) -> float:
    """Return the gain for which the rejection is 1, at most `most`; loop : that of gain 1 at the frequency.

    |1 + g L|^2 = 1 + 2 g Re L + g^2 |L|^2 is 1 at g = -2 Re L / |L|^2. Beyond the frequency where Re L is 0 no gain does it.
    """
    return min(max(-2.0 * loop.real / abs(loop) ** 2, 1e-3), most) if loop.real < 0 else most


def crossover(frequency: Array, level: Array) -> float:
    """Return where a level [dB] first rises above 0, linear between points in log frequency; the last where it never does."""
    above = np.flatnonzero((level[1:] > 0.0) & (level[:-1] <= 0.0))
    if not above.size:
        return float(frequency[-1])
    i = int(above[0])
    share = -level[i] / (level[i + 1] - level[i])
    return float(np.exp(np.log(frequency[i]) + share * np.log(frequency[i + 1] / frequency[i])))


INTEGRATOR = "integrator"
HINT = "Only the integrator has a preview; the other controllers follow when the handle is let go."

Answer = tuple[float, LawDesign, Curves]
"""Gain, what theory says of the loop, and its curves."""


class GainEditor:
    """The handles, in step with the settings and the closed loop shown."""

    def __init__(
        self, rejection: figure, nyquist: figure, store: Store, display: Display, results: Callable[[], LoopResults | None]
    ):
        self.store = store
        self.display = display
        self.results = results
        self.frames: Final = Frames(store.session)
        self.theory: Final = Theory()
        self.handles: Final = GainHandle(rejection, REJECTION, self.hear), GainHandle(nyquist, NYQUIST, self.hear)
        self._note, self._trial = "", None
        store.param.watch(self._take_over, "scenario")
        display.param.watch(self.follow, ["editing", "mode", "unit", "dark"])
        self.follow()

    @property
    def gain(self) -> float | None:
        """The gain of the integrator in the mode shown: that of the settings, or the best one where that is known."""
        if self.store.scenario.control.integrator == "manual":
            return self.store.scenario.control.gain
        shown = self.results()
        laws = shown.result.design.laws.get(INTEGRATOR, ()) if shown else ()
        law = laws[self.display.column].law if self.display.column < len(laws) else None
        return law.gain if law else None

    def _take_over(self, *_: object) -> None:
        """Show the gain of settings that have changed, here or elsewhere."""
        self._trial = None
        self.follow()

    def follow(self, *_: object) -> None:
        """Show the gain as it is; while a handle is on its way that of the handle, whatever comes in."""
        for handle in self.handles:
            handle.layer.visible = self.display.editing
            if not self.display.editing:
                handle.lines.draw({}, self.display.dark)
        gain = self.gain if self._trial is None else self._trial
        if self.display.editing and gain is not None:
            self._ask(gain)

    def hear(self, handle: GainHandle, message: Mapping[str, Any]) -> None:
        """Take a wish of the browser: a handle on its way, let go or given up."""
        handle.number, self._note = int(message.get("number", 0)), ""
        gain, action = self.gain, message.get("action")
        if gain is None or not handle.layer.frame.get("handles"):
            handle.layer.frame = {**handle.layer.frame, "answered": handle.number}
            return
        try:
            if action in ("drag", "release"):
                gain = round(handle.axis.gain_at(self.store.scenario, message["frequency"]), 4)
            self._trial = gain if action == "drag" else None
            if action == "release":
                self.store.replace({"control.integrator": "manual", "control.gain": gain})
        except (SettingError, ValueError, KeyError) as error:
            self._note = str(error)
        self._ask(gain)

    # ------------------------------------------------------------------ what goes out

    def _ask(self, gain: float) -> None:
        if not self.display.editing:
            return
        mode = self.display.column
        trial = self.store.scenario.replace({"control.integrator": "manual", "control.gain": float(gain), "events": []})
        if mode < len(trial.modes):
            numbers = [handle.number for handle in self.handles]
            self.frames.ask("gain", partial(self._answer, trial, mode), partial(self._land, numbers))

    def _answer(self, trial: Scenario, mode: int) -> Answer:
        """In any thread."""
        known = has_known_spectra(self.store.scenario)
        spectra = told_spectra(self.theory.spectra(trial, mode)) if known else None
        found = design_mode(INTEGRATOR, trial, mode, spectra)
        if found.law is None or not found.stable:
            raise ValueError(f"the loop is not stable with a gain of {trial.control.gain:.3g}")
        return trial.control.gain, found, curves(nominal_loop(found.law, plant_of(trial).mirror), found.law.poles, trial.dt)

    def _land(self, replies: Sequence[int], answer: Answer | None, why: str) -> None:
        if not self.display.editing:
            return
        with pn.io.hold():
            for handle, reply_to in zip(self.handles, replies, strict=True):
                frame: dict[str, Any] = {"handles": [], "numbers": [], "note": why or self._note, "answered": reply_to}
                frame |= {"hint": HINT, "exponent": 1.0, "limits": handle.axis.limits(self.store.scenario)}
                lines: dict[str, Points] = {}
                if answer is not None:
                    gain, design, at = answer
                    lines = {INTEGRATOR: handle.axis.line(at)}
                    frame["handles"], frame["numbers"] = [handle.axis.entry(gain, at, design)], self._numbers(gain, design)
                else:  # where it was: a handle that goes takes the focus of the keyboard with it
                    frame["handles"] = handle.layer.frame.get("handles", [])
                handle.lines.draw(lines, self.display.dark)
                handle.layer.frame = frame

    def _numbers(self, gain: float, design: LawDesign) -> list[dict[str, Any]]:
        """Describe the residual by theory and the margins."""
        scale = self.display.scale(self.store.scenario)
        margins, values = design.margins, [("gain", "gain", f"{gain:.3g}", "")]
        if design.predicted_rms is not None:
            values.append((INTEGRATOR, "residual", number(design.predicted_rms * scale), self.display.unit_label))
        if margins and margins.gain:
            values.append(("gain-margin", "gain margin", f"{20.0 * np.log10(margins.gain):.1f}", "dB"))
        if margins and margins.phase is not None:
            values.append(("phase-margin", "phase margin", f"{degrees(margins.phase):.0f}", "°"))
        colour = look(INTEGRATOR).colour(self.display.dark)
        return [
            {"name": name, "label": label, "colour": colour, "value": value, "unit": unit} for name, label, value, unit in values
        ]
