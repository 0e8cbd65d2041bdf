"""Numbers with their errors, and what has three of them: turbulence and peaks."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, sqrt
from typing import NamedTuple


class Number(NamedTuple):
    """A value and the standard deviation of its estimate, both in the same unit."""

    value: float
    std: float


@dataclass(frozen=True)
class Process:
    """Turbulence, background or a peak: natural frequency (omega / 2 pi) [Hz], damping (0 +- 0 for a pure line), rms [um].

    third_corner : of turbulence of third order, over `frequency`, or None
    """

    frequency: Number
    damping: Number
    rms: Number
    third_corner: Number | None = None

    @property
    def pure(self) -> bool:
        """Whether it is a pure line."""
        return self.damping.value == 0


@dataclass(frozen=True)
class Peak:
    """One peak of the structure in all modes: rms holds one number per mode, None where it was not seen."""

    frequency: Number
    damping: Number
    rms: tuple[Number | None, ...]


AGREE = 3.0
"""Standard deviations of their difference within which two frequencies are the same."""


def mean(numbers: list[Number]) -> Number:
    """The mean weighted by 1 / std^2, of values of the same thing."""
    weights = [1.0 / max(n.std, 1e-9 * abs(n.value), 1e-300) ** 2 for n in numbers]
    return Number(sum(w * n.value for w, n in zip(weights, numbers, strict=True)) / sum(weights), 1.0 / sqrt(sum(weights)))


def merged(modes: list[tuple[Process, ...]]) -> list[Peak]:
    """The peaks of all modes by frequency; those of several modes that agree in frequency are one.

    Whether that is a pure line is what the mode says in which it stands out most.
    """
    groups: list[dict[int, Process]] = []
    for i, peaks in enumerate(modes):
        for peak in peaks:
            near = [g for g in groups if i not in g and _apart(g, peak) <= AGREE]
            if near:
                min(near, key=lambda g: _apart(g, peak))[i] = peak
            else:
                groups.append({i: peak})
    out = []
    for group in groups:
        clearest = max(group.values(), key=lambda p: p.rms.value / p.rms.std)
        damping = Number(0.0, 0.0) if clearest.pure else mean([p.damping for p in group.values() if not p.pure])
        out.append(Peak(mean([p.frequency for p in group.values()]), damping,
                        tuple(group[i].rms if i in group else None for i in range(len(modes)))))
    return sorted(out, key=lambda p: p.frequency.value)


def _apart(group: dict[int, Process], peak: Process) -> float:
    """Distance in frequency over its standard deviation."""
    at = mean([p.frequency for p in group.values()])
    return abs(at.value - peak.frequency.value) / hypot(at.std, peak.frequency.std)
