"""Alarms of a live loop: frames missing, noise up, an observer out of its band, peaks that are new or have moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import hypot, isnan, sqrt

import numpy as np

from wfsobs.live.board import NEXT
from wfsobs.live.finding import Finding, PeakFinding
from wfsobs.live.ring import LiveFrame
from wfsobs.live.view import LiveView
from wfsobs.typing import Array

ALARM = "ALARM"
"""How the line of an alarm begins."""
MISSING = 0.01
"""Part of the frames of a second that may be missing."""
RISE, SPREADS = 1.5, 6.0
"""Noise, or the error of the next measurement, may rise to so many times its median of the minute before, and by so many standard
deviations of a second from the median."""
CALM = 0.5
"""Part of that rise below which an alarm is over."""
NORMAL = 1.4826
"""Standard deviation of normal numbers over the median of their distances from the median."""
HISTORY = 60
"""Seconds of which the medians are taken."""
FEWEST = 10
"""Seconds before the first alarm of a median."""
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
"""A peak weaker than this part of the noise of a frame is found in one minute and not in the next: it is no alarm."""


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
        self._peaks: list[tuple[PeakFinding, ...]] = []

    def look_at(self, frames: LiveFrame, first: int, ratio: int | None) -> None:
        """Judge a second of frames.

        Parameters
        ----------
        frames : LiveFrame
            The frames, each part (n, n_modes) [um].
        first : int
            Number of the first one.
        ratio : int or None
            Every so many frames an NGS measurement is due, but with the first of all; None without an NGS.
        """
        numbers = first + np.arange(len(frames.z))
        self._miss("LGS", frames.z)
        if ratio is not None:
            self._miss("NGS", frames.ngs[(numbers % ratio == 0) & (numbers > 0)])
        self._judge("noise", noise_of(frames.z))

    def judge(self, second: LiveView, observers: Sequence[str]) -> None:
        """Judge what observers of both targets have expected of a second of frames."""
        for name in observers:
            self._judge(f"error of {name}", float(np.sqrt(np.mean(second.rms(name, NEXT) ** 2))))

    def compare(self, finding: Finding) -> None:
        """Judge an identification against the one before."""
        self._peaks = [*self._peaks[-2:], distinct_peaks(finding)]
        *earlier, now = self._peaks
        for row in drift(earlier[-1], now, earlier[0] if len(earlier) > 1 else ()) if earlier else []:
            self._say(f"{ALARM} {row}")

    def _miss(self, sensor: str, due: Array) -> None:
        """Judge what has come of the measurements that were due, (n, n_modes)."""
        if len(due):
            missing = float(np.isnan(due).any(axis=1).mean())
            self._set(f"{sensor} frames missing", missing > MISSING, f"{missing:.1%} of {sensor} frames missing")

    def _judge(self, what: str, value: float) -> None:
        """Judge a number by what it has been so far; while it is raised it does not count."""
        if isnan(value):
            return
        history = self._history.setdefault(what, [])
        usual = float(np.median(history)) if len(history) >= FEWEST else value
        spread = NORMAL * float(np.median(np.abs(np.subtract(history, usual)))) if history else 0.0
        rise = max((RISE - 1.0) * usual, SPREADS * spread)
        is_active = value > usual + rise * (CALM if what in self._active else 1.0)
        self._set(what, is_active, f"{what} up: {1e3 * value:.1f} nm, it was {1e3 * usual:.1f} nm")
        if not is_active:
            history.append(value)
            del history[:-HISTORY]

    def _set(self, what: str, is_active: bool, line: str) -> None:
        if is_active and what not in self._active:
            self._active.add(what)
            self._say(f"{ALARM} {line}")
        elif not is_active and what in self._active:
            self._active.discard(what)
            self._say(f"over: {what}")


def noise_of(z: Array) -> float:
    """Estimate the white noise of frames, (n, n_modes), from their third differences [um]: slow signals leave nothing in them."""
    d = np.diff(z, n=3, axis=0)
    known = d[~np.isnan(d)]
    return float(np.sqrt(np.mean(known**2) / 20.0)) if known.size else float("nan")  # 1 + 9 + 9 + 1


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


def drift(before: Sequence[PeakFinding], now: Sequence[PeakFinding], earlier: Sequence[PeakFinding] = ()) -> list[str]:
    """Say which peaks are new, have moved or are gone.

    A line that moves in the midst of a minute is two peaks in that minute: one is new. In the next one the other is gone, and has
    moved to it if the minute before the two, `earlier`, had the one and not the other.
    """
    lines, same = [], paired_peaks(before, now)
    for peak in now:
        if (one := same.get(peak)) is None:
            lines.append(f"new peak at {peak.frequency:.2f} Hz, {1e3 * peak.rms:.1f} nm")
            continue
        std = hypot(*(max(each.frequency_std, RESOLUTION) for each in (one, peak)))
        if not isnan(std) and abs(one.frequency - peak.frequency) > SIGMAS * std:
            lines.append(f"peak moved from {one.frequency:.2f} to {peak.frequency:.2f} Hz")
    for last in before:
        if last not in same.values():
            to = _new_place(last, now, earlier)
            moved = "" if to is None else f"peak moved from {last.frequency:.2f} to {to.frequency:.2f} Hz"
            lines.append(moved or f"peak at {last.frequency:.2f} Hz is gone")
    return lines


def paired_peaks(before: Sequence[PeakFinding], now: Sequence[PeakFinding]) -> dict[PeakFinding, PeakFinding]:
    """Return peak -> the one before that it is: in its place, or else of its size and within REACH; the nearest ones first."""
    near = [
        (not _is_near(one, peak, CLOSE), abs(one.frequency - peak.frequency), peak, one)
        for peak in now
        for one in before
        if _is_near(one, peak, CLOSE) or (_is_near(one, peak, REACH) and _are_alike(one, peak))
    ]
    pairs: dict[PeakFinding, PeakFinding] = {}
    for *_, peak, one in sorted(near, key=lambda pair: pair[:2]):
        if peak not in pairs and one not in pairs.values():
            pairs[peak] = one
    return pairs


def _new_place(last: PeakFinding, now: Sequence[PeakFinding], earlier: Sequence[PeakFinding]) -> PeakFinding | None:
    """Return where a peak has gone from its last place since the minute `earlier`, which had the one and not the other."""
    was = [one for one in earlier if _is_near(one, last, CLOSE)]
    places = [
        peak
        for peak in now
        if _is_near(last, peak, REACH)
        and not any(_is_near(one, peak, CLOSE) for one in earlier)
        and any(_are_alike(one, peak) for one in was)
    ]
    return min(places, key=lambda peak: abs(peak.frequency - last.frequency), default=None)


def _is_near(one: PeakFinding, other: PeakFinding, share: float) -> bool:
    return abs(one.frequency - other.frequency) <= share * other.frequency


def _are_alike(one: PeakFinding, other: PeakFinding) -> bool:
    return other.rms <= SIZE * one.rms and one.rms <= SIZE * other.rms
