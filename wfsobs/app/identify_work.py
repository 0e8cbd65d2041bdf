"""What the page of the identification shows: the measured spectrum of a record, the model of it, and how the two compare."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wfsobs.app.jobs.job import Tell
from wfsobs.app.work import RunResults
from wfsobs.identification import Identification, identify
from wfsobs.identification.result import IdentifiedMode
from wfsobs.observers.missing import fill_missing
from wfsobs.prior import Model
from wfsobs.priors_from.scenario import prior_of
from wfsobs.progress import Watch
from wfsobs.record import Record, RecordError
from wfsobs.spectral.periodogram import fast_length, periodogram, periodogram_frequencies, taper
from wfsobs.typing import Array

BINS = 900
"""Of the measured spectrum over the whole axis, all equally wide on it."""
PER_SAMPLE = 40e-6
"""Time per sample and mode of a record with some ten peaks [s]; one with thirty takes ten times as long."""


@dataclass(frozen=True)
class RecordSpectrum:
    """The periodogram of z in the bins of an axis: mean and highest, (bins, n_modes) [um^2/Hz], at frequency (bins,) [Hz].

    duration [s]
    """

    record: Record
    frequency: Array
    mean: Array
    highest: Array
    duration: float


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


def estimate_record_spectrum(of: RunResults, _watch: Watch, _tell: Tell) -> RecordSpectrum:
    """Estimate the spectrum of the record shown, with the taper that the identification uses. Raises RecordError."""
    record = of.result.record
    z = fill_missing(record, prior_of(of.result.scenario.before_events, record, (Model,))).z[record.delay :]
    z = z[: fast_length(len(z))]
    if len(z) < 100:
        raise RecordError(f"the record has {record.n_steps} samples, too few for a spectrum")
    f = periodogram_frequencies(len(z), record.dt)
    start = np.flatnonzero(np.diff(np.floor(np.log(f / f[0]) / np.log(f[-1] / f[0]) * BINS), prepend=-1.0))
    count = np.diff(start, append=len(f))
    density = np.column_stack([periodogram(column - column.mean(), record.dt) for column in z.T])
    return RecordSpectrum(
        record,
        np.add.reduceat(f, start) / count,
        np.add.reduceat(density, start) / count[:, None],
        np.maximum.reduceat(density, start),
        len(z) * record.dt,
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
    for line in (p for p in mode.peaks if p.pure):
        floor = float(s.psd(np.array([line.frequency.value]))[0])
        lines.append((line.frequency.value, floor, floor + gain * line.rms.value**2))
    return Fit(f, s.psd(f), parts, tuple(lines))


def seconds(record: Record) -> float:
    """About how long an identification takes [s]."""
    return PER_SAMPLE * record.n_steps * record.n_modes


def same_measurements(one: Record, other: Record) -> bool:
    """Whether two records hold the same measurements."""
    return one is other or (
        one.y_lgs.shape == other.y_lgs.shape
        and one.dt == other.dt
        and one.delay == other.delay
        and np.array_equal(one.y_lgs, other.y_lgs, equal_nan=True)
        and np.array_equal(one.u, other.u, equal_nan=True)
    )


def compute(of: RunResults, level: float, lowest: float, watch: Watch, _tell: Tell) -> tuple[Identification, Record]:
    """Identify a model in the record shown; return both. Raises RecordError, Cancelled."""
    return identify(of.result.record, level=level, lowest=lowest, watch=watch), of.result.record
