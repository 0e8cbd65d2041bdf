"""Numbers with their standard deviations, and processes of three of them: turbulence and peaks."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, isnan, log, nan, pi, sqrt
from typing import NamedTuple

from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.spectral.model import HIGHEST
from wfsobs.spectral.whittle import NO_NEARER
from wfsobs.typing import Array


class Number(NamedTuple):
    """A value and the standard deviation of its estimate, both in the same unit; NaN where no interval holds."""

    value: float
    std: float


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
        Rms [um].
    third_corner : Number or None
        Of turbulence of third order, over `frequency`.
    """

    frequency: Number
    damping: Number
    rms: Number
    third_corner: Number | None = None

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
        with_reliable_std(scale_number(Number(1.0, float(std[0])), p.omega / (2 * pi))),
        with_reliable_std(Number(p.damping, nan if at_bound else float(std[1]))),
        with_reliable_std(scale_number(Number(1.0, float(std[2])), p.rms)),
        third and with_reliable_std(third),
    )


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
