"""The model of a window of both sensors, for the adaptive multi-rate filter.

With x the mean of phi over a frame, the NGS gives x + v and the mean of z over the same steps x + e + w / sqrt(n). Their
difference holds what the LGS alone see, e, and both noises: its spectrum tells them. The spectrum of z, with e in it, tells the
rest. e is taken for independent of phi.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from wfsobs.observers.kalman.multirate_multi import beam_model
from wfsobs.observers.kalman.multirate_optimal import Cycle, estimated_cycle
from wfsobs.observers.kalman.single import MIN_NOISE
from wfsobs.prior import Beams
from wfsobs.record import RecordError
from wfsobs.signal.ar2 import Ar2
from wfsobs.spectral.missed import missed_rms
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.quick import SHORTEST, follow_spectrum, quick_spectrum
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.observers.kalman.adaptive import Adaptive

GROWS, LATER = 0.3, 0.16
"""Growth of a window to the next identification, over its length: at first, and from where its peaks may be twice as many."""
TWICE = 2
"""Growth of a window from which on its peaks may be twice as many."""
STILL = 0.7, 1.4
"""Mean square of the innovations over what the model says, within which a record is still."""
FEWEST = 20
"""Minimum NGS frames of a window."""
LEAST = 0.1
"""Minimum share of the NGS in the noise of the difference."""
DECIMALS = 12
"""Of a sample [um] in a fit: it is then the same to the last bit, in whichever order sums were taken that filled a gap."""


class Lengths(NamedTuple):
    """Numbers of fast steps, whole frames: shortest and longest window, from check to check, and the first step of a window."""

    window: int
    longest: int
    interval: int
    first: int
    ratio: int


def both_lengths(settings: Adaptive, dt: float, ratio: int, delay: int) -> Lengths:
    """Return the lengths of windows."""
    window = round(settings.window / dt / ratio)
    longest, interval = (round(seconds / dt / ratio) for seconds in (settings.longest, settings.interval))
    first = 1 + ratio * -(-max(delay - 1, 0) // ratio)  # after a frame; what the mirror did before the record is not known
    return Lengths(window * ratio, max(longest, window) * ratio, max(interval, 1) * ratio, first, ratio)


def check_window(settings: Adaptive, lengths: Lengths, dt: float) -> None:
    """Raise RecordError for a window of too few samples."""
    least = max(-(-SHORTEST // lengths.ratio), FEWEST)
    if lengths.window < least * lengths.ratio:
        needed = least * lengths.ratio * dt
        raise RecordError(f"adaptive.window = {settings.window:g}: takes {needed:g} s or more, {least} NGS frames")


def next_length(window: int, lengths: Lengths) -> int:
    """Return the steps from an identification to the next one, if the record is still."""
    grows = GROWS if window < TWICE * lengths.window else LATER
    return max(int(grows * window) // lengths.interval, 1) * lengths.interval


def window_start(end: int, change: int, lengths: Lengths) -> int:
    """Return where the window begins that ends before step `end`; change : when the record was last not still."""
    return max(min(max(change, end - lengths.longest), end - lengths.window), lengths.first)


def is_still(surprise: Array) -> bool:
    """Return whether squared innovations over their variances (n,) are as large as they should be; NaN where none is.

    Of fewer than half it is not told.
    """
    there = surprise[~np.isnan(surprise)]
    return 2 * there.size < surprise.size or bool(STILL[0] < there.mean() < STILL[1])


class BothModel(NamedTuple):
    """What has been identified last.

    spectrum : of z without the error; error : spectrum of the difference of the sensors, per frame
    ngs      : rms of the noise of a frame [um]
    cycle    : the filter in charge; None before the first, and where nothing moves
    hidden_rms : rms of the vibration that may be in the window and in none of its lines [um]
    """

    spectrum: Spectrum | None = None
    error: Spectrum | None = None
    ngs: float = 0.0
    cycle: Cycle | None = None
    hidden_rms: float = 0.0


def identify_both(z: Array, frames: Array, dt: float, settings: Adaptive, last: BothModel) -> BothModel:
    """Identify the model of a window; where it or its filter cannot be found, the last one stays.

    z, frames : LGS measurements (n,) and NGS frames (n / ratio,) [um]
    """
    ratio = len(z) // len(frames)
    z, frames = np.round(z, DECIMALS), np.round(frames, DECIMALS)
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            error = quick_spectrum(z.reshape(-1, ratio).mean(axis=1) - frames, dt * ratio, 0, settings.lowest, last.error)
            return fit_both(z, error, ratio, settings, last.spectrum)
    except (ValueError, ArithmeticError):
        return last


def fit_both(z: Array, error: Spectrum, ratio: int, settings: Adaptive, before: Spectrum | None, share: float = 1.0) -> BothModel:
    """Return the model of z (n,) and the spectrum of the difference. Raises ValueError and ArithmeticError.

    share : of z that was measured; the rest is its expectation, without noise
    """
    dt, e = error.dt / ratio, error_process(error, error.dt / ratio)
    long = len(z) * dt >= TWICE * settings.window
    most = settings.peak_count * (2 if long else 1)
    if before is None and e:  # of about the same corner: a guess that needs no search
        before = Spectrum(error.noise, dt, replace(e[0], rms=float(z.std())))
    spectrum = follow_spectrum(z, dt, most, settings.lowest, before, *e, long=long)
    of_lgs = spectrum.noise**2 / ratio
    ngs = max(error.noise * np.sqrt(max(1.0 - of_lgs / error.noise**2, LEAST)), MIN_NOISE)
    spectrum = replace(spectrum, noise=spectrum.noise / np.sqrt(share))
    hidden = missed_rms(spectrum, z, settings.lowest)
    return BothModel(spectrum, error, ngs, model_cycle(spectrum, error, ngs, ratio), hidden)


def error_process(error: Spectrum, dt: float) -> tuple[Ar2, ...]:
    """Return what the LGS alone see as a process of the fast steps, if there is any."""
    return (error.turbulence.at(dt),) if isinstance(error.turbulence, Ar2) else ()


def model_cycle(spectrum: Spectrum, error: Spectrum, ngs: float, ratio: int) -> Cycle:
    """Return what is estimated by a model. Raises ValueError and ArithmeticError where it has no filter."""
    e = error_process(error, spectrum.dt)
    turbulence = () if spectrum.turbulence is None else (spectrum.turbulence,)
    model = beam_model(Beams(turbulence), spectrum.resonances)
    return estimated_cycle(model, ratio, max(spectrum.noise, MIN_NOISE), ngs, e)
