"""Numbers with their standard deviations, and processes of three of them: turbulence and peaks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot, isnan, log, nan, sqrt
from typing import NamedTuple

import numpy as np
from scipy.fft import rfft

from wfsobs.identification.one_mode import NO_NEARER, OneMode
from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.spectral.model import HIGHEST, Spectrum
from wfsobs.spectral.search import Sinusoid, line_in_record, short_taper
from wfsobs.spectral.whittle import spectrum_information
from wfsobs.typing import Array


class Number(NamedTuple):
    """A value and the standard deviation of its estimate, both in the same unit; NaN where no interval holds."""

    value: float
    std: float


def format_number(n: Number) -> str:
    """Format a number to two digits of its standard deviation, or to three of its own where it has none.

    The damping of an undamped line, which is not estimated, is 0.

    >>> format_number(Number(47.43812, 0.0264)), format_number(Number(502.3, 25.1)), format_number(Number(0.0, 0.0))
    ('47.438 +- 0.026', '502 +- 25', '0')
    >>> format_number(Number(0.1412, float("nan")))
    '0.141 +- -'
    """
    if n == (0.0, 0.0):
        return "0"
    if isnan(n.std):
        return f"{n.value:.3g} +- -"
    digits = max(0, 1 - int(f"{n.std:e}".split("e")[1])) if n.std > 0 else 4
    return f"{n.value:.{digits}f} +- {n.std:.{digits}f}"


@dataclass(frozen=True)
class IdentifiedProcess:
    """Turbulence, background or a peak.

    Attributes
    ----------
    frequency : Number
        Natural frequency, omega / 2 pi [Hz].
    damping : Number
        Damping ratio; 0 +- 0 for an undamped line.
    rms : Number
        Rms [um]; of a peak that within the record.
    ensemble_rms : Number or None
        Of a peak, rms of the process that it is drawn from, as an observer receives it [um]; without a standard deviation below a
        half width of one bin, 1 / length, where the record does not tell.
    third_corner : Number or None
        Of turbulence of third order, over `frequency`.
    """

    frequency: Number
    damping: Number
    rms: Number
    third_corner: Number | None = None
    ensemble_rms: Number | None = None

    @property
    def pure(self) -> bool:
        """Whether it is an undamped line."""
        return self.damping.value == 0


@dataclass(frozen=True)
class IdentifiedPeak:
    """One peak of the structure in all modes: rms holds one number per mode, None where it was not found."""

    frequency: Number
    damping: Number
    rms: tuple[Number | None, ...]


EDGE = 4.0
"""Minimum distance of a line from zero and from half the rate for a standard deviation, in bins: its image overlaps it."""
NARROW = 4.0
"""Half width of a resonance in bins below which it is known by its amplitude in time (`search`), beyond it by its bins."""
RESOLVED = 1.0
"""Minimum half width in bins for a standard deviation of the rms of the process that a resonance is drawn from."""
POOR = 1.0 / 3.0
"""Maximum standard deviation over the number: beyond it, the likelihood of a positive number is not normal."""
AGREE = 3.0
"""Maximum difference of equal numbers, in standard deviations."""
UNSURE = 0.02, 0.5
"""Standard deviation of a frequency and of a damping, over the number, from which it agrees with none: it could be any."""


def with_reliable_std(n: Number) -> Number:
    """Return a positive number, without its standard deviation where that is more than POOR of it."""
    return n if n.std <= POOR * n.value else Number(n.value, nan)


def mean(numbers: list[Number]) -> Number:
    """Return the mean weighted by 1 / std^2 of values of the same quantity; without standard deviations where none has one."""
    sure = [n for n in numbers if not isnan(n.std)]
    if not sure:
        return Number(sum(n.value for n in numbers) / len(numbers), nan)
    weights = [1.0 / max(n.std, 1e-9 * abs(n.value), 1e-300) ** 2 for n in sure]
    return Number(sum(w * n.value for w, n in zip(weights, sure, strict=True)) / sum(weights), 1.0 / sqrt(sum(weights)))


def read_process(p: Ar2 | Ar3, std: Array) -> IdentifiedProcess:
    """Return a process with the standard deviations of its numbers.

    Those of frequency, rms and third corner are relative, the first of std. A damping at its bound has none.
    """
    at_bound = p.damping > HIGHEST - 1e-4
    beyond = p.corner / p.omega - 1.0 if isinstance(p, Ar3) else 0.0
    third = Number(1.0 + beyond, max(beyond, NO_NEARER - 1.0) * float(std[3])) if isinstance(p, Ar3) else None
    return IdentifiedProcess(
        with_reliable_std(Number(p.frequency, float(std[0]) * p.frequency)),
        with_reliable_std(Number(p.damping, nan if at_bound else float(std[1]))),
        with_reliable_std(Number(p.rms, float(std[2]) * p.rms)),
        third and with_reliable_std(third),
    )


def read_resonance(mode: OneMode, p: Ar2, process: IdentifiedProcess) -> IdentifiedProcess:
    """Return a resonance, as `read_process` does, with the rms that it has within the record."""
    half, rest = p.damping * process.frequency.value / mode.f[0], mode.spectrum.without(p)
    ensemble = process.rms if half >= RESOLVED else Number(p.rms, nan)
    if half < NARROW:
        narrow = _narrow(mode, mode.left, process.frequency.value, rest)
        return replace(narrow, damping=process.damping, ensemble_rms=ensemble)
    return replace(process, rms=with_reliable_std(Number(*_rms_of_bins(mode, p))), ensemble_rms=ensemble)


def read_line(mode: OneMode, line: Sinusoid) -> IdentifiedProcess:
    """Return an undamped line, or one that is too narrow to be told from it."""
    if EDGE * mode.f[0] < line.frequency < mode.f[-1] - EDGE * mode.f[0]:
        found = _narrow(mode, mode.left + line.signal(mode.n, mode.dt), line.frequency, mode.spectrum)
    else:
        found = IdentifiedProcess(Number(line.frequency, nan), Number(0.0, 0.0), Number(line.rms, nan))
    return replace(found, ensemble_rms=Number(line.rms, nan))


def _narrow(mode: OneMode, x: Array, near: float, rest: Spectrum) -> IdentifiedProcess:
    """Return a line of x (n,) by its own likelihood; rest : spectrum of what is beside it."""

    def floor(f: Array) -> Array:
        S = rest.psd(f)
        # what is missing of all, the line included, over S alone: at most what white noise would lack
        return S / np.maximum(1.0 - np.interp(f, mode.f, mode.missing_power) / S, 1.0 - mode.missing.is_missing.mean())

    frequency, frequency_std, rms, rms_std = line_in_record(x, mode.dt, near, floor)
    return IdentifiedProcess(
        with_reliable_std(Number(frequency, frequency_std)), Number(0.0, 0.0), with_reliable_std(Number(rms, rms_std))
    )


def _rms_of_bins(mode: OneMode, p: Ar2) -> tuple[float, float]:
    """Return the rms [um] of a wide resonance within the record and its standard deviation, from its part of every bin.

    Given the spectrum, what the resonance has of a bin is a complex normal variable. How well its own three numbers are known
    comes in addition.
    """
    spectrum, df = mode.spectrum, float(mode.f[0])
    start, rest = spectrum.starts[spectrum.processes.index(p)], spectrum.without(p).psd(mode.f)
    h = short_taper(mode.n, mode.dt, p.frequency)
    seen = 2.0 * mode.dt / np.sum(h**2) * np.abs(rfft(h * mode.left)[1 : len(mode.f) + 1]) ** 2 + mode.missing_power

    def power_and_variance(move: Array) -> tuple[float, float]:
        vector = spectrum.vector
        vector[start : start + 3] += move
        part = 1.0 - rest / spectrum.with_vector(vector).psd(mode.f)
        unknown, kept = part * rest, part**2 * seen
        return float(np.sum(kept + unknown)) * df, float(np.sum((unknown + 2.0 * kept) * unknown / mode.share**2)) * df**2

    covariance = np.linalg.inv(spectrum_information(spectrum, mode.cells(everything=True), range(start, start + 3)))
    directions = np.linalg.cholesky(covariance).T
    power, variance = power_and_variance(np.zeros(3))
    slopes = [0.5 * (power_and_variance(d)[0] - power_and_variance(-d)[0]) for d in directions]
    return sqrt(power), 0.5 * sqrt((variance + sum(slope**2 for slope in slopes)) / power)


def scale_number(n: Number, factor: float) -> Number:
    """Return a number times a factor."""
    return Number(n.value * factor, n.std * factor)


def merge_peaks(modes: list[tuple[IdentifiedProcess, ...]]) -> list[IdentifiedPeak]:
    """Merge the peaks of all modes, by frequency: those of several modes that agree in kind, frequency and damping are one."""
    groups: list[dict[int, IdentifiedProcess]] = []
    for i, peaks in enumerate(modes):
        for peak in peaks:
            near = [g for g in groups if i not in g and _agree(list(g.values()), peak)]
            if near:
                min(near, key=lambda g: _apart([p.frequency for p in g.values()], peak.frequency))[i] = peak
            else:
                groups.append({i: peak})
    out = []
    for group in groups:
        pure = next(iter(group.values())).pure
        damping = Number(0.0, 0.0) if pure else mean([p.damping for p in group.values()])
        out.append(
            IdentifiedPeak(
                mean([p.frequency for p in group.values()]),
                damping,
                tuple(group[i].rms if i in group else None for i in range(len(modes))),
            )
        )
    return sorted(out, key=lambda p: p.frequency.value)


def _agree(group: list[IdentifiedProcess], peak: IdentifiedProcess) -> bool:
    """Return whether a peak may be the same as a group."""
    if group[0].pure != peak.pure or not all(map(_sure, (*group, peak))):
        return False
    apart = [_apart([p.frequency for p in group], peak.frequency)]
    if not peak.pure:
        apart.append(_apart([_logarithm(p.damping) for p in group], _logarithm(peak.damping)))
    return max(apart) <= AGREE


def _sure(p: IdentifiedProcess) -> bool:
    frequency, damping = UNSURE
    return p.frequency.std < frequency * p.frequency.value and (p.pure or p.damping.std < damping * p.damping.value)


def _logarithm(n: Number) -> Number:
    return Number(log(n.value), n.std / n.value)


def _apart(group: list[Number], number: Number) -> float:
    """Return the distance over its standard deviation."""
    at = mean(group)
    return abs(at.value - number.value) / hypot(at.std, number.std)
