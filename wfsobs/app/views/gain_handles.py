"""Where a handle on the gain of the integrator stands in a figure, and the gain of a place that it is moved to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from bokeh.plotting import figure

from wfsobs.app.pages.loop_figures import plane
from wfsobs.app.views.plots import ExtraLines
from wfsobs.app.views.spectrum_editor import HandleLayer, positive
from wfsobs.closed_loop.design import LawDesign
from wfsobs.control.curves import Curves
from wfsobs.control.integrator import highest_stable_gain
from wfsobs.priors_from.controllers import plant_of
from wfsobs.scenario import Scenario
from wfsobs.typing import Array

MOST = 0.98
"""The highest gain that a handle gives, over that at which the loop becomes unstable."""


class GainHandle:
    """The handle in one figure, and the line of the gain that it would set."""

    title = ""

    def __init__(self, fig: figure, hear: Callable[[GainHandle, Mapping[str, Any]], None]):
        self.layer = HandleLayer(partial(hear, self), figure=str(fig.name), sizing_mode="stretch_width", margin=0, visible=False)
        self.lines = ExtraLines(fig, "predicted", line_alpha=1.0, line_width=2.2, line_dash=[2, 2], level="glyph")
        self.number = 0

    def gain_at(self, scenario: Scenario, position: object) -> float:
        """Return the gain for a place of the handle, or the highest. Raises ValueError for no such place."""
        raise NotImplementedError

    def line(self, at: Curves) -> tuple[Array, Array]:
        """Return what is drawn of the loop's curves."""
        raise NotImplementedError

    def place(self, at: Curves, design: LawDesign) -> tuple[float, str]:
        """Return where the handle stands on the horizontal axis, in the height of 0, and what it says of that."""
        raise NotImplementedError

    def limits(self, scenario: Scenario) -> list[float]:
        """Return the first and the last place."""
        raise NotImplementedError

    def entry(self, gain: float, at: Curves, design: LawDesign) -> dict[str, Any]:
        """Describe the handle."""
        position, said = self.place(at, design)
        text = f"gain {gain:.3g}, {said}"
        handle = {"id": "gain-0", "kind": "gain", "label": self.title, "text": text, "frequency": position, "y": 0.0}
        return {**handle, "strength": False, "damping": False}


class RejectionHandle(GainHandle):
    """Where the rejection crosses 0 dB."""

    title = "Integrator gain"

    def gain_at(self, scenario: Scenario, position: object) -> float:
        """Return the gain whose rejection crosses 0 dB at a frequency [Hz]; see `gain_for_crossover`."""
        mirror, leak = plant_of(scenario).mirror, scenario.control.leak
        omega = 2.0 * np.pi * positive(position) * scenario.dt
        loop = complex(mirror.response(np.array([omega]))[0] / (1.0 - leak * np.exp(-1j * omega)))
        return gain_for_crossover(loop, MOST * highest_stable_gain(mirror, leak))

    def line(self, at: Curves) -> tuple[Array, Array]:
        """Return the rejection [dB] over the frequency [Hz]."""
        return at.frequency, 20.0 * np.log10(np.maximum(np.abs(at.rejection), 1e-6))

    def place(self, at: Curves, design: LawDesign) -> tuple[float, str]:
        """Return the frequency [Hz]."""
        frequency = crossover(*self.line(at))
        return frequency, f"0 dB at {frequency:.3g} Hz"

    def limits(self, scenario: Scenario) -> list[float]:
        """Return the lowest frequency and that of Nyquist [Hz]."""
        return [0.01, 0.5 / scenario.dt]


class NyquistHandle(GainHandle):
    """Where the loop gain crosses the negative real axis, which is at -1 where the loop becomes unstable."""

    title = "Integrator gain, Nyquist"

    def gain_at(self, scenario: Scenario, position: object) -> float:
        """Return the gain for a crossing at this real part: the loop gain is in proportion to it."""
        if not isinstance(position, (int, float)) or not np.isfinite(position):
            raise ValueError("a handle can be moved to numbers only")
        share = min(max(-position, 1e-3), MOST)
        return share * highest_stable_gain(plant_of(scenario).mirror, scenario.control.leak)

    def line(self, at: Curves) -> tuple[Array, Array]:
        """Return the loop gain in the complex plane."""
        return plane(at.loop_gain)

    def place(self, at: Curves, design: LawDesign) -> tuple[float, str]:
        """Return the real part at the crossing."""
        margin = design.margins.gain if design.margins is not None else None
        crossing = -1.0 / margin if margin else 0.0
        return crossing, f"crosses the real axis at {crossing:.3f}"

    def limits(self, scenario: Scenario) -> list[float]:
        """Return the limit of stability, and no gain."""
        return [-1.0, 0.0]


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
