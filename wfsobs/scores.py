"""How good an estimate is: error, lag, spectra, all after the warm-up and where both signals exist."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import welch

from wfsobs.arrays import Array
from wfsobs.observers.base import Estimate
from wfsobs.record import Record

MAX_LAG = 0.025
"""Lags beyond this [s] are not looked for."""


@dataclass(frozen=True)
class Score:
    """One row of the RMS table: one observer, target and mode.

    rms, truth_rms [um]; normalised_rms = rms / truth_rms, None where the truth is zero; lag [s], positive if the
    estimate is late, None where it is constant; seconds_per_step: computing time [s] per step and mode.
    """

    observer: str
    target: str
    mode: str
    rms: float
    truth_rms: float
    normalised_rms: float | None
    lag: float | None
    seconds_per_step: float


def score(record: Record, estimate: Estimate, warm_up: float, mode_names: list[str]) -> list[Score]:
    """One Score per mode; none where the record has no truth for the target or no sample is left."""
    truth = record.truth(estimate.target)
    if truth is None:
        return []
    out = []
    for mode, name in enumerate(mode_names):
        true, value = scored_samples(record, truth[:, mode], estimate.values[:, mode], warm_up)
        if true.size == 0:
            continue
        error, scale = rms(value - true), rms(true)
        out.append(Score(
            estimate.observer, estimate.target, name, error, scale, error / scale if scale > 0 else None,
            lag(true, value, record.dt), estimate.seconds_per_step,
        ))
    return out


def scored_samples(record: Record, truth: Array, value: Array, warm_up: float) -> tuple[Array, Array]:
    """(truth, estimate) without the warm-up [s] and without the steps where the estimate is NaN."""
    start = round(warm_up / record.dt)
    known = ~np.isnan(value[start:])
    return truth[start:][known], value[start:][known]


def rms(x: Array) -> float:
    """Root of the mean square; the mean stays in."""
    return float(np.sqrt(np.mean(np.square(x)))) if x.size else 0.0


def lag(truth: Array, value: Array, dt: float) -> float | None:
    """Delay of `value` behind `truth` [s]: the peak of their cross-correlation, between samples by a parabola
    through its three highest points. Positive is late; None where either is constant."""
    if np.ptp(truth) == 0 or np.ptp(value) == 0:
        return None
    reach = min(round(MAX_LAG / dt), truth.size - 1)
    around = np.correlate(np.pad(value - value.mean(), reach), truth - truth.mean(), "valid")
    peak = int(np.argmax(around))
    shift = 0.0
    if 0 < peak < around.size - 1:
        before, at, after = around[peak - 1 : peak + 2]
        curvature = before - 2.0 * at + after
        shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return float((peak - reach + shift) * dt)


def welch_psd(x: Array, dt: float, resolution: float = 0.5) -> tuple[Array, Array]:
    """Frequencies [Hz] and one-sided power spectral density [unit^2/Hz] of x (n, n_columns): Welch's average of
    half-overlapping Hann windows of 1 / resolution seconds, or of the whole record if that is shorter."""
    window = min(round(1.0 / (resolution * dt)), x.shape[0])
    frequency, density = welch(x, fs=1.0 / dt, nperseg=window, axis=0, detrend="constant")
    return frequency, density


def cumulative_rms(frequency: Array, density: Array) -> Array:
    """Root of the variance above each frequency, from high to low (the AO habit); same shape as `density`."""
    df = frequency[1] - frequency[0]
    return np.sqrt(np.cumsum(density[::-1], axis=0)[::-1] * df)
