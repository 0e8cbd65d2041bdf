"""What is counted of a stream that is followed: frames, latencies, and how far off the next measurement was."""

from __future__ import annotations

from typing import Any

import numpy as np

from wfsobs.latencies import Latencies
from wfsobs.typing import Array

SLOW = 1.5
"""A frame is late if it comes more than so many frame times after the one before."""
RATE_ERROR = 0.05
"""Part of the rate by which a loop may be off the design."""
NANOMETRE = 1e-6
"""What stands for it in a histogram, which then goes from 0.1 nm to 1 cm."""


class _Span:
    """What is counted over a stretch of time."""

    def __init__(self) -> None:
        self.frames = self.missing = self.late = self.out_of_band = 0
        self.latencies, self.errors, self.sizes = Latencies(), Latencies(), Latencies()

    def quantile(self, share: float) -> float | None:
        """Return a quantile of the latencies [us]."""
        return round(self.latencies.quantile(share) * 1e6, 1) if self.frames else None

    def medians(self) -> tuple[float | None, float | None]:
        """Return the medians of the magnitudes of errors and of what was measured [nm]; None where nothing was predicted."""
        found = [one.quantile(0.5) / NANOMETRE for one in (self.errors, self.sizes)]
        return (None, None) if np.isnan(found[0]) else (round(found[0], 3), round(found[1], 3))


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
        self._is_off_rate = False

    def add(self, arrival: float, end: float, missing: int, z: Array, error: Array, is_out: bool = False) -> None:
        """Count a frame.

        Parameters
        ----------
        arrival, end : float
            When it was there and when its estimate was out [s].
        missing : int
            Frames missing before it.
        z, error : Array
            Measurement, and how far off its prediction was, (n_modes,) [um]; NaN where there is none.
        is_out : bool
            Whether a measurement was not taken.
        """
        late = self._last is not None and arrival - self._last > SLOW * self._dt * (1 + missing)
        known = np.isfinite(error)
        errors, sizes = (1e3 * NANOMETRE * np.abs(x[known]) for x in (error, z))
        for span in (self._second, self._all):
            span.frames += 1
            span.missing += missing
            span.late += late
            span.out_of_band += is_out
            span.latencies.add(end - arrival)
            span.errors.add(errors)
            span.sizes.add(sizes)
        self._first, self._last = self._first or arrival, arrival

    @property
    def rate(self) -> float | None:
        """Frames per second that were sent, missing ones too [Hz]."""
        if self._first is None or self._last is None or self._last <= self._first:
            return None
        return (self._all.frames - 1 + self._all.missing) / (self._last - self._first)

    def find_rate_error(self) -> str:
        """Return once that the loop runs at another rate than the observer is designed for; "" at other times."""
        rate = self.rate
        if rate is None or self._is_off_rate or abs(rate * self._dt - 1.0) <= RATE_ERROR:
            return ""
        self._is_off_rate = True
        return f"{rate:.0f} frames per second, the observer is designed for {1.0 / self._dt:g}"

    def line(self, reason: str) -> str:
        """Return the line of the last second, and begin the next one."""
        span, self._second = self._second, _Span()
        if not span.frames:
            return f"no frame; output: {reason or 'on'}"
        error, size = span.medians()
        scores = "" if error is None else f"; next measurement: {error:.1f} of {size:.1f} nm (medians)"
        return (
            f"{span.frames} frames, {span.missing} missing, {span.out_of_band} with outliers, {span.late} late; "
            f"{span.quantile(0.5):.0f}, {span.quantile(0.999):.0f} us (p50, p99.9){scores}; output: {reason or 'on'}"
        )

    def summary(self) -> dict[str, Any]:
        """Return the statistics since the start."""
        span = self._all
        error, size = span.medians()
        return {
            "frames": span.frames,
            "missing": span.missing,
            "out_of_band": span.out_of_band,
            "late": span.late,
            "torn": self.torn,
            "stuck": self.stuck,
            "rate_hz": None if self.rate is None else round(self.rate, 2),
            "p50_us": span.quantile(0.5),
            "p99_9_us": span.quantile(0.999),
            "next_median_nm": error,
            "median_nm": size,
        }
