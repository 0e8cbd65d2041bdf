"""The model of a window of measurements, for the adaptive Kalman filter: what has been identified, and as numbers to save."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.mode_filter import ModeFilter
from wfsobs.observers.kalman.single import MIN_NOISE, steady_mode
from wfsobs.record import RecordError
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.signal.statespace import disturbance_model
from wfsobs.spectral.missed import missed_rms
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.quick import SHORTEST, quick_spectrum, quick_spectrum_of_samples
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.observers.kalman.adaptive import Adaptive

STILL = PeriodicFilter([(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((2, 1)), np.zeros((2, 1)))])
"""The filter of white noise: nothing moves."""

LONG = 0.05
"""Gap over the window from which on the samples before it are left out: what is far above noise is not known in it."""
FEWEST, LEAST = 0.75, 0.5
"""Minimum samples behind the last long gap, over the window; minimum measured share of them."""


def lengths(settings: Adaptive, dt: float) -> tuple[int, int]:
    """Return window and interval [steps]. Raises RecordError for a window of too few samples."""
    window = round(settings.window / dt)
    if window < SHORTEST:
        raise RecordError(f"adaptive.window = {settings.window:g}: takes {SHORTEST * dt:g} s or more, {SHORTEST} samples")
    return window, max(round(settings.interval / dt), 1)


class WindowModel(NamedTuple):
    """What has been identified last: the newest fit, and the spectrum that the filter in charge is of; None before the first.

    mode   : that filter; None where nothing moves
    hidden_rms : rms of the vibration that may be in the window and in none of its lines [um]
    """

    fit: Spectrum | None
    spectrum: Spectrum | None
    mode: ModeFilter | None
    hidden_rms: float = 0.0

    @property
    def filter(self) -> PeriodicFilter:
        """The filter, z -> turbulence, vibration."""
        return STILL if self.mode is None else self.mode.gains.filter(self.mode.model.output_rows(TARGETS))


NOT_YET = WindowModel(None, None, None)


def identify_window(z: Array, dt: float, settings: Adaptive, last: WindowModel) -> WindowModel:
    """Identify the model of a window z (n,); where it or its filter cannot be found, the last filter stays."""
    fit = last.fit
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            fit = quick_spectrum(z, dt, settings.peak_count, settings.lowest, fit)
            return WindowModel(fit, fit, mode_of(fit), missed_rms(fit, z, settings.lowest))
    except (ValueError, ArithmeticError):
        return WindowModel(fit, last.spectrum, last.mode, last.hidden_rms)


def identify_with_gaps(z: Array, dt: float, settings: Adaptive, last: WindowModel) -> tuple[WindowModel, Array] | None:
    """Identify the model of a window z (n,), NaN where a sample is missing.

    Returns
    -------
    tuple or None
        The model and the samples behind the last long gap, with missing ones replaced by their expectation; None where they are
        too few, or no filter can be found, and the one in charge goes on.
    """
    n, z = len(z), z[last_long_gap(z, LONG * len(z)) :]
    if len(z) < max(FEWEST * n, SHORTEST) or not is_enough(z):
        return None
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            fit, whole = quick_spectrum_of_samples(z, dt, settings.peak_count, settings.lowest, last.fit)
            return WindowModel(fit, fit, mode_of(fit), missed_rms(fit, whole, settings.lowest)), whole
    except (ValueError, ArithmeticError):
        return None


def is_enough(z: Array) -> bool:
    """Return whether as many samples as an identification takes are there, not NaN."""
    return bool(np.isnan(z).mean() <= 1.0 - LEAST)


def last_long_gap(z: Array, most: float) -> int:
    """Return where the last gap of more than `most` samples ends, 0 without one."""
    bounds = np.concatenate([[-1], np.flatnonzero(~np.isnan(z)), [len(z)]])
    ends = bounds[1:][np.diff(bounds) - 1 > most]
    return int(ends[-1]) if ends.size else 0


def mode_of(spectrum: Spectrum) -> ModeFilter | None:
    """Return the steady-state filter of a spectrum, None where nothing moves. Raises ValueError where there is none."""
    if not spectrum.processes:
        return None
    model = disturbance_model(spectrum.continuum, spectrum.resonances)
    return steady_mode(model, max(spectrum.noise, MIN_NOISE))


def pack_spectrum(spectrum: Spectrum | None, rows: int) -> Array:
    """Return a spectrum as numbers, (rows, 4), NaN where there are none.

    Noise with omega, damping and rms of the background; then these three, and a third corner, of turbulence and resonances.
    """
    out = np.full((rows, 4), np.nan)
    if spectrum is not None:
        out[0, 0], background = spectrum.noise, spectrum.background
        if background is not None:
            out[0, 1:] = background.omega, background.damping, background.rms
        for row, process in zip(out[1:], (spectrum.turbulence, *spectrum.resonances), strict=False):
            if process is not None:
                row[:3] = process.omega, process.damping, process.rms
                row[3] = getattr(process, "corner", np.nan)
    return out


def unpack_spectrum(table: Array, dt: float) -> Spectrum | None:
    """Return the spectrum of these numbers."""
    if np.isnan(table[0, 0]):
        return None
    processes = [None if np.isnan(row[0]) else _process(row, dt) for row in table[1:]]
    resonances = tuple(p for p in processes[1:] if isinstance(p, Ar2))
    omega, damping, rms = table[0, 1:].tolist()
    background = None if np.isnan(omega) else Ar2(omega, damping, rms, dt)
    return Spectrum(float(table[0, 0]), dt, processes[0], resonances, background)


def _process(row: Array, dt: float) -> Ar2 | Ar3:
    omega, damping, rms, corner = row.tolist()
    return Ar2(omega, damping, rms, dt) if np.isnan(corner) else Ar3(omega, damping, corner, rms, dt)
