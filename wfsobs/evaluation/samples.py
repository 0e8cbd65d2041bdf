"""Samples that estimates are scored on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wfsobs.record import Record
from wfsobs.typing import Array

SHARE = 0.5
"""Minimum share of the samples after the warm-up that observers in a table have in common; those that leave fewer stand apart."""


def common_samples(samples: Sequence[Array]) -> list[tuple[Array, bool]]:
    """Select the samples on which estimates are scored.

    Starting with the estimate with most samples, every estimate takes part that leaves SHARE of the samples in common. These are
    scored on the common samples, every other one on its own, apart.

    Parameters
    ----------
    samples : sequence of Array
        Samples that each estimate has, bool (n,).

    Returns
    -------
    list of (Array, bool)
        Samples of each estimate, and whether it stands apart.
    """
    if not samples:
        return []
    order = sorted(range(len(samples)), key=lambda i: -samples[i].sum())
    shared, apart = samples[order[0]], set()
    for i in order[1:]:
        both = shared & samples[i]
        if both.sum() >= SHARE * samples[order[0]].sum():
            shared = both
        else:
            apart.add(i)
    return [(samples[i] if i in apart else shared, i in apart) for i in range(len(samples))]


def samples_after(record: Record, warm_up: float) -> Array:
    """Return which steps are after the warm-up [s]."""
    return np.arange(record.n_steps) >= round(warm_up / record.dt)


def stretch_of(samples: Array, dt: float) -> tuple[float, float]:
    """Return the time [s] of the first sample and of the end of the last."""
    return float(np.argmax(samples) * dt), float((samples.size - np.argmax(samples[::-1])) * dt)
