"""Adaptive vibration cancellation: a phase-locked loop for every line.

Each line is an oscillator m cos(alpha) with magnitude, phase and frequency of its own, all driven by the one innovation

    e[k] = z[k] - level[k] - sum of m cos(alpha),

which demodulated by the oscillator gives the errors of magnitude, 2 e cos(alpha), and of phase, -2 e sin(alpha) / m
(Wu and Bodson 2003, IEEE Trans. Autom. Control 48, 612). A level with a slope takes the turbulence. It is told the bands of
the vibration: no line leaves its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi, sqrt
from typing import Any, NamedTuple

import numpy as np

from wfsobs.observers.base import VIBRATION, Observer
from wfsobs.prior import Bands, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements
from wfsobs.typing import Array
from wfsobs_arena.challengers.base import Challenger

MAGNITUDE = 0.5
"""Bandwidth of the magnitudes [Hz]."""

LOCK = 0.5
"""Natural frequency of the phase-locked loops [Hz]; their damping is sqrt(1/2)."""

LEVEL = 4.0
"""Natural frequency of the level [Hz]."""

WEAKEST = 0.3
"""Least magnitude by which a phase error is divided, over the noise of a magnitude: a weaker line has no phase."""

BLOCK = 1000
"""Steps between two looks at whether to stop."""


class LockedLines(NamedTuple):
    """LockedLines after every step.

    values      : their sum one step ahead of the measurement, (n, n_modes)
    frequencies : after the last step, (n_modes, n_lines) [Hz]
    magnitudes  : after the last step, (n_modes, n_lines)
    """

    values: Array
    frequencies: Array
    magnitudes: Array


def lock_lines(
    z: Array, centres: Sequence[float], half_width: float, dt: float, level: float = LEVEL, watch: Watch | None = None
) -> LockedLines:
    """Follow lines by phase-locked loops.

    Parameters
    ----------
    z : Array
        Measurements, (n, n_modes).
    centres : sequence of float
        Frequencies at the start, (n_lines,) [Hz].
    half_width : float
        Distance that a line may have from its centre [Hz].
    dt : float
        Time step [s].
    level : float
        Natural frequency of the level that takes the turbulence [Hz]; 0 for none.
    watch : Watch, optional
        Asked whether to stop.

    Returns
    -------
    LockedLines
        Their sum, frequencies and magnitudes.
    """
    n, n_modes = z.shape
    start = np.tile(2 * pi * dt * np.asarray(centres), (n_modes, 1))
    low, high = start - 2 * pi * dt * half_width, start + 2 * pi * dt * half_width
    omega, alpha, m = start.copy(), np.zeros_like(start), np.zeros_like(start)
    g_m, w = 2 * pi * MAGNITUDE * dt, 2 * pi * LOCK * dt
    g_alpha, g_omega = sqrt(2.0) * w, w**2
    a = 2 * pi * level * dt
    height, slope, power = np.zeros(n_modes), np.zeros(n_modes), np.zeros(n_modes)
    out = np.empty_like(z)
    for k in range(n):
        if watch is not None and k % BLOCK == 0:
            watch.step(k / n)
        cosine, sine = np.cos(alpha), np.sin(alpha)
        e = z[k] - height - (m * cosine).sum(axis=1)
        power += max(g_m, 1.0 / (k + 1)) * (e**2 - power)
        height, slope = height + slope + sqrt(2.0) * a * e, slope + a**2 * e
        error = 2.0 * e[:, None]
        weakest = WEAKEST * np.sqrt(2.0 * g_m * power)[:, None] + 1e-12
        phase = np.clip(-error * sine / np.maximum(m, weakest), -1.0 / w, 1.0 / w)
        m = np.maximum(m + g_m * error * cosine, 0.0)
        omega = np.clip(omega + g_omega * phase, low, high)
        alpha = np.remainder(alpha + omega + g_alpha * phase, 2 * pi)
        out[k] = (m * np.cos(alpha)).sum(axis=1)
    return LockedLines(out, omega / (2 * pi * dt), m)


def run_avc(measurements: Measurements, prior: Prior, _settings: Any, watch: Watch) -> dict[str, Array]:
    """Run the phase-locked loops on z."""
    bands = prior.bands
    assert bands is not None
    centres = [f for f in bands.frequencies if f < 0.45 / measurements.dt]
    found = lock_lines(measurements.z, centres, 0.5 * bands.bandwidth_online, measurements.dt, watch=watch)
    return {VIBRATION: found.values}


AVC = Challenger(
    Observer(
        "avc",
        "Adaptive vibration cancellation",
        (VIBRATION,),
        run_avc,
        help="a phase-locked loop for every line",
        prior=(Bands,),
    ),
    ("vibration",),
    "Wu and Bodson 2003, IEEE Trans. Autom. Control 48, 612",
)
