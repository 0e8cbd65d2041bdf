"""Samples that estimates are scored on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import stdtrit

from wfsobs.record import Record
from wfsobs.typing import Array

SHARE = 0.5
"""Minimum share of the samples after the warm-up that observers in a table have in common; those that leave fewer stand apart."""


BATCHES = 20
"""Pieces of a record whose means tell how far that of the whole scatters."""


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


def batch_means(values: Array) -> Array:
    """Return the means of BATCHES pieces of values (n, ...), of fewer where there are fewer values."""
    edges = np.unique(np.linspace(0, len(values), BATCHES + 1).astype(int))
    return (np.add.reduceat(values, edges[:-1], axis=0).T / np.diff(edges)).T


def scatter_of_mean(values: Array, independent: bool = False) -> tuple[Array, Array, Array]:
    """Return the means of columns of values (n, k), their standard deviations and degrees of freedom, each (k,).

    Values that are not independent are batch means: slow signals make neighbours alike, which counts as fewer of them, those of a
    first-order autoregression with their correlation (Law and Kelton, Simulation Modeling and Analysis, ch. 9). Fewer than three
    of them say nothing, and fewer than two of any: NaN.
    """
    n, mean = len(values), values.mean(axis=0)
    if n < (2 if independent else 3):
        return mean, np.full_like(mean, np.nan), np.ones_like(mean)
    deviation = values - mean
    power = (deviation**2).sum(axis=0)
    if independent:
        return mean, np.sqrt(power / (n - 1) / n), np.full_like(mean, n - 1.0)
    alike = np.divide((deviation[1:] * deviation[:-1]).sum(axis=0), power, out=np.zeros_like(power), where=power > 0)
    alike = np.maximum(alike + 1.0 / n, 0.0)  # the estimate of a correlation from n values is low by about 1 / n
    effective = np.maximum(n * (1.0 - alike) / (1.0 + alike), 2.0)
    return mean, np.sqrt(power / (n - 1) / effective), effective - 1.0


def rms_interval(rms: float, squares: Array) -> tuple[float, float] | None:
    """Return the interval of an rms at 95 % confidence, by the scatter of its logarithm in batch means of squares (n, 1).

    None where there is none: of too few, or of an error that is zero.
    """
    mean, deviation, freedom = (float(x[0]) for x in scatter_of_mean(squares))
    reach = 0.5 * float(stdtrit(freedom, 0.975)) * deviation / mean if mean > 0 else np.nan
    low, high = (rms * np.exp([-reach, reach])).tolist()
    return (low, high) if np.isfinite(reach) else None
