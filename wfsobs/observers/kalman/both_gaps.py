"""The model of a window of both sensors in which measurements are missing, for the adaptive multi-rate filter."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from wfsobs.observers.kalman.both_window import DECIMALS, BothModel, Lengths, error_process, fit_both
from wfsobs.observers.kalman.window_model import FEWEST, LONG, is_enough, last_long_gap
from wfsobs.spectral.missing import MissingSamples
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.periodogram import periodogram_frequencies
from wfsobs.spectral.quick import quick_spectrum, quick_spectrum_of_samples
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.observers.kalman.adaptive import Adaptive


def has_gaps(v: Array, ratio: int) -> bool:
    """Return whether a measurement of a window v (n, 2) of LGS and NGS, whole frames, is missing."""
    return bool(np.isnan(v[:, 0]).any() or np.isnan(v[ratio - 1 :: ratio, 1]).any())


def behind_gaps(v: Array, lengths: Lengths, least: int) -> Array | None:
    """Return the whole frames of v (n, 2) behind its last long gap; None if they are too few, or too few were measured.

    least : minimum number of steps where a model is in charge that holds, else FEWEST of the shortest window do
    """
    ratio, long = lengths.ratio, LONG * lengths.window
    start = max(last_long_gap(v[:, 0], long), ratio * last_long_gap(v[ratio - 1 :: ratio, 1], long / ratio))
    v = v[-(-start // ratio) * ratio :]
    is_long = len(v) >= max(least, FEWEST * lengths.window)
    return v if is_long and is_enough(v[:, 0]) and is_enough(v[ratio - 1 :: ratio, 1]) else None


def identify_both_with_gaps(
    v: Array, ratio: int, dt: float, settings: Adaptive, last: BothModel
) -> tuple[BothModel, Array] | None:
    """Identify the model of v (n, 2), NaN where missing, by short gaps alone.

    Returns
    -------
    tuple or None
        The model and v with missing measurements replaced by their expectation; None where no filter can be found.
    """
    v = np.round(v, DECIMALS)
    lost, frames = np.isnan(v[:, 0]), v[ratio - 1 :: ratio, 1]
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            z = _fill_gaps(v[:, 0], dt, settings, last)
            means = z.reshape(-1, ratio).mean(axis=1)
            difference = np.where(lost.reshape(-1, ratio).all(axis=1), np.nan, means - frames)
            error, difference = _spectrum_of(difference, dt * ratio, settings, last)
            model = fit_both(z, error, ratio, settings, last.spectrum, float(1.0 - lost.mean()))
    except (ValueError, ArithmeticError):
        return None
    whole = np.column_stack([z, np.zeros(len(z))])
    whole[ratio - 1 :: ratio, 1] = np.where(np.isnan(frames), means - difference, frames)
    return model, whole


def _fill_gaps(z: Array, dt: float, settings: Adaptive, last: BothModel) -> Array:
    """Return z with its missing samples replaced by their expectation for the last model."""
    samples, level = MissingSamples(np.isnan(z), dt), np.nanmean(z)
    if not samples.any:
        return z
    if last.spectrum is None or last.error is None:
        return quick_spectrum_of_samples(z, dt, settings.peak_count, settings.lowest, None)[1]
    f = periodogram_frequencies(len(z), dt)
    S = last.spectrum.psd(f) + sum(e.psd(f) for e in error_process(last.error, dt))
    return samples.fill(z - level, S) + level


def _spectrum_of(difference: Array, dt: float, settings: Adaptive, last: BothModel) -> tuple[Spectrum, Array]:
    """Return the spectrum of the difference of the sensors, and the difference without gaps."""
    if np.isnan(difference).any():
        return quick_spectrum_of_samples(difference, dt, 0, settings.lowest, last.error)
    return quick_spectrum(difference, dt, 0, settings.lowest, last.error), difference
