"""Fast fit of the spectrum of one mode, for repeated use on windows of a few seconds: milliseconds.

A short form of `identify`, without its tests and errors: noise and turbulence of the window before, adapted to this one; the
highest maxima of the whitened periodogram as resonances, all at once; a few Newton steps of Whittle's likelihood for all
parameters; and the same once more for the remainder. A false weak peak costs the filter less than a missed one, so the threshold
is lower than in `search`. Where coloured noise would raise the likelihood, the window is fitted with a background as well.

For windows that grow, the resonances of the window before are a first guess too (`follow_spectrum`): they are tracked, not made
anew. Turbulence is then of third order, since long windows show peaks that what it has too much beyond its corner would hide.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.spectral import background
from wfsobs.spectral.background import with_first_guess
from wfsobs.spectral.missing import MissingSamples
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.periodogram import periodogram, periodogram_frequencies
from wfsobs.spectral.quick_fit import WindowFit
from wfsobs.spectral.search import LOWEST
from wfsobs.spectral.whittle import first_guess
from wfsobs.typing import Array

SHORTEST = 100
"""Minimum samples of a window."""
TRACKED = 0.1
"""Minimum half width of a peak that is tracked, in bins: undamped lines become sharper as the window grows."""
BLUR = 0.05
"""Half width that a window adds to a peak, in bins. The autocovariance that a periodogram shows falls by 1 / window per lag, too:
an undamped line would be 1 / (2 pi) bins wide. Less than that is taken off: a frequency that is not well known takes some width.
"""
COARSE, COARSER = (50, 4), (20, 3)
"""As FINE and NEAR of `periodogram`, for windows that grow and for those that have grown long: their cells hold many bins."""
LEFT = 0.02
"""Share of the error of a first guess by straight lines through gaps that rounds of filling and fitting leave."""
THIRD = 4.0
"""Third corner of turbulence, over the first two, at which the first fit of long windows starts."""
STARTS = 2
"""Corners of turbulence in the first guess: higher ones converge to the same."""
SUSPECT = 3.2
"""Standard deviations by which an octave differs from its fit, from which on a background is fitted, too: of one that is as the
fit says, some of ten octaves does in 1.4 % of windows."""


def quick_spectrum(
    z: Array, dt: float, most: int, lowest: float = LOWEST, before: Spectrum | None = None, *, complete: bool = True
) -> Spectrum:
    """Fit noise, turbulence and up to `most` peaks to a window.

    Parameters
    ----------
    z : Array
        Pseudo-open-loop measurements, (n,) with n at least SHORTEST [um].
    dt : float
        Time step [s].
    most : int
        Maximum number of peaks.
    lowest : float
        Minimum frequency of a peak [Hz].
    before : Spectrum, optional
        Spectrum of a similar window, the first guess.
    complete : bool
        False where samples are replaced: noise that they have not is like colour, and no background is looked for.

    Returns
    -------
    Spectrum
        The fit.
    """
    if np.ptp(z) == 0:
        return Spectrum(float(np.finfo(float).tiny), dt)
    z = z - z.mean()
    start = _smooth_of(z, dt, before)

    def fitted(smooth: Spectrum) -> WindowFit:
        fit = WindowFit(z, dt, smooth)
        if most > 0 or before is None or before.turbulence is None:
            fit.adapt()
        _add_peaks(fit, most, lowest)
        return fit

    known = fitted(start)
    if known.has_background:
        if known.worth_of_background() < background.WORTH:
            known = fitted(replace(start, background=None))
    elif complete and most > 0 and start.turbulence is not None and known.worst_octave() > SUSPECT:
        others = [fitted(with_first_guess(start, reach)) for reach in background.REACHES]
        known = min([known, *others], key=lambda fit: fit.misfit() + background.WORTH * fit.has_background)
    return known.spectrum


def quick_spectrum_of_samples(z: Array, dt: float, most: int, lowest: float, before: Spectrum | None) -> tuple[Spectrum, Array]:
    """Fit as `quick_spectrum` to the samples that are there; z (n,) is NaN where one is missing, by short gaps alone.

    Missing samples are replaced by their expectation given all others, for the spectrum `before`; without one, for that of
    straight lines through the gaps, then again for what was found. They have no noise: of its density only the measured share
    is left. What is far above noise is known in a short gap, too.

    Returns
    -------
    Spectrum
        The fit.
    Array
        z without gaps, (n,) [um].
    """
    samples, level, f = MissingSamples(np.isnan(z), dt), np.nanmean(z), periodogram_frequencies(len(z), dt)
    filled, measured = samples.interpolate(z), np.sqrt(1.0 - samples.is_missing.mean())
    if np.ptp(filled) == 0:
        return quick_spectrum(filled, dt, most, lowest), filled
    known = before if before is not None and before.processes else None
    fit = known or quick_spectrum(filled, dt, most, lowest, complete=False)
    for _ in range(1 if known else samples.rounds(LEFT)):
        filled = samples.fill(z - level, fit.psd(f)) + level
        fit = quick_spectrum(filled, dt, most, lowest, fit, complete=False)
        fit = replace(fit, noise=fit.noise / measured)
    return fit, filled


def follow_spectrum(
    z: Array,
    dt: float,
    most: int,
    lowest: float,
    before: Spectrum | None,
    extra: Ar2 | Ar3 | None = None,
    *,
    long: bool = False,
) -> Spectrum:
    """Fit noise, turbulence and up to `most` peaks to a window that begins as the one before it did, or thereabouts.

    As `quick_spectrum`, but the first guess has the resonances of `before` too, and turbulence is of third order; z is not
    constant.

    Parameters
    ----------
    z, dt, most, lowest : Array, float, int, float
        As for `quick_spectrum`.
    before : Spectrum or None
        Spectrum of the window before.
    extra : Ar2 or Ar3, optional
        A process that is in z as well and is known: it is not fitted.
    long : bool
        Whether the window has grown long: cells are then coarser, and new peaks are looked for once.

    Returns
    -------
    Spectrum
        The fit, without the known process.
    """
    z = z - z.mean()
    tracked = () if before is None else before.resonances
    start = _smooth_of(z, dt, before)
    turbulence = start.turbulence
    if isinstance(turbulence, Ar2):
        turbulence = Ar3(turbulence.omega, turbulence.damping, THIRD * turbulence.omega, turbulence.rms, dt)
    fit = WindowFit(z, dt, Spectrum(start.noise, dt, turbulence, tracked), extra, TRACKED, COARSER if long else COARSE, BLUR)
    if not tracked:
        fit.adapt()
    _add_peaks(fit, most, lowest, 1 if tracked and long else 2)
    return fit.spectrum


def _smooth_of(z: Array, dt: float, before: Spectrum | None) -> Spectrum:
    """Return a first guess of noise, turbulence and background, without resonances."""
    if before is None or before.turbulence is None:
        return first_guess(periodogram_frequencies(len(z), dt), periodogram(z, dt), dt, STARTS)
    return replace(before, resonances=())


def _add_peaks(fit: WindowFit, most: int, lowest: float, passes: int = 2) -> None:
    for i in range(passes):
        more = fit.add(fit.maxima(lowest, most - len(fit.resonances)))
        if i > 0 and not more:
            break
        fit.improve()
        fit.prune()
