"""Alarms of a live loop: frames missing, noise up, an observer out of its band, peaks that are new or have moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import hypot, isnan

import numpy as np

from wfsobs.live.board import NEXT
from wfsobs.live.finding import Finding, PeakFinding
from wfsobs.live.view import LiveView
from wfsobs.typing import Array

MISSING = 0.01
"""Part of the frames of a second that may be missing."""
NOISE = 1.5
"""Factor by which the noise may rise over the median of the minute before."""
BAND = 2.0
"""Factor by which the error of the next measurement may rise over the median of the minute before."""
HISTORY = 60
"""Seconds of which the medians are taken."""
FEWEST = 10
"""Seconds before the first alarm of a median."""
SIGMAS = 5.0
"""A peak has moved if its frequencies differ by more than so many standard deviations, and is another beyond REACH."""
REACH = 0.1
"""Part of its frequency within which a peak is looked for again."""


class Alarms:
    """What is not as it was; an alarm is told once when it begins, and once when it is over.

    Parameters
    ----------
    say : callable
        Receives one line.
    """

    def __init__(self, say: Callable[[str], None]):
        self._say = say
        self._history: dict[str, list[float]] = {}
        self._active: set[str] = set()
        self._peaks: tuple[PeakFinding, ...] | None = None

    def look_at(self, second: LiveView, observers: Sequence[str]) -> None:
        """Judge a second of frames."""
        z = second.frames.z
        missing = float(np.isnan(z).any(axis=1).mean())
        self._set("frames missing", missing > MISSING, f"{missing:.1%} of frames missing")
        self._judge("noise", noise_of(z), NOISE)
        for name in observers:
            self._judge(f"error of {name}", float(np.sqrt(np.mean(second.rms(name, NEXT) ** 2))), BAND)

    def compare(self, finding: Finding) -> None:
        """Judge an identification against the one before."""
        before, self._peaks = self._peaks, finding.peaks
        for row in [] if before is None else drift(before, finding.peaks):
            self._say(f"ALARM {row}")

    def _judge(self, what: str, value: float, factor: float) -> None:
        """Judge a number by its median so far; while it is raised it does not count."""
        if isnan(value):
            return
        history = self._history.setdefault(what, [])
        usual = float(np.median(history)) if len(history) >= FEWEST else value
        is_active = value > factor * usual
        self._set(what, is_active, f"{what} up: {1e3 * value:.1f} nm, it was {1e3 * usual:.1f} nm")
        if not is_active:
            history.append(value)
            del history[:-HISTORY]

    def _set(self, what: str, is_active: bool, line: str) -> None:
        if is_active and what not in self._active:
            self._active.add(what)
            self._say(f"ALARM {line}")
        elif not is_active and what in self._active:
            self._active.discard(what)
            self._say(f"over: {what}")


def noise_of(z: Array) -> float:
    """Estimate the white noise of frames, (n, n_modes), from their third differences [um]: slow signals leave nothing in them."""
    d = np.diff(z, n=3, axis=0)
    known = d[~np.isnan(d)]
    return float(np.sqrt(np.mean(known**2) / 20.0)) if known.size else float("nan")  # 1 + 9 + 9 + 1


def drift(before: Sequence[PeakFinding], now: Sequence[PeakFinding]) -> list[str]:
    """Say which peaks are new, have moved or are gone."""
    lines, left = [], [*before]
    for peak in now:
        same = min(left, key=lambda one: abs(one.frequency - peak.frequency), default=None)
        if same is None or abs(same.frequency - peak.frequency) > REACH * peak.frequency:
            lines.append(f"new peak at {peak.frequency:.2f} Hz, {1e3 * peak.rms:.1f} nm")
            continue
        left.remove(same)
        std = hypot(same.frequency_std, peak.frequency_std)
        if not isnan(std) and abs(same.frequency - peak.frequency) > SIGMAS * std:
            lines.append(f"peak moved from {same.frequency:.2f} to {peak.frequency:.2f} Hz")
    return lines + [f"peak at {one.frequency:.2f} Hz is gone" for one in left]
