"""The integrator's optimal gain from closed-loop telemetry, without a model of spectra or noise.

The pseudo-open-loop z of a record is what an integrator of another gain would have been given: it would have left the measurement
y = E(g) z. With white noise and at least one step of delay, E(g) = 1 + terms of the past, so that the noise of y is uncorrelated
with the residual that it measures and mean y^2 is the mean square of the residual plus the variance of the noise, whatever g is:
the gain that is best for y is best for the residual. This is the integral over the measured spectrum times |E(g)|^2 by which
observatories optimise modal gains (Gendron and Lena 1994, A&A 291, 337), taken over the samples themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from wfsobs.control.integrator import highest_stable_gain
from wfsobs.control.mirror import Mirror
from wfsobs.record import hold_last
from wfsobs.typing import Array

TRIED = 80
"""Gains up to the limit of stability; a parabola through the best three refines them."""

BLOCKS = 16
"""Of the record, for the jackknife."""

START = 0.05
"""Share of the record that is left out for the integrators to settle."""


@dataclass(frozen=True)
class TelemetryGain:
    """The gain of least residual of one mode.

    Attributes
    ----------
    gain, deviation : float
        Optimal gain and its standard deviation, by a jackknife over blocks of the record.
    measured_rms : float
        Rms [um] of the measurement with that gain: residual and noise.
    limit : float
        Gain at which the loop becomes unstable.
    """

    gain: float
    deviation: float
    measured_rms: float
    limit: float


def gain_from_telemetry(z: Array, mirror: Mirror, leak: float = 1.0) -> TelemetryGain:
    """Find the integrator's gain of least residual for a pseudo-open-loop record of one mode.

    Parameters
    ----------
    z : Array
        Pseudo-open-loop measurement, (n_steps,) [um]; a missing sample (NaN) repeats the last one.
    mirror : Mirror
        Its delay; limits are not regarded.
    leak : float
        Leak of the integrator.
    """
    z = hold_last(z[:, None])[:, 0]
    limit = highest_stable_gain(mirror, leak)
    gains = limit * np.arange(1, TRIED + 1) / (TRIED + 1)
    start = int(START * z.size)
    used = z.size - start - (z.size - start) % BLOCKS
    power = np.stack([np.square(_left(z, gain, mirror, leak)[-used:]).reshape(BLOCKS, -1).mean(axis=1) for gain in gains])
    gain, variance = _least(gains, power.mean(axis=1))
    others = np.array([_least(gains, np.delete(power, block, axis=1).mean(axis=1))[0] for block in range(BLOCKS)])
    deviation = float(np.sqrt((BLOCKS - 1) * others.var()))
    return TelemetryGain(gain, deviation, float(np.sqrt(variance)), limit)


def _left(z: Array, gain: float, mirror: Mirror, leak: float) -> Array:
    """Return the measurement (n_steps,) that the integrator would have left of z, from rest."""
    free = np.array([1.0, -leak])
    loop = gain * mirror.taps
    loop[:2] += free
    return lfilter(free, loop, z)


def _least(gains: Array, variance: Array) -> tuple[float, float]:
    """Return where a curve is least, and its value there, by a parabola through the best three points."""
    best = min(max(int(np.argmin(variance)), 1), gains.size - 2)
    three = slice(best - 1, best + 2)
    a, b, c = np.polyfit(gains[three] - gains[best], variance[three], 2)
    step = float(np.clip(-0.5 * b / a, gains[0] - gains[1], gains[1] - gains[0])) if a > 0.0 else 0.0
    return float(gains[best] + step), float(c + step * (b + step * a))
