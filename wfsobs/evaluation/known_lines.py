"""Which lines of the vibration an observer is given."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wfsobs.observers import OBSERVERS
from wfsobs.prior import Bands, Lines, Model, asks_for
from wfsobs.priors_from.scenario import modelled_peak
from wfsobs.scenario import Scenario
from wfsobs.typing import Array

HALF_WIDTH = 1.5
"""What counts as at a line [Hz] to either side, three bins of a spectrum with 0.5 Hz."""


def given_lines(scenario: Scenario, observer: str, column: int, lines: Sequence[float]) -> Sequence[float]:
    """Return the lines [Hz] that an observer is given in one mode, of a vibration with these lines."""
    prior = OBSERVERS[observer].prior
    if Lines in prior or not lines:
        return lines
    if asks_for(Model, prior):
        return [modelled_peak(scenario, column)[0]]
    return scenario.butterworth.frequencies if asks_for(Bands, prior) else ()


def is_near(frequency: Array, lines: Sequence[float]) -> Array:
    """Return which frequencies [Hz] are at one of the lines, bool, of the same shape."""
    apart = np.abs(np.asarray(frequency)[:, None] - np.asarray(lines, dtype=float))
    return np.any(apart <= HALF_WIDTH, axis=1)
