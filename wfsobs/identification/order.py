"""The smooth part of the spectrum of a mode: turbulence of second or third order, with or without a coloured background."""

from __future__ import annotations

from dataclasses import replace
from math import pi

from wfsobs.identification.continuum import is_continuum
from wfsobs.identification.resonances import is_peak
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.spectral import background
from wfsobs.spectral.background import with_first_guess
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.periodogram import Cells
from wfsobs.spectral.whittle import fit_spectrum, spectrum_negative_log_likelihood

WORTH = 6.0
"""Minimum gain of log-likelihood by the third corner: noise gains as much with a probability of 0.05 % (chi squared of 12)."""
STARTS = (1.5, 6.0)
"""Third corners, over the first two, at which a fit starts."""
APART = 5.0
"""Minimum corner of a background over that of turbulence."""


def choose_order(spectrum: Spectrum, cells: Cells, third: bool = False) -> Spectrum:
    """Return a fitted spectrum with turbulence of second order, or of third where that is worth it or asked for."""
    t = spectrum.turbulence
    if t is None or (third and isinstance(t, Ar3)):
        return spectrum
    if isinstance(t, Ar3):
        lower, higher = _smooth(replace(spectrum, turbulence=Ar2(t.omega, t.damping, t.rms, t.dt)), cells), spectrum
    else:
        starts = [replace(spectrum, turbulence=Ar3(t.omega, t.damping, k * t.omega, t.rms, t.dt)) for k in STARTS]
        lower, higher = (
            spectrum,
            min((_smooth(s, cells) for s in starts), key=lambda s: spectrum_negative_log_likelihood(s, cells)),
        )
    gain = spectrum_negative_log_likelihood(lower, cells) - spectrum_negative_log_likelihood(higher, cells)
    return higher if third or gain > WORTH else lower


def with_background(spectrum: Spectrum, cells: Cells) -> Spectrum:
    """Return a fitted spectrum with a background if that is worth it, else without."""
    if spectrum.background:
        without, wide = _smooth(replace(spectrum, background=None), cells), spectrum
    else:
        shapes = [_smooth(with_first_guess(spectrum, reach), cells) for reach in background.REACHES]
        without, wide = spectrum, min(shapes, key=lambda s: spectrum_negative_log_likelihood(s, cells))
    gain = spectrum_negative_log_likelihood(without, cells) - spectrum_negative_log_likelihood(wide, cells)
    return wide if gain > background.WORTH and _beyond_turbulence(wide) else without


def without_vibration(spectrum: Spectrum, cells: Cells, lowest: float) -> Spectrum:
    """Return a fitted spectrum whose turbulence is none of the vibration.

    A fit may end on a peak, above all where there is no turbulence. The peak is a resonance; turbulence is fitted beside it, and
    there is none where that is not worth it. lowest : minimum frequency of peaks [Hz]
    """
    t = spectrum.turbulence
    if t is None or is_continuum(spectrum, t, lowest):
        return spectrum
    rest = replace(spectrum, turbulence=None)
    if is_peak(peak := Ar2(t.omega, t.damping, t.rms, t.dt), cells.bin_width):
        rest = replace(rest, resonances=(*rest.resonances, peak))
    rest = fit_spectrum(rest, cells)
    starts = [Ar2(2.0 * pi * corner, 0.7, t.rms, t.dt) for corner in (3.0 * cells.bin_width, 0.5 * lowest)]
    shapes = [_smooth(replace(rest, turbulence=one), cells) for one in starts]
    best = min(shapes, key=lambda s: spectrum_negative_log_likelihood(s, cells))
    gain = spectrum_negative_log_likelihood(rest, cells) - spectrum_negative_log_likelihood(best, cells)
    slow = best.turbulence is not None and is_continuum(best, best.turbulence, lowest)
    return best if slow and gain > background.WORTH else rest


def _beyond_turbulence(spectrum: Spectrum) -> bool:
    """Return whether a background differs from the turbulence's own shape."""
    assert spectrum.background is not None
    return spectrum.turbulence is None or spectrum.background.omega > APART * spectrum.turbulence.omega


def _smooth(spectrum: Spectrum, cells: Cells) -> Spectrum:
    """Fit the smooth part, without changing resonances."""
    spectrum = spectrum.with_vector(spectrum.vector)  # within the bounds of its numbers
    return fit_spectrum(spectrum, cells, range(spectrum.starts[len(spectrum.processes) - len(spectrum.resonances)]))
