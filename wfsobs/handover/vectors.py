"""Test vectors of a controller: measurements with gaps, and the commands of its run over the record."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wfsobs.control.base import Controller, Settings
from wfsobs.control.mirror import Mirror, Plant
from wfsobs.prior import Prior
from wfsobs.record import Measurements, Sampling
from wfsobs.signal.gate import GateSettings, OutlierGate
from wfsobs.typing import Array

STEPS = 10_240
SEED = 1


class Vectors(NamedTuple):
    """z, ngs and u (n_steps, n_modes) [um], NaN where missing, ngs where no frame is due; z with outliers, and without these."""

    z: Array
    ngs: Array
    u: Array
    with_outliers: Array
    without_outliers: Array


def make_vectors(
    controller: Controller, prior: Prior, plant: Plant, settings: Settings, sampling: Sampling, gate: GateSettings
) -> Vectors:
    """Run a controller over drawn measurements: slow drifts, a line, white noise; single gaps, a long one, gaps of one mode."""
    rng = np.random.default_rng(SEED)
    n, modes, ratio = STEPS, sampling.n_modes, sampling.ratio or 1
    phase = 2.0 * np.pi * rng.random((3, modes))
    time = np.arange(n)[:, None] * sampling.dt
    slow = np.zeros((n, modes))
    for a, f, p in zip((0.3, 0.1, 0.02), (0.7, 3.1, 47.5), phase, strict=True):
        slow += a * np.sin(2.0 * np.pi * f * time + p)
    z = slow + 0.02 * rng.standard_normal((n, modes))
    ngs = np.full((n, modes), np.nan)
    ngs[ratio::ratio] = slow[ratio::ratio] + 0.01 * rng.standard_normal((len(range(ratio, n, ratio)), modes))
    z[rng.random(n) < 0.01] = np.nan
    z[rng.random((n, modes)) < 0.005] = np.nan
    z[n // 2 : n // 2 + 40] = np.nan
    ngs[rng.random((n, modes)) < 0.02] = np.nan
    still = np.zeros((n, modes))  # a mirror at rest: the measurements are pseudo-open-loop already
    measurements = Measurements(z, still, sampling.dt, ngs if sampling.ratio else None, sampling.ratio, delay=sampling.delay)
    free = Plant(Mirror(plant.mirror.delay), plant.dt, plant.ratio)
    laws = controller.laws(prior, free, settings, modes)
    broken = z.copy()
    broken[rng.random((n, modes)) < 0.01] += 0.5
    broken[n // 3 :] += 0.2  # a jump
    broken[n // 4 :] += 0.1 * np.sin(2.0 * np.pi * 0.11 * np.arange(n - n // 4))[:, None]  # a vibration that appears
    u = controller.commands(laws, measurements, prior, free, settings)[0]
    return Vectors(z, ngs, u, broken, OutlierGate(modes, gate).check_all(broken))
