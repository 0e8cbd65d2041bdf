"""The last seconds of a live loop: frames, estimates, errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

import numpy as np

from wfsobs.evaluation.scores import SHARE
from wfsobs.live.board import NEXT, SLOTS, slot_width
from wfsobs.live.ring import LiveFrame, Ring, Rows, merged_rows
from wfsobs.observers.base import TARGETS
from wfsobs.observers.estimates import TOTAL
from wfsobs.record import Sampling, fuse_frames
from wfsobs.typing import Array

SHARED = 0.16
"""For how long pages share what is read of a loop: from a multiple of it to the next one [s]."""


@dataclass(frozen=True)
class LiveView:
    """Consecutive frames, with what every observer makes of them.

    Attributes
    ----------
    first : int
        Number of the first one.
    dt : float
        Time between two [s].
    frames : LiveFrame
        Each part (n, n_modes) [um].
    ratio : int or None
        Frames per NGS frame; None without NGS.
    """

    first: int
    dt: float
    frames: LiveFrame
    _traces: Array
    ratio: int | None = None
    _results: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)

    def once(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return what is made of these frames, and made once for all pages that want the same; key : tells what that is."""
        if key not in self._results:
            self._results[key] = make()
        return self._results[key]

    @property
    def n(self) -> int:
        """Number of frames."""
        return len(self._traces)

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return self.frames.z.shape[1]

    @property
    def delays(self) -> Array:
        """Time from when a frame was due to when every observer had an estimate of it, (n,) [s]."""
        return self._traces[:, 1]

    def truth(self, target: str) -> Array:
        """Return the truth of a target or of both together, (n, n_modes) [um]; of the next measurement, the measurements."""
        if target == TOTAL:
            return self.frames.turbulence + self.frames.vibration
        return self.frames.z if target == NEXT else getattr(self.frames, target)

    def steps(self, observer: str) -> Array:
        """Return the times of an observer's steps, (n,) [s]; NaN while it is off."""
        return self._of(observer)[:, 0]

    def estimate(self, observer: str, target: str) -> Array:
        """Return what an observer has estimated of a target or of both together, (n, n_modes) [um]; NaN where nothing."""
        own, m = self._of(observer), self.n_modes
        if target == TOTAL:
            return own[:, 1 : 1 + m] + own[:, 1 + m : 1 + 2 * m]
        if target != NEXT:
            at = 1 + TARGETS.index(target) * m
            return own[:, at : at + m]
        out = np.full((self.n, m), np.nan)
        out[1:] = own[:-1, 1 : 1 + m] + own[:-1, 1 + m : 1 + 2 * m]
        return out

    def error(self, observer: str, target: str) -> Array:
        """Return the error of an estimate, (n, n_modes) [um]."""
        return self.estimate(observer, target) - self.truth(target)

    def rms(self, observer: str, target: str) -> Array:
        """Return the rms error, (n_modes,) [um]; NaN where there is none.

        That of the next measurement is told by the NGS where at least half of its frames are there.
        """
        return self.once(("rms", observer, target), lambda: rms_of_known(self.estimate(observer, target) - self._judge(target)))

    def _judge(self, target: str) -> Array:
        """Return what an error is against, (n, n_modes) [um]."""
        truth, n = self.truth(target), self.ratio
        if target != NEXT or n is None or np.mean(~np.isnan(self.frames.ngs).all(axis=1)) < SHARE / n:
            return truth
        return self.once("judge", lambda: fuse_frames(truth, self.frames.ngs, n))

    def _of(self, observer: str) -> Array:
        width = slot_width(self.n_modes)
        at = 2 + SLOTS.index(observer) * width
        return self._traces[:, at : at + width]


class SharedView:
    """The last seconds as they were read last, for pages that look one after the other: a reading takes milliseconds."""

    def __init__(self) -> None:
        self._turn, self._views = 0, dict[float, LiveView]()

    def look(self, read: Callable[[float], LiveView], seconds: float, *, anew: bool) -> LiveView:
        """Return the last so many seconds as they were read since the last multiple of SHARED, or read `anew`."""
        if (turn := int(monotonic() / SHARED)) != self._turn:
            self._turn, self._views = turn, {}
        if anew or seconds not in self._views:
            self._views[seconds] = read(seconds)
        return self._views[seconds]


def read_view(ring: Ring, traces: list[Rows], sampling: Sampling, seconds: float) -> LiveView:
    """Return the last so many seconds that all observers have taken."""
    first, stop = last_frames(min(rows.count for rows in traces), sampling.dt, seconds)
    return LiveView(first, sampling.dt, ring.read_frames(first, stop), merged_rows(traces, first, stop), sampling.ratio)


def last_frames(count: int, dt: float, seconds: float) -> tuple[int, int]:
    """Return the numbers of the first of the last so many seconds of frames, and of the one after the last."""
    return max(0, count - max(1, round(seconds / dt))), count


def rms_of_known(x: Array) -> Array:
    """Return the rms over rows, (n_modes,), NaN left out; NaN where there is nothing else."""
    squares = np.einsum("km,km->m", x, x)
    if len(x) and not np.isnan(squares).any():  # as mostly
        return np.sqrt(squares / len(x))
    known = ~np.isnan(x)
    n = known.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt((np.where(known, x, 0.0) ** 2).sum(axis=0) / n)
