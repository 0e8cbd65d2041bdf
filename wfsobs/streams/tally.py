"""Statistics of an attached observer: frames, latencies, errors of the next measurement; each second and in all."""

from __future__ import annotations

from typing import Any

import numpy as np

from wfsobs.latencies import Latencies
from wfsobs.typing import Array

SLOW = 1.5
"""A frame is late if it comes more than so many frame times after the one before."""


class _Span:
    """What is counted over a stretch of time."""

    def __init__(self) -> None:
        self.frames = self.missing = self.late = self.n_scored = 0
        self.latencies = Latencies()
        self.error = self.size = 0.0

    def quantile(self, share: float) -> float | None:
        """Return a quantile of the latencies [us]."""
        return round(self.latencies.quantile(share) * 1e6, 1) if self.frames else None

    def rms(self, squares: float) -> float | None:
        """Return the rms of a sum of squares [nm]."""
        return round(1e3 * float(np.sqrt(squares / self.n_scored)), 3) if self.n_scored else None


class Tally:
    """Statistics.

    Parameters
    ----------
    dt : float
        Time between two frames by the design of the observer [s].

    Attributes
    ----------
    torn, stuck : int
        Frames that were written without an end; times that no frame came.
    """

    def __init__(self, dt: float):
        self.torn = self.stuck = 0
        self._dt, self._last = dt, None
        self._second, self._all = _Span(), _Span()
        self._first: float | None = None

    def add(self, arrival: float, end: float, missing: int, z: Array, error: Array) -> None:
        """Count a frame: when it was there and when its estimate was out [s], frames missing before it, measurement and error."""
        late = self._last is not None and arrival - self._last > SLOW * self._dt * (1 + missing)
        known = np.isfinite(error)
        for span in (self._second, self._all):
            span.frames += 1
            span.missing += missing
            span.late += late
            span.latencies.add(end - arrival)
            span.n_scored += int(known.sum())
            span.error += float((error[known] ** 2).sum())
            span.size += float((z[known] ** 2).sum())
        self._first, self._last = self._first or arrival, arrival

    @property
    def rate(self) -> float | None:
        """Frames per second that were sent, missing ones too [Hz]."""
        if self._first is None or self._last is None or self._last <= self._first:
            return None
        return (self._all.frames - 1 + self._all.missing) / (self._last - self._first)

    def line(self, reason: str) -> str:
        """Return the line of the last second, and begin the next one."""
        span, self._second = self._second, _Span()
        if not span.frames:
            return f"no frame; output: {reason or 'on'}"
        error, size = span.rms(span.error), span.rms(span.size)
        scores = "" if error is None else f"; next measurement: {error:.1f} of {size:.1f} nm"
        return (
            f"{span.frames} frames, {span.missing} missing, {span.late} late; "
            f"{span.quantile(0.5):.0f}, {span.quantile(0.999):.0f} us (p50, p99.9){scores}; output: {reason or 'on'}"
        )

    def summary(self) -> dict[str, Any]:
        """Return the statistics since the start."""
        span = self._all
        return {
            "frames": span.frames,
            "missing": span.missing,
            "late": span.late,
            "torn": self.torn,
            "stuck": self.stuck,
            "rate_hz": None if self.rate is None else round(self.rate, 2),
            "p50_us": span.quantile(0.5),
            "p99_9_us": span.quantile(0.999),
            "next_nm": span.rms(span.error),
            "rms_nm": span.rms(span.size),
        }
