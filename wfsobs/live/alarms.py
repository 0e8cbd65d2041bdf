"""Alarms of a live loop: frames missing, noise up, an observer out of its band, peaks that are new or have moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isnan

import numpy as np

from wfsobs.live.board import NEXT
from wfsobs.live.finding import Finding
from wfsobs.live.paced import ALARM
from wfsobs.live.peaks import peak_changes
from wfsobs.live.ring import LiveFrame
from wfsobs.live.view import LiveView
from wfsobs.typing import Array

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


class Alarms:
    """What is not as it was; an alarm is told once when it begins, and once when it is over.

    Parameters
    ----------
    say : callable
        Receives the fields of an event but its frame.
    """

    def __init__(self, say: Callable[..., None]):
        self._say = say
        self._history: dict[tuple[str, str], list[float]] = {}
        self._active: set[tuple[str, str]] = set()
        self._findings: list[Finding] = []

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
            self._judge("error of {}", float(np.sqrt(np.mean(second.rms(name, NEXT) ** 2))), name)

    def compare(self, finding: Finding) -> None:
        """Judge an identification against those before."""
        self._findings = [*self._findings[-3:], finding]
        for what, detail in peak_changes(self._findings):
            self._say(what, detail=detail, kind=ALARM)

    def _miss(self, sensor: str, due: Array) -> None:
        """Judge what has come of the measurements that were due, (n, n_modes)."""
        if len(due):
            missing = float(np.isnan(due).any(axis=1).mean())
            self._set(f"{sensor} frames missing", missing > MISSING, f"{missing:.1%} of {sensor} frames missing")

    def _judge(self, what: str, value: float, about: str = "") -> None:
        """Judge a number, of an observer if `about` it, by what it has been so far; while it is raised it does not count."""
        if isnan(value):
            return
        history = self._history.setdefault((what, about), [])
        usual = float(np.median(history)) if len(history) >= FEWEST else value
        spread = NORMAL * float(np.median(np.abs(np.subtract(history, usual)))) if history else 0.0
        rise = max((RISE - 1.0) * usual, SPREADS * spread)
        is_active = value > usual + rise * (CALM if (what, about) in self._active else 1.0)
        self._set(what, is_active, f"{what} up", about, f": {1e3 * value:.1f} nm, it was {1e3 * usual:.1f} nm")
        if not is_active:
            history.append(value)
            del history[:-HISTORY]

    def _set(self, what: str, is_active: bool, now: str, about: str = "", detail: str = "") -> None:
        key = what, about
        if is_active and key not in self._active:
            self._active.add(key)
            self._say(now, about=about, detail=detail, kind=ALARM)
        elif not is_active and key in self._active:
            self._active.discard(key)
            self._say(f"over: {what}", about=about)


def noise_of(z: Array) -> float:
    """Estimate the white noise of frames, (n, n_modes), from their third differences [um]: slow signals leave nothing in them."""
    d = np.diff(z, n=3, axis=0)
    known = d[~np.isnan(d)]
    return float(np.sqrt(np.mean(known**2) / 20.0)) if known.size else float("nan")  # 1 + 9 + 9 + 1
