"""Identification of the last minute of a live loop: noise, turbulence, peaks; and changes of the peaks between minutes.

An identification finds a weak peak in one minute and not in the next, though nothing has changed. A peak is new where the power
of its band has risen, and gone where that has fallen; what is found or not without either is neither.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, isnan, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from wfsobs.evaluation.bound import INFORMATION, bound
from wfsobs.identification import identify
from wfsobs.priors_from.telemetry import told_by
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.signal.spectrum import psd
from wfsobs.simulation.true_spectra import has_known_spectra
from wfsobs.spectral.whittle import periodogram
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


SIGMAS = 5.0
"""A peak has moved if its frequencies differ by more than so many standard deviations, and is another beyond REACH."""
REACH = 0.1
"""Part of its frequency within which a peak of its size is looked for again."""
CLOSE = 0.02
"""Part of their frequency within which peaks are one: of two modes, or a line that has been found in pieces."""
SIZE = 2.0
"""Factor within which a line that has moved keeps its rms: what is left of it in a minute in which it jumps may be nearer."""
RESOLUTION = 1.0 / 60.0
"""Standard deviation of a frequency at least [Hz]: a minute resolves no more, and a real line wanders."""
FAINT = 0.1
"""A peak weaker than this part of the noise of a frame is none."""
CHANGE, MOST = 4.0, 30.0
"""Factor by which the power of a band rises with a peak that is new, at least; at most where a narrow one varies by itself."""
CHANCE = 1e-5
"""Probability of such a rise where nothing has changed."""
WIDTHS = 3.0
"""Half width of the band of a peak, in its own half widths or standard deviations of its frequency; CLOSE at most."""


class Change:
    """What has become of the peaks from one minute to the next.

    Parameters
    ----------
    findings : sequence of Finding
        The last three minutes, or fewer: a peak that one of them lacks is known from the one before.

    Attributes
    ----------
    peaks : tuple of PeakFinding
        Those of the last minute.
    same : dict
        Those of them that were known -> as they were.
    drifts : dict
        Those of the same that have been elsewhere -> as they were.
    new, losses : list of PeakFinding
        Those that were not known and have risen; those known that are not found and have fallen.
    """

    def __init__(self, findings: Sequence[Finding]):
        before, now = findings[-2:][0], findings[-1]
        known: list[PeakFinding] = []
        for minute in findings[-2::-1]:
            known += [peak for peak in distinct_peaks(minute) if not any(_is_near(peak, one) for one in known)]
        self.peaks: tuple[PeakFinding, ...] = distinct_peaks(now)
        near = [(peak, one) for peak in self.peaks for one in known if _is_near(one, peak)]
        self.same: dict[PeakFinding, PeakFinding] = paired_peaks(near)
        self.drifts: dict[PeakFinding, PeakFinding] = {
            peak: one for peak, one in self.same.items() if _has_drifted(peak, one, before, now)
        }
        self.new: list[PeakFinding] = [peak for peak in self.peaks if peak not in self.same and has_risen(peak, before, now)]
        was = self.same.values()
        self.losses: list[PeakFinding] = [peak for peak in known if peak not in was and has_risen(peak, now, before)]


def peak_changes(findings: Sequence[Finding]) -> list[tuple[str, str]]:
    """Say which peaks are new, have moved or are gone in the last of up to four minutes, and a detail of each.

    A line that moves in the midst of a minute is two peaks in that minute: one is new. In the next one the other is gone, and has
    moved to it.
    """
    last, before = Change(findings[-3:]), Change(findings[-4:-1]) if len(findings) > 1 else None
    moves = moves_of(last, before)
    lines = []
    for peak in last.peaks:
        if (origin := moves.get(peak, last.drifts.get(peak))) is not None:
            was = origin if before is None else before.same.get(origin, origin)
            origin = min(origin, was, key=lambda one: one.frequency_std)  # the rest of a line that has jumped is known less well
            lines.append((f"peak moved from {origin.frequency:.2f} to {peak.frequency:.2f} Hz", ""))
        elif peak in last.new:
            lines.append((f"new peak at {peak.frequency:.2f} Hz", f", {1e3 * peak.rms:.1f} nm"))
    lost = [peak for peak in last.losses if peak not in moves.values()]
    return [*lines, *((f"peak at {peak.frequency:.2f} Hz is gone", "") for peak in lost)]


def moves_of(last: Change, before: Change | None = None) -> dict[PeakFinding, PeakFinding]:
    """Return peak -> the one that has moved there: gone, within REACH, of its size in one of the last two minutes.

    A peak that was new the minute `before` is a place to have moved to as well.
    """
    just_new = [] if before is None else [peak for peak, one in last.same.items() if one in before.new]

    def may_have_moved(peak: PeakFinding, one: PeakFinding) -> bool:
        was = one if before is None else before.same.get(one, one)
        return _is_near(one, peak, REACH) and (_are_alike(one, peak) or _are_alike(was, peak))

    pairs = [(peak, one) for peak in (*last.new, *just_new) for one in last.losses]
    return paired_peaks([pair for pair in pairs if may_have_moved(*pair)])


def _has_drifted(peak: PeakFinding, was: PeakFinding, before: Finding, now: Finding) -> bool:
    """Return whether a peak is elsewhere: in its band by its frequency alone, beyond it the power has moved as well."""
    std = hypot(*(max(each.frequency_std, RESOLUTION) for each in (was, peak)))
    by = abs(was.frequency - peak.frequency)
    if isnan(std) or by <= SIGMAS * std:
        return False
    return by <= _half_width(peak) or has_risen(peak, before, now) or has_risen(was, now, before)


def _half_width(peak: PeakFinding) -> float:
    """Return the half width of the band of a peak [Hz]."""
    std = 0.0 if isnan(peak.frequency_std) else peak.frequency_std
    return min(WIDTHS * max(peak.damping * peak.frequency, std), CLOSE * peak.frequency)


def has_risen(peak: PeakFinding, before: Finding, now: Finding) -> bool:
    """Return whether the power of a peak's band has risen, more than what is around it, in one mode at least.

    A band that was weaker than what is around it counts as that: of many bands some are, and a peak is found where one is strong.
    Power of n independent bins over that of n others is F-distributed, 2n to 2n.
    """
    if before.spectrum is None or now.spectrum is None:
        return False
    half = _half_width(peak)
    was, level_was, bins_were = before.spectrum.band(peak.frequency, half)
    power, level, bins = now.spectrum.band(peak.frequency, half)
    freedom = 2.0 * np.maximum(np.minimum(bins, bins_were), 1.0)
    least = np.clip(fdtri(freedom, freedom, 1.0 - CHANCE), CHANGE, MOST)
    return bool(np.any(power * level_was > least * np.maximum(was, level_was) * np.maximum(level, level_was)))


def distinct_peaks(finding: Finding) -> tuple[PeakFinding, ...]:
    """Return the peaks that are not faint; CLOSE ones are one, in the middle by their power, as strong as the strongest."""
    groups: list[list[PeakFinding]] = []
    for peak in sorted(finding.peaks, key=lambda one: one.frequency):
        if groups and peak.frequency - groups[-1][-1].frequency < CLOSE * peak.frequency:
            groups[-1].append(peak)
        else:
            groups.append([peak])
    return tuple(peak for peak in map(_joint_peak, groups) if peak.rms >= FAINT * max(finding.noise, default=0.0))


def _joint_peak(peaks: Sequence[PeakFinding]) -> PeakFinding:
    """Return peaks as one; its standard deviation has their distances in it."""
    share = np.square([peak.rms for peak in peaks])
    share = share / share.sum() if share.any() else np.full(len(peaks), 1.0 / len(peaks))
    frequencies = np.array([peak.frequency for peak in peaks])
    middle = float(share @ frequencies)
    variances = np.square([peak.frequency_std for peak in peaks]) + (frequencies - middle) ** 2
    strongest = max(peaks, key=lambda one: one.rms)
    return replace(strongest, frequency=middle, frequency_std=sqrt(float(share @ variances)))


def paired_peaks(near: Sequence[tuple[PeakFinding, PeakFinding]]) -> dict[PeakFinding, PeakFinding]:
    """Return peak -> the one before of some pairs of both, the nearest ones first, each of them once."""
    pairs: dict[PeakFinding, PeakFinding] = {}
    for peak, one in sorted(near, key=lambda pair: abs(pair[1].frequency - pair[0].frequency)):
        if peak not in pairs and one not in pairs.values():
            pairs[peak] = one
    return pairs


def _is_near(one: PeakFinding, other: PeakFinding, share: float = CLOSE) -> bool:
    return abs(one.frequency - other.frequency) <= share * other.frequency


def _are_alike(one: PeakFinding, other: PeakFinding) -> bool:
    return other.rms <= SIZE * one.rms and one.rms <= SIZE * other.rms
