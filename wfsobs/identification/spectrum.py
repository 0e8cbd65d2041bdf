"""The spectrum of a record and of the model identified in it, to be drawn over each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wfsobs.identification.identification import Identification
from wfsobs.identification.result import IdentifiedMode
from wfsobs.record import RecordError
from wfsobs.spectral.periodogram import fast_length, periodogram, periodogram_frequencies, taper
from wfsobs.typing import Array

BINS = 900
"""Of the measured spectrum over the whole axis, all equally wide on it."""

FEWEST = 100
"""Samples that a spectrum takes."""


@dataclass(frozen=True)
class Fit:
    """The model of one mode on a grid of frequencies [Hz] that has every resonance in it: densities [um^2/Hz].

    parts : noise, turbulence and background where there are any, and the resonances, each by itself
    lines : per pure line, frequency, density under it, and how high the periodogram stands at it
    """

    frequency: Array
    total: Array
    parts: tuple[Array, ...]
    lines: tuple[tuple[float, float, float], ...]


def bin_periodogram(z: Array, dt: float) -> tuple[Array, Array, Array]:
    """Estimate the spectrum of measurements, with the taper that the identification uses, in bins of a logarithmic axis.

    Parameters
    ----------
    z : Array
        Measurements without gaps, (n_steps, n_modes) [um].
    dt : float
        Time step [s].

    Returns
    -------
    frequency : Array
        Of the bins, (bins,) [Hz].
    mean, highest : Array
        Of the periodogram in each, (bins, n_modes) [um^2/Hz].

    Raises
    ------
    RecordError
        There are too few samples.
    """
    z = z[: fast_length(len(z))]
    if len(z) < FEWEST:
        raise RecordError(f"the record has {len(z)} samples, too few for a spectrum")
    f = periodogram_frequencies(len(z), dt)
    start = np.flatnonzero(np.diff(np.floor(np.log(f / f[0]) / np.log(f[-1] / f[0]) * BINS), prepend=-1.0))
    count = np.diff(start, append=len(f))
    density = np.column_stack([periodogram(column - column.mean(), dt) for column in z.T])
    return (
        np.add.reduceat(f, start) / count,
        np.add.reduceat(density, start) / count[:, None],
        np.maximum.reduceat(density, start),
    )


def fitted_spectrum(mode: IdentifiedMode, result: Identification) -> Fit:
    """Compute the spectrum of the model identified in a mode."""
    s, T = mode.spectrum, result.duration
    centres = [(p.omega / (2 * np.pi), p.damping) for p in s.processes]
    near = [c * (1.0 + max(damping, 1e-5) * np.linspace(-8.0, 8.0, 65)) for c, damping in centres]
    f = np.unique(np.concatenate([np.geomspace(1.0 / T, 0.5 / result.dt, 600), *near]))
    f = f[(f >= 1.0 / T) & (f <= 0.5 / result.dt)]
    parts = (np.full_like(f, 2.0 * s.dt * s.noise**2), *(p.psd(f) for p in s.processes))
    gain = T * float(np.mean(taper(result.n_steps))) ** 2
    lines = []
    for peak in (p for p in mode.peaks if p.pure):
        floor = float(s.psd(np.array([peak.frequency.value]))[0])
        lines.append((peak.frequency.value, floor, floor + gain * peak.rms.value**2))
    return Fit(f, s.psd(f), parts, tuple(lines))
