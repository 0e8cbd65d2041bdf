"""Kalman filters over a record with missing measurements: the step form of the filters, frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from wfsobs.observers.estimates import Estimates
from wfsobs.observers.kalman.spread import by_name
from wfsobs.progress import Watch
from wfsobs.record import Measurements
from wfsobs.typing import Array


class Filters(Protocol):
    """Filters of all modes in their step form."""

    @property
    def uses_ngs(self) -> bool: ...  # noqa: D102

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame, NaN where a measurement is missing."""
        ...

    def estimate(self) -> tuple[Array, Array]:
        """Return the estimates of the last frame, and their standard deviations."""
        ...


def each_frame(estimator: Filters, measurements: Measurements, watch: Watch) -> Iterator[tuple[Array, Array | None]]:
    """Yield z and the NGS frame where one is due, both (n_modes,) [um], NaN where a measurement is missing. Raises Cancelled.

    Filters that can be told how many LGS there are, are told before the frame.
    """
    z, n, stars, see_stars = measurements.z, measurements.ratio, measurements.lgs_stars, getattr(estimator, "see_stars", None)
    z_ngs = measurements.z_ngs if estimator.uses_ngs else None
    for k, row in enumerate(z):
        if k % 1000 == 0:
            watch.step(k / len(z))
        due = z_ngs is not None and n is not None and k > 0 and k % n == 0
        if stars is not None and see_stars is not None:
            see_stars(int(stars[k]))
        yield row, z_ngs[k] if z_ngs is not None and due else None


def run_frames(estimator: Filters, measurements: Measurements, watch: Watch) -> Estimates:
    """Run filters over a record with gaps: frame by frame, for all modes at the same time."""
    values, sd = [], []
    for z, ngs in each_frame(estimator, measurements, watch):
        estimator.advance(z, ngs, None)
        now, spread = estimator.estimate()
        values.append(now.copy())
        sd.append(spread)
    return Estimates(by_name(np.array(values)), by_name(np.array(sd)))
