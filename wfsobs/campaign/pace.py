"""How fast the batches of a campaign come, and from when on it says something that none does."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

LATEST = 20
"""Batches by which the time left is estimated."""
TIMES = 3.0
"""How much longer than the longest batch a silence has to be to say something."""
LEAST = 10.0
"""The shortest silence that says something [s]: batches are made to take 3 s, and starting processes takes some."""
UNKNOWN = 300.0
"""The shortest one where it is not known what a batch takes [s]."""


class WrittenBatch(NamedTuple):
    """A batch: when it was written [s since 1970], host and process that did so, and its number of runs."""

    time: float
    worker: tuple[str, int]
    n_runs: int


@dataclass(frozen=True)
class BatchPace:
    """What is known of the pace.

    Attributes
    ----------
    last : float
        When the last batch was written, or the campaign was started after that [s since 1970]; NaN before the first batch.
    patience : float
        Silence that is clearly longer than what a batch has taken so far [s].
    seconds_per_run : float
        By the latest batches [s]; NaN where not known.
    """

    last: float
    patience: float
    seconds_per_run: float

    def silence(self, now: float) -> float:
        """Return for how long no batch has come, if that is clearly longer than a batch has taken [s]; else 0."""
        return now - self.last if now - self.last > self.patience else 0.0

    def seconds_left(self, n_runs: int, now: float) -> float:
        """Return about how long so many runs take [s]; NaN where not known, or where nothing comes."""
        return np.nan if self.silence(now) else n_runs * self.seconds_per_run


def measure_pace(batches: Iterable[WrittenBatch], start: float, now: float) -> BatchPace:
    """Measure the pace by the times at which batches were written.

    What a batch takes is the time since the one before of the same process, of the first one that since the start. After a
    silence that says something the rate is measured anew.

    Parameters
    ----------
    batches : iterable of WrittenBatch
        All that are known.
    start : float
        When the campaign was started the last time [s since 1970]; left out where it is later than now, by another clock.
    now : float
        The time [s since 1970].
    """
    longest, last, before = 0.0, np.nan, dict[tuple[str, int], float]()
    stretch: list[WrittenBatch] = []
    for batch in sorted(batches):
        if batch.time - last > _patience(longest):
            stretch, before = [], {}
        if batch.worker in before:
            longest = max(longest, batch.time - before[batch.worker])
        elif not last >= start and start <= batch.time:
            longest = max(longest, batch.time - start)
        stretch.append(batch)
        before[batch.worker] = last = batch.time
    latest, per_run = stretch[-LATEST:], np.nan
    if len(latest) > 1 and latest[-1].time > latest[0].time:
        per_run = (latest[-1].time - latest[0].time) / sum(batch.n_runs for batch in latest[1:])
    return BatchPace(max(last, start) if last < start <= now else last, _patience(longest), per_run)


def _patience(longest: float) -> float:
    return max(LEAST, TIMES * longest) if longest else UNKNOWN
