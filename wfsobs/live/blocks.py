"""An endless simulation in constant memory: records that fade into each other.

Records of equal length overlap by half, weighted by a sine of half a period, the squares of which add up to one. So the sum of
two independent Gaussian records has their variance at every step, and at a lag tau their covariance times cos(pi tau / length):
there is no seam, and lines are wider by 1 / (2 length).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from wfsobs.scenario import Scenario
from wfsobs.simulation.disturbance import make_disturbance
from wfsobs.simulation.sensing import measure_open_loop
from wfsobs.typing import Array

LENGTH = 40.0
"""Length of a record [s]; a block is half as long."""


@dataclass(frozen=True)
class Block:
    """Consecutive frames.

    Attributes
    ----------
    z : Array
        Pseudo-open-loop LGS measurement, (n, n_modes) [um].
    ngs : Array
        Pseudo-open-loop NGS measurement, (n, n_modes) [um]; NaN in frames without one.
    turbulence, vibration : Array
        Truth, (n, n_modes) [um].
    """

    z: Array
    ngs: Array
    turbulence: Array
    vibration: Array

    def pieces(self, length: int) -> list[Array]:
        """Return a row per frame, z, ngs, turbulence, vibration, (n, 4 n_modes) [um], in pieces of so many frames."""
        rows = np.hstack([self.z, self.ngs, self.turbulence, self.vibration])
        return [rows[at : at + length] for at in range(0, len(rows), length)]


def endless_blocks(scenario: Scenario, rng: np.random.Generator, length: float = LENGTH) -> Iterator[Block]:
    """Yield blocks of frames of a scenario for ever.

    Parameters
    ----------
    scenario : Scenario
        Settings; their events are left out.
    rng : numpy.random.Generator
        LiveSource of all random numbers.
    length : float
        Length of the records [s].

    Yields
    ------
    Block
        Half a record each; frame 0 of all is one with an NGS measurement, but for the first.

    Raises
    ------
    SettingError
        The settings exclude each other.
    """
    scenario = scenario.before_events
    scenario.validate()
    ratio = scenario.sensors.exposure_ratio
    half = max(1, round(0.5 * length / scenario.dt / ratio)) * ratio
    weight = np.sin(0.5 * np.pi * np.arange(half) / half)[:, None]
    before = _record(scenario, 2 * half, rng)
    while True:
        after = _record(scenario, 2 * half, rng)
        yield Block(**{name: _fade(getattr(before, name)[half:], getattr(after, name)[:half], weight) for name in vars(before)})
        before = after


def _record(scenario: Scenario, n_steps: int, rng: np.random.Generator) -> Block:
    disturbance_rng, sensor_rng = rng.spawn(2)
    disturbance = make_disturbance(scenario, n_steps, disturbance_rng)
    seen = measure_open_loop(scenario, disturbance, sensor_rng)
    return Block(seen.lgs, seen.ngs, disturbance.turbulence, disturbance.vibration)


def _fade(before: Array, after: Array, weight: Array) -> Array:
    """Fade from one record to the next; the first sample is that of the one before alone, where the next may have none."""
    out = np.sqrt(1.0 - weight**2) * before
    out[1:] += weight[1:] * after[1:]
    return out
