"""Error against time: the effect of an event, and the recovery time of each observer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wfsobs.observers.estimates import Estimate
from wfsobs.record import Record
from wfsobs.typing import Array

BACK = 1.1
"""An observer has recovered where its error is at most this many times that before the event."""


def running_rms(record: Record, estimate: Estimate, window: float) -> Array:
    """Compute the rms of the error over the last `window` at every step.

    Parameters
    ----------
    record : Record
        Record with truth.
    estimate : Estimate
        Estimate of one target.
    window : float
        Length of the window [s].

    Returns
    -------
    Array
        (n_steps, n_modes) [um]. Steps without estimate or truth do not count; NaN where none counts, and before the first window
        is complete.

    Raises
    ------
    ValueError
        The record has no truth for the target.
    """
    truth = record.truth(estimate.target)
    if truth is None:
        raise ValueError(f"the record has no true {estimate.target}")
    return trailing_rms(estimate.values - truth, max(round(window / record.dt), 1))


def trailing_rms(x: Array, n: int) -> Array:
    """Return the rms of x[k-n+1] ... x[k] at every k, (n_steps, n_columns); NaN do not count, and where k < n - 1 it is NaN."""
    known = ~np.isnan(x)
    count = trailing_sum(known.astype(float), n)
    mean = np.divide(trailing_sum(np.where(known, x, 0.0) ** 2, n), count, out=np.full(x.shape, np.nan), where=count > 0)
    mean[: n - 1] = np.nan
    return np.sqrt(mean)


def trailing_sum(x: Array, n: int) -> Array:
    """Return x[k-n+1] + ... + x[k] at every k, zeros before the start; same shape as x (n_steps, n_columns).

    It is put together of sums over 1, 2, 4, ... steps: nothing is subtracted, so that a large error leaves no trace in the sums
    after it.
    """
    total, late, width = np.zeros_like(x), 0, 1
    while n and late < len(x):
        if n & 1:
            total[late:] += x[: len(x) - late]
            late += width
        x = x + np.concatenate([np.zeros_like(x[:width]), x[:-width]])
        n, width = n >> 1, 2 * width
    return total


@dataclass
class PooledRms:
    """Running rms of several records of one length together: root of the mean of squares, without NaN."""

    total: Array | float = 0.0
    count: Array | int = 0

    def add(self, running: Array) -> None:
        """Add a record's running rms, (n_steps, n_modes)."""
        known = ~np.isnan(running)
        self.total = self.total + np.where(known, running, 0.0) ** 2
        self.count = self.count + known

    @property
    def rms(self) -> Array:
        """Pooled rms, (n_steps, n_modes), NaN where no record has any."""
        total, count = np.asarray(self.total), np.asarray(self.count)
        return np.sqrt(np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0))


@dataclass(frozen=True)
class Recovery:
    """Effect of an event on an observer in one mode.

    Attributes
    ----------
    start : float
        Start of the event [s].
    before : float
        Rms of the error before it [um].
    worst : float
        Maximum running rms from it to the next [um].
    last : float
        Running rms at the end of that time [um].
    back : float or None
        Recovery time: until the running rms is within 10 % of that before, and stays so until the next event [s]; None if never.
    """

    start: float
    before: float
    worst: float
    last: float
    back: float | None


def recovery(running: Array, dt: float, starts: Sequence[float], window: float, warm_up: float) -> list[Recovery | None]:
    """Measure the effect of each event on a running rms.

    The error before an event is the rms over the second half of the time since the event before, or the warm-up.

    Parameters
    ----------
    running : Array
        Running rms, (n_steps,) [um].
    dt : float
        Time step [s].
    starts : sequence of float
        Starts of the events [s]; simultaneous events count as one.
    window : float
        Window of the running rms [s].
    warm_up : float
        Start of the record that does not count [s].

    Returns
    -------
    list of Recovery or None
        One per event; None where there is nothing before or after it.
    """
    times = sorted(set(starts))
    out: list[Recovery | None] = []
    for before, start, after in zip([warm_up, *times], times, [*times[1:], running.size * dt], strict=False):
        first, at, end = (min(round(t / dt), running.size) for t in (0.5 * (before + start) + window, start, after))
        quiet, then = running[min(first, max(at - 1, 0)) : at], running[at:end]
        quiet, known = quiet[~np.isnan(quiet)], ~np.isnan(then)
        if not quiet.size or not known.any():
            out.append(None)
            continue
        settled = float(np.sqrt(np.mean(quiet**2)))
        late = np.flatnonzero(known & (then > BACK * settled))
        back = 0.0 if not late.size else float((late[-1] + 1) * dt) if late[-1] + 1 < then.size else None
        out.append(Recovery(start, settled, float(then[known].max()), float(then[known][-1]), back))
    return out
