"""A handle on the rejection of the integrator: where it crosses 0 dB, which moves with the gain."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from math import degrees
from typing import Any

import numpy as np
import panel as pn
from bokeh.plotting import figure
from numpy.typing import ArrayLike

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.loop_work import LoopResults
from wfsobs.app.numbers import number
from wfsobs.app.store import Store
from wfsobs.app.style import look
from wfsobs.app.views.frames import Frames
from wfsobs.app.views.plots import ExtraLines
from wfsobs.app.views.spectrum_editor import HandleLayer, positive
from wfsobs.closed_loop.design import LawDesign, design_mode
from wfsobs.control.curves import Curves, curves
from wfsobs.control.integrator import highest_stable_gain
from wfsobs.evaluation.theory import Theory
from wfsobs.priors_from.controllers import plant_of
from wfsobs.priors_from.scenario import told_spectra
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError
from wfsobs.simulation.true_spectra import has_known_spectra
from wfsobs.typing import Array

INTEGRATOR = "integrator"
HINT = "Only the integrator has a preview; the Nyquist figure and controllers with NGS or a GPR follow when the handle is let go."

MOST = 0.98
"""The highest gain that a handle gives, over that at which the loop becomes unstable."""

Answer = tuple[float, LawDesign, Curves]
"""Gain, what theory says of the loop, and its curves."""


class GainEditor:
    """The handle, in step with the settings and the closed loop shown."""

    def __init__(self, fig: figure, store: Store, display: Display, results: Callable[[], LoopResults | None]):
        self.store, self.display, self.results = store, display, results
        self.frames, self.theory = Frames(store.session), Theory()
        self.layer = HandleLayer(self.hear, figure=str(fig.name), sizing_mode="stretch_width", margin=0, visible=False)
        self.lines = ExtraLines(fig, "predicted", line_alpha=1.0, line_width=2.2, line_dash=[2, 2], level="glyph")
        self._number, self._note, self._was = 0, "", ""
        store.param.watch(self.follow, "scenario")
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

    def follow(self, *_: object) -> None:
        """Show the gain as it is."""
        self.layer.visible = self.display.editing
        if not self.display.editing:
            self.lines.draw({}, self.display.dark)
        elif (gain := self.gain) is not None:
            self._was = ""
            self._ask(gain)

    def hear(self, message: Mapping[str, Any]) -> None:
        """Take a wish of the browser: the handle on its way, let go or given up."""
        self._number, self._note = int(message.get("number", 0)), ""
        gain, action = self.gain, message.get("action")
        at = next(iter(self.layer.frame.get("handles", [])), None)
        if gain is None or at is None:
            self.layer.frame = {**self.layer.frame, "answered": self._number}
            return
        try:
            if action in ("drag", "release"):
                gain = self._gain_at(positive(message["frequency"]))
            if action == "release":
                self.store.replace({"control.integrator": "manual", "control.gain": gain})
        except (SettingError, ValueError, KeyError) as error:
            self._note = str(error)
        self._ask(gain)

    def _gain_at(self, frequency: float) -> float:
        """Return the gain whose rejection crosses 0 dB at a frequency [Hz], or the highest; see `gain_for_crossover`."""
        scenario = self.store.scenario
        mirror, leak = plant_of(scenario).mirror, scenario.control.leak
        omega = 2.0 * np.pi * frequency * scenario.dt
        loop = complex(mirror.response(np.array([omega]))[0] / (1.0 - leak * np.exp(-1j * omega)))
        return round(gain_for_crossover(loop, MOST * highest_stable_gain(mirror, leak)), 4)

    # ------------------------------------------------------------------ what goes out

    def _ask(self, gain: float) -> None:
        if not self.display.editing:
            return
        mode = self.display.column
        trial = self.store.scenario.replace({"control.integrator": "manual", "control.gain": float(gain), "events": []})
        if mode < len(trial.modes):
            self.frames.ask("gain", partial(self._answer, trial, mode), partial(self._land, self._number))

    def _answer(self, trial: Scenario, mode: int) -> Answer:
        """In any thread."""
        known = has_known_spectra(self.store.scenario)
        spectra = told_spectra(self.theory.spectra(trial, mode)) if known else None
        found = design_mode(INTEGRATOR, trial, mode, spectra)
        if found.law is None or not found.stable:
            raise ValueError(f"the loop is not stable with a gain of {trial.control.gain:.3g}")
        return trial.control.gain, found, curves(found.law, plant_of(trial).mirror, trial.dt)

    def _land(self, reply_to: int, answer: Answer | None, why: str) -> None:
        if not self.display.editing:
            return
        frame: dict[str, Any] = {"handles": [], "numbers": [], "note": why or self._note, "answered": reply_to, "exponent": 1.0}
        frame["hint"] = HINT
        frame["limits"] = [0.01, 0.5 / self.store.scenario.dt]
        lines: dict[str, tuple[ArrayLike, ArrayLike]] = {}
        if answer is not None:
            gain, design, at = answer
            level = 20.0 * np.log10(np.maximum(np.abs(at.rejection), 1e-6))
            lines = {INTEGRATOR: (at.frequency, level)}
            frame["handles"] = [self._handle(gain, crossover(at.frequency, level))]
            frame["numbers"] = self._numbers(gain, design)
        with pn.io.hold():
            self.lines.draw(lines, self.display.dark)
            self.layer.frame = frame

    def _handle(self, gain: float, frequency: float) -> dict[str, Any]:
        text = f"gain {gain:.3g}, 0 dB at {frequency:.3g} Hz"
        handle = {"id": "gain-0", "kind": "gain", "label": "Integrator gain", "text": text, "frequency": frequency, "y": 0.0}
        return {**handle, "strength": False, "damping": False}

    def _numbers(self, gain: float, design: LawDesign) -> list[dict[str, Any]]:
        """Describe the residual by theory and the margins."""
        scale = per_micrometre(self.display.unit, self.store.scenario.telescope.diameter)
        values = [("gain", "gain", f"{gain:.3g}", "")]
        if design.predicted_rms is not None:
            values.append((INTEGRATOR, "residual", number(design.predicted_rms * scale), self.display.unit_label))
        if design.margins is not None and design.margins.gain:
            values.append(("gain-margin", "gain margin", f"{20.0 * np.log10(design.margins.gain):.1f}", "dB"))
        if design.margins is not None and design.margins.phase is not None:
            values.append(("phase-margin", "phase margin", f"{degrees(design.margins.phase):.0f}", "°"))
        colour = look(INTEGRATOR).colour(self.display.dark)
        return [
            {"name": name, "label": label, "colour": colour, "value": value, "unit": unit, "was": ""}
            for name, label, value, unit in values
        ]


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
