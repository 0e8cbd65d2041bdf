"""Handles on the gain of the integrator, in the figures of its rejection and of its loop gain."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import degrees
from typing import Any

import numpy as np
import panel as pn
from bokeh.plotting import figure
from numpy.typing import ArrayLike

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.loop_work import LoopResults
from wfsobs.app.numerals import number
from wfsobs.app.store import Store
from wfsobs.app.style import look
from wfsobs.app.views.frames import Frames
from wfsobs.app.views.gain_handles import GainHandle, NyquistHandle, RejectionHandle
from wfsobs.closed_loop.design import LawDesign, design_mode
from wfsobs.control.curves import Curves, curves
from wfsobs.evaluation.theory import Theory
from wfsobs.priors_from.controllers import plant_of
from wfsobs.priors_from.scenario import told_spectra
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError
from wfsobs.simulation.true_spectra import has_known_spectra

INTEGRATOR = "integrator"
HINT = "Only the integrator has a preview; the other controllers follow when the handle is let go."

Answer = tuple[float, LawDesign, Curves]
"""Gain, what theory says of the loop, and its curves."""


class GainEditor:
    """The handles, in step with the settings and the closed loop shown."""

    def __init__(
        self, rejection: figure, nyquist: figure, store: Store, display: Display, results: Callable[[], LoopResults | None]
    ):
        self.store, self.display, self.results = store, display, results
        self.frames, self.theory = Frames(store.session), Theory()
        self.handles = RejectionHandle(rejection, self.hear), NyquistHandle(nyquist, self.hear)
        self._note, self._trial, self._known_gain = "", None, None
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
                gain = round(handle.gain_at(self.store.scenario, message["frequency"]), 4)
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
        return trial.control.gain, found, curves(found.law, plant_of(trial).mirror, trial.dt)

    def _land(self, replies: Sequence[int], answer: Answer | None, why: str) -> None:
        if not self.display.editing:
            return
        with pn.io.hold():
            for handle, reply_to in zip(self.handles, replies, strict=True):
                frame: dict[str, Any] = {"handles": [], "numbers": [], "note": why or self._note, "answered": reply_to}
                frame |= {"hint": HINT, "exponent": 1.0, "limits": handle.limits(self.store.scenario)}
                lines: dict[str, tuple[ArrayLike, ArrayLike]] = {}
                if answer is not None:
                    gain, design, at = answer
                    lines = {INTEGRATOR: handle.line(at)}
                    frame["handles"], frame["numbers"] = [handle.entry(gain, at, design)], self._numbers(gain, design)
                else:  # where it was: a handle that goes takes the focus of the keyboard with it
                    frame["handles"] = handle.layer.frame.get("handles", [])
                handle.lines.draw(lines, self.display.dark)
                handle.layer.frame = frame

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
