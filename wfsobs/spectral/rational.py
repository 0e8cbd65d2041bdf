"""A spectrum as the sum of a few AR(2) processes: the rational function of their poles that is nearest to it.

What a filter makes of a spectrum is decided where that stands above what else is measured, `beside`. The processes are therefore
fitted by Whittle's likelihood of both together, all octaves with the same weight: a filter tells disturbances apart at low
frequencies, of which a linear axis has few. They are added one by one, each where the likelihood gains most.
"""

from __future__ import annotations

from math import log, pi

import numpy as np
from scipy.special import expit, logit

from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.whittle import whittle_fit
from wfsobs.spectral.model import densities
from wfsobs.typing import Array

BINS = 400
"""Approximate number of bands, evenly spaced in the logarithm of the frequency."""
NARROWEST, WIDEST = 1e-4, 0.99
"""Bounds of the damping."""
WEAKEST, STRONGEST = 1e-5, 1e5
"""Bounds of the rms of a process, over that of the whole spectrum."""
TOLERANCE, STEPS = 0.1, 60
"""Distance of a fit from its minimum, in standard deviations of its parameters; maximum number of steps."""


def fit_processes(spectrum: Array, beside: Array, dt: float, count: int) -> tuple[Ar2, ...]:
    """Fit a sum of processes to a spectrum.

    Parameters
    ----------
    spectrum, beside : Array
        Two-sided spectra per sample of what is to be modelled, and of what else is measured, which is above zero; on the
        frequencies of `wiener`, (n // 2 + 1,).
    dt : float
        Time step [s].
    count : int
        Number of processes.

    Returns
    -------
    tuple of Ar2
        The processes; none for a spectrum of zero.
    """
    n = 2 * (spectrum.size - 1)
    edges = np.unique(np.geomspace(1, n // 2 + 1, BINS).astype(int))
    low, high, size = edges[:-1], edges[1:], np.diff(edges)
    f = 0.5 * (low + high - 1) / (n * dt)
    own, other = (2.0 * dt * np.add.reduceat(x[: edges[-1]], low) / size for x in (spectrum, beside))
    power = size * own / (n * dt)
    if not power.any():
        return ()
    rms, weight, x = np.sqrt(power.sum()), np.ones_like(f), np.zeros(0)
    bounds = [(log(2.0 * pi * f[0]), log(0.95 * pi / dt)), (logit(NARROWEST), logit(WIDEST))]
    bounds.append((log(WEAKEST * rms), log(STRONGEST * rms)))

    def density(x: Array) -> Array:
        return other + densities(x.reshape(-1, 3), dt, f)[0].sum(axis=0)

    def log_slopes(x: Array, S: Array) -> Array:
        parts, slopes = densities(x.reshape(-1, 3), dt, f)
        return (parts[:, None] * slopes).reshape(-1, f.size) / S

    for _ in range(count):
        S = density(x) if x.size else other
        first, last = _strongest_band((own + other) / S)
        width, centre = (high[last] - low[first]) / (n * dt), 0.5 * (high[last] + low[first] - 1) / (n * dt)
        excess = np.sum((size * (own + other - S))[first : last + 1]) / (n * dt)
        new = [log(2.0 * pi * centre), logit(np.clip(0.25 * width / centre, 2.0 * NARROWEST, 0.9)), 0.5 * log(excess)]
        x = np.concatenate([x, new])
        x = whittle_fit(density, log_slopes, x, np.array(bounds * (x.size // 3)), own + other, weight, TOLERANCE, STEPS)
    return tuple(Ar2(float(np.exp(w)), float(expit(d)), float(np.exp(a)), dt) for w, d, a in x.reshape(-1, 3))


def _strongest_band(ratio: Array) -> tuple[int, int]:
    """Return the first and the last bin of the run that gains most by one density for all; ratio : wanted over present."""
    best = (-1.0, 0, 0)
    for length in 2 ** np.arange(int(np.log2(ratio.size)) + 1):
        mean = np.convolve(ratio, np.full(length, 1.0 / length), "valid")
        gain = np.where(mean > 1.0, length * (mean - 1.0 - np.log(mean)), -1.0)
        at = int(np.argmax(gain))
        best = max(best, (float(gain[at]), at, at + int(length) - 1))
    return best[1:]
