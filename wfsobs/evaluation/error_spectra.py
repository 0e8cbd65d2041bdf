"""Spectra of an estimate and of its error, and the variance above a frequency."""

from __future__ import annotations

import numpy as np

from wfsobs.record import Record
from wfsobs.signal.welch import welch_psd
from wfsobs.typing import Array


def scored_samples(record: Record, truth: Array, value: Array, warm_up: float) -> tuple[Array, Array]:
    """Return (truth, estimate) without the warm-up [s] and without the steps where the estimate is NaN."""
    start = round(warm_up / record.dt)
    known = ~np.isnan(value[start:]) & ~np.isnan(truth[start:])
    return truth[start:][known], value[start:][known]


def spectra(record: Record, target: str, values: Array, warm_up: float) -> tuple[Array, Array, Array] | None:
    """Compute the spectra of an estimate and of its error.

    Over all samples after the warm-up [s] that have an estimate; without a truth the error is zero.

    Parameters
    ----------
    record : Record
        Record, with the truth where there is one.
    target : str
        "turbulence" or "vibration".
    values : Array
        Estimate, (n_steps, n_modes) [um].
    warm_up : float
        Start of the record that does not count [s].

    Returns
    -------
    tuple of Array or None
        Frequency [Hz], density of the estimate and of its error [um^2/Hz], a column per mode; None with too few samples.
    """
    truth = record.truth(target)
    truth = values if truth is None else truth
    columns = [scored_samples(record, truth[:, mode], values[:, mode], warm_up) for mode in range(record.n_modes)]
    shortest = min(true.size for true, _ in columns)
    if shortest < 16:
        return None
    true = np.column_stack([t[-shortest:] for t, _ in columns])
    value = np.column_stack([v[-shortest:] for _, v in columns])
    frequency, density = welch_psd(np.hstack([value, value - true]), record.dt)
    signal, error = np.hsplit(density, 2)
    return frequency, signal, error


def band_rms(frequency: Array, density: Array, low: float, high: float) -> float:
    """Return the root of the variance at the frequencies [Hz] from `low` to `high`, both included; density (n,)."""
    inside = (frequency >= low) & (frequency <= high)
    return float(np.sqrt(density[inside].sum() * (frequency[1] - frequency[0])))


def cumulative_rms(frequency: Array, density: Array) -> Array:
    """Return the root of the variance above each frequency, from high to low (the AO habit); same shape as `density`."""
    df = frequency[1] - frequency[0]
    return np.sqrt(np.cumsum(density[::-1], axis=0)[::-1] * df)
