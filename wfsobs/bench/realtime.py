"""What this machine can hold: how late a paced loop wakes, and what an observer's step takes in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wfsobs.bench.steps import Latency, back_to_back, reference_step, run_paced, step_of
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate

SHARE = 0.999
"""Share of the frames that must be done in time."""
RATES = (4000, 3000, 2000, 1500, 1000, 800, 500, 250, 100, 50)
"""Rates [Hz] of which the highest is told that is held."""


@dataclass(frozen=True)
class RealTime:
    """Timings of one observer or controller at a rate.

    alone     : its steps back to back
    step      : its steps at the rate
    reference : the reference step in the same run
    """

    name: str
    rate: float
    alone: Latency
    step: Latency
    reference: Latency

    @property
    def late_share(self) -> float:
        """Share of the frames that are not done before the next is due."""
        return float(np.mean(self._completion > 1.0 / self.rate))

    @property
    def highest_rate(self) -> float:
        """Highest of `RATES` [Hz] at which at least `SHARE` of these frames would be done before the next is due; 0 for none."""
        return max((rate for rate in RATES if np.mean(self._completion <= 1.0 / rate) >= SHARE), default=0)

    @property
    def _completion(self) -> np.ndarray:
        return self.step.late + self.step.seconds


def measure_realtime(name: str, scenario: Scenario, rate: float, seconds: float) -> RealTime:
    """Run the steps of an observer or controller for so long [s] at a rate [Hz]. Raises ValueError where it has none."""
    step = step_of(name, scenario, simulate(scenario))
    n = max(round(seconds * rate / 2), 1)
    alone = back_to_back(step, min(n, 5000))
    own, reference = run_paced((step, reference_step()), n, rate)
    return RealTime(name, rate, alone, own, reference)
