"""What the last minute of a live loop says of itself: noise, turbulence, peaks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wfsobs.evaluation.bound import INFORMATION, bound
from wfsobs.identification import identify
from wfsobs.priors_from.identification import told_by
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.signal.welch import psd
from wfsobs.simulation.true_spectra import has_known_spectra
from wfsobs.spectral.periodogram import periodogram
from wfsobs.typing import Array

MOST_MISSING = 0.2
"""Part of a signal that may be missing; it is bridged by straight lines."""
LOBE = 2.5
"""Half width of a line without damping, in bins: they have 96 % of its power."""
NEAR, FAR = 0.15, 0.5
"""What is around a band is between these parts of its frequency beside it: beyond the wings of a resonance."""

LENGTH = 1.0
"""Time that a spectrum of a waterfall is of [s]."""
ROWS = 128
"""Frequencies of such a spectrum, in equal steps of the logarithm."""
LOWEST = 1.0
"""Frequency at which it begins [Hz]."""


@dataclass(frozen=True)
class MinuteSpectrum:
    """The spectral density of every mode.

    Attributes
    ----------
    step : float
        Between two bins, and the frequency of the first one [Hz].
    density : array
        Of every bin and mode, (n_bins, n_modes) [um^2/Hz].
    """

    step: float
    density: NDArray[np.float32]

    def band(self, frequency: float, half_width: float) -> tuple[Array, Array, Array]:
        """Return the power of a band, what it would be at the median density around it [um^2], and how many bins have it.

        All are (n_modes,). The number is that of independent bins of one density whose power varies by as much.

        Parameters
        ----------
        frequency, half_width : float
            Of the band [Hz]; its half width is LOBE bins at least.
        """
        least = LOBE * self.step
        halves = max(half_width, least), max(NEAR * frequency, 2.0 * least), max(FAR * frequency, 4.0 * least)
        within, near, far = (self._bins(frequency, half) for half in halves)
        around = np.concatenate([self.density[far.start : near.start], self.density[near.stop : far.stop]])
        density = self.density[within].astype(float)
        total, squares = density.sum(axis=0), np.square(density).sum(axis=0)
        level = np.median(around, axis=0).astype(float)
        # of exponential numbers of mean 1 the mean square is 2
        return self.step * total, self.step * len(density) * level, 2.0 * total**2 / np.maximum(squares, np.finfo(float).tiny)

    def _bins(self, frequency: float, half: float) -> slice:
        first, last = (max(round(f / self.step) - 1, 0) for f in (frequency - half, frequency + half))
        return slice(first, last + 1)


def spectrum_of(z: Array, dt: float) -> MinuteSpectrum | None:
    """Return the spectrum of a measurement, (n, n_modes) [um], NaN where it is missing; None where too much is.

    Parameters
    ----------
    z : Array
        The measurement.
    dt : float
        Time step [s].
    """
    whole = [bridge_missing(column) for column in z.T]
    known = [column for column in whole if column is not None]
    if len(known) < len(whole):
        return None
    density = np.stack([periodogram(column, dt) for column in known], axis=1)
    return MinuteSpectrum(1.0 / (len(z) * dt), density.astype(np.float32))


def bridge_missing(x: Array) -> Array | None:
    """Return a signal (n,) with straight lines over what is missing; None where too much is.

    >>> bridge_missing(np.array([1.0, 2.0, np.nan, 4.0, 5.0]))
    array([1., 2., 3., 4., 5.])
    """
    known = ~np.isnan(x)
    if known.all():
        return x
    if known.mean() < 1.0 - MOST_MISSING:
        return None
    at = np.arange(len(x))
    return np.interp(at, at[known], x[known])


Bounds = Mapping[str, Mapping[str, list[float]]]
"""Bound -> target -> rms of every mode [um]."""


@dataclass(frozen=True)
class PeakFinding:
    """A peak: frequency [Hz] and its standard deviation, damping, rms [um]."""

    frequency: float
    frequency_std: float
    damping: float
    rms: float


@dataclass(frozen=True)
class Finding:
    """An identification as another process gives it.

    peaks    : of all modes together
    noise    : of the measurement, per mode [um]
    settings : of the scenario with the models that were found
    spectrum : of the measurement; None where too much of it is missing
    """

    peaks: tuple[PeakFinding, ...]
    noise: tuple[float, ...]
    settings: dict[str, Any]
    spectrum: MinuteSpectrum | None = None


def identify_frames(record: Record, settings: dict[str, Any]) -> Finding:
    """Identify a record; settings : of what is not identified. Raises RecordError."""
    result = identify(record)
    peaks = [
        PeakFinding(p.frequency.value, p.frequency.std, p.damping.value, max(n.value for n in p.rms if n is not None))
        for p in result.peaks
    ]
    told = told_by(result, Scenario.from_dict(settings))
    noise = tuple(mode.noise.value for mode in result.modes)
    return Finding(tuple(peaks), noise, told.to_dict(), spectrum_of(record.z, record.dt))


def bounds_of(settings: dict[str, Any]) -> dict[str, dict[str, list[float]]]:
    """Return bound -> target -> rms of every mode [um]; without those of spectra that are not known."""
    scenario = Scenario.from_dict(settings)
    if not has_known_spectra(scenario):
        return {}
    out: dict[str, dict[str, list[float]]] = {}
    for information in ("lgs", "both"):
        modes = bound(scenario, information=information)
        out[INFORMATION[information]] = {target: [one[target].rms for one in modes] for target in modes[0]}
    return out


def second_spectrum(x: Array, dt: float) -> Array:
    """Return the spectrum of a second of a signal (n,) [um] in ROWS equal steps of the logarithm of the frequency [um^2/Hz].

    Each is the mean over its band of the spectrum taken as constant around every frequency. NaN where too much is missing.
    """
    whole = bridge_missing(x)
    if whole is None:
        return np.full(ROWS, np.nan)
    frequency, density = psd(whole[:, None], dt, resolution=1.0 / LENGTH)
    half = 0.5 * frequency[1]
    edges = np.geomspace(LOWEST, 0.5 / dt, ROWS + 1)
    power = np.concatenate([[0.0], np.cumsum(density[:, 0] * 2.0 * half)])
    below = np.interp(edges, np.concatenate([[-half], frequency + half]), power)
    return np.diff(below) / np.diff(edges)
