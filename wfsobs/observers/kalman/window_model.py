"""The model of a window of measurements, of the LGS or of both sensors, for what identifies its model as it runs.

With x the mean of phi over a frame, the NGS gives x + v and the mean of z over the same steps x + e + w / sqrt(n). Their
difference holds what the LGS alone see, e, and both noises: its spectrum tells them. The spectrum of z, with e in it, tells the
rest. e is taken for independent of phi.

A window is identified from the samples that it has behind its last long gap, with missing ones replaced by their expectation.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from wfsobs.observers.kalman.filters import MIN_NOISE, beam_model, estimated_cycle, steady_mode
from wfsobs.observers.kalman.step import ModeFilter
from wfsobs.prior import Beams
from wfsobs.record import RecordError
from wfsobs.settings import Group, Real, Section, Whole
from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.signal.statespace import disturbance_model
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.quick import SHORTEST, follow_spectrum, quick_spectrum, quick_spectrum_of_samples
from wfsobs.spectral.search import missed_rms
from wfsobs.spectral.whittle import MissingSamples, periodogram_frequencies
from wfsobs.typing import Array


class Adaptive(Group):
    """The Kalman filter whose model is re-identified all the time."""

    window: Real = Real(
        4.0,
        bounds=(0.1, 100.0),
        softbounds=(0.5, 10.0),
        step=0.5,
        label="Window",
        doc="Length of the identification window [s]. Peaks closer than two over it are one; a peak that moves is "
        "followed after this time.",
    )
    longest: Real = Real(
        30.0,
        bounds=(0.1, 1000.0),
        softbounds=(4.0, 60.0),
        step=1.0,
        label="Longest window",
        doc="Length to which the window of the multi-rate filter grows while the record is still [s].",
    )
    interval: Real = Real(
        0.5,
        bounds=(0.01, 100.0),
        softbounds=(0.1, 5.0),
        step=0.1,
        label="Interval",
        doc="Time from one identification to the next [s].",
    )
    peak_count: Whole = Whole(
        20,
        bounds=(0, 60),
        label="Maximum peaks",
        doc="Maximum number of vibration peaks in the model of one mode; twice as many where the window has grown to twice.",
    )
    lowest: Real = Real(
        5.0,
        bounds=(0.1, 1000.0),
        softbounds=(1.0, 20.0),
        step=0.5,
        label="Minimum frequency",
        doc="Minimum frequency of a peak [Hz]; at least 15 over the window.",
    )
    depth: Whole = Whole(
        400,
        bounds=(1, 2000),
        label="Depth of the GPR",
        doc="Samples in a window of the adaptive GPR; at most an eighth of the identification window.",
    )


ADAPTIVE = Section("adaptive", "Adaptive Kalman filter", Adaptive)

GROWS, LATER = 0.3, 0.16
"""Growth of a window to the next identification, over its length: at first, and from where its peaks may be twice as many."""
TWICE = 2
"""Growth of a window from which on its peaks may be twice as many."""
FRAMES = 20
"""Minimum NGS frames of a window."""
LONG = 0.05
"""Gap over the shortest window from which on the samples before it are left out: what is far above noise is not known in it."""
FEWEST, LEAST = 0.75, 0.5
"""Minimum samples behind the last long gap, over the shortest window; minimum measured share of them."""
NGS_SHARE = 0.1
"""Minimum share of the NGS in the noise of the difference."""
DECIMALS = 12
"""Of a sample [um] of both sensors in a fit: it is then the same to the last bit, in whichever order sums were taken that filled
a gap."""


class Lengths(NamedTuple):
    """Numbers of fast steps, whole NGS frames where there are any.

    window, longest : shortest and longest window
    interval : from check to check
    first    : first step of a window
    ratio    : steps per NGS frame; None without NGS
    """

    window: int
    longest: int
    interval: int
    first: int
    ratio: int | None = None

    @property
    def frame(self) -> int:
        """Steps per NGS frame, 1 without NGS."""
        return self.ratio or 1

    def next_length(self, window: int) -> int:
        """Return the steps from an identification to the next one, if the record is still."""
        if self.ratio is None:
            return self.interval
        grows = GROWS if window < TWICE * self.window else LATER
        return max(int(grows * window) // self.interval, 1) * self.interval

    def window_start(self, end: int, change: int) -> int:
        """Return where the window begins that ends before step `end`; change : when the record was last not still."""
        return max(min(max(change, end - self.longest), end - self.window), self.first)

    def check(self, settings: Adaptive, dt: float) -> None:
        """Raise RecordError for a window of too few samples."""
        least, what = (SHORTEST, "samples") if self.ratio is None else (max(-(-SHORTEST // self.ratio), FRAMES), "NGS frames")
        needed = least * self.frame
        if self.window < needed:
            raise RecordError(f"adaptive.window = {settings.window:g}: takes {needed * dt:g} s or more, {least} {what}")


def window_lengths(settings: Adaptive, dt: float, ratio: int | None = None, delay: int = 0) -> Lengths:
    """Return the lengths of windows: of the LGS they all have one, of both sensors they grow."""
    n = ratio or 1
    window, longest, interval = (round(seconds / dt / n) for seconds in (settings.window, settings.longest, settings.interval))
    # After a frame; what the mirror did before the record is not known.
    longest, first = (window, delay) if ratio is None else (max(longest, window), 1 + n * -(-max(delay - 1, 0) // n))
    return Lengths(window * n, longest * n, max(interval, 1) * n, first, ratio)


class WindowModel(NamedTuple):
    """What has been identified last.

    fit      : newest spectrum of z, from which the next is followed; None before the first
    spectrum : of z without the error of the LGS, of which the filter in charge is; None before the first
    filter   : the filter in charge; None where nothing moves
    hidden_rms : rms of the vibration that may be in the window and in none of its lines [um]
    error, ngs : of both sensors, spectrum of their difference per frame, and rms of the noise of a frame [um]
    """

    fit: Spectrum | None = None
    spectrum: Spectrum | None = None
    filter: ModeFilter | None = None
    hidden_rms: float = 0.0
    error: Spectrum | None = None
    ngs: float = 0.0


def sensor_samples(v: Array, ratio: int | None) -> list[Array]:
    """Return the samples of each sensor in whole frames of v (n, 1 or 2): of the LGS, and NGS frames where there are any."""
    return [v[:, 0]] if ratio is None else [v[:, 0], v[ratio - 1 :: ratio, 1]]


def behind_gaps(v: Array, lengths: Lengths, least: int) -> Array | None:
    """Return the whole frames of v (n, 1 or 2) behind its last long gap; None if they are too few, or too few were measured.

    least : minimum number of steps where a model is in charge that holds, else FEWEST of the shortest window do
    """
    n, samples = lengths.frame, sensor_samples(v, lengths.ratio)
    start = max(step * last_long_gap(x, LONG * lengths.window / step) for x, step in zip(samples, (1, n), strict=False))
    v = v[-(-start // n) * n :]
    is_long = len(v) >= max(least, FEWEST * lengths.window, SHORTEST)
    return v if is_long and all(np.isnan(x).mean() <= 1.0 - LEAST for x in sensor_samples(v, lengths.ratio)) else None


def last_long_gap(z: Array, most: float) -> int:
    """Return where the last gap of more than `most` samples ends, 0 without one."""
    bounds = np.concatenate([[-1], np.flatnonzero(~np.isnan(z)), [len(z)]])
    ends = bounds[1:][np.diff(bounds) - 1 > most]
    return int(ends[-1]) if ends.size else 0


def identify_window(
    v: Array, dt: float, settings: Adaptive, last: WindowModel, lengths: Lengths, least: int = 0
) -> tuple[WindowModel, Array] | None:
    """Identify the model of a window.

    Parameters
    ----------
    v : Array
        LGS measurements, and NGS frames at the end of each where there are any, (n, 1 or 2) [um]; NaN is missing.
    dt : float
        Step [s].
    settings : Adaptive
        Number of peaks, minimum frequency and length of a window.
    last : WindowModel
        Of the window before.
    lengths : Lengths
        Of windows.
    least : int
        Minimum number of steps behind a long gap, as in `behind_gaps`.

    Returns
    -------
    tuple or None
        The model, and v, or its end behind a long gap, with missing measurements replaced by their expectation. Where the model
        or its filter cannot be found the last filter stays; None where measurements are missing, too.
    """
    found, lost = last, bool(np.isnan(v).any())
    part = behind_gaps(v, lengths, least) if lost else v
    if part is None:
        return None
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            if lengths.ratio is None:
                fit, z = _spectrum_of(part[:, 0], dt, settings.peak_count, settings, last.fit, lost)
                found = last._replace(fit=fit)
                return WindowModel(fit, fit, model_filter(fit), missed_rms(fit, z, settings.lowest)), z[:, None]
            model, whole = _identify_both(part, dt, lengths.ratio, settings, last)
            return model, whole if lost else v
    except (ValueError, ArithmeticError):
        return None if lost else (found, v)


def _identify_both(v: Array, dt: float, ratio: int, settings: Adaptive, last: WindowModel) -> tuple[WindowModel, Array]:
    """Return the model of both sensors, and v without gaps. Raises ValueError and ArithmeticError."""
    seen, frames = (np.round(x, DECIMALS) for x in sensor_samples(v, ratio))
    before, lost = last.fit, np.isnan(seen)
    z = _fill_gaps(seen, dt, settings, last)
    means = z.reshape(-1, ratio).mean(axis=1)
    difference = np.where(lost.reshape(-1, ratio).all(axis=1), np.nan, means - frames)
    error, difference = _spectrum_of(difference, dt * ratio, 0, settings, last.error, bool(np.isnan(difference).any()))
    e, is_long = error_process(error, dt), len(z) * dt >= TWICE * settings.window
    if before is None and e:  # of about the same corner: a guess that needs no search
        before = Spectrum(error.noise, dt, replace(e[0], rms=float(z.std())))
    most = settings.peak_count * (2 if is_long else 1)
    spectrum = follow_spectrum(z, dt, most, settings.lowest, before, *e, long=is_long)
    ngs = max(error.noise * np.sqrt(max(1.0 - spectrum.noise**2 / ratio / error.noise**2, NGS_SHARE)), MIN_NOISE)
    spectrum = replace(spectrum, noise=spectrum.noise / np.sqrt(1.0 - lost.mean()))  # what was filled in has none
    hidden = missed_rms(spectrum, z, settings.lowest)
    found = WindowModel(spectrum, spectrum, model_filter(spectrum, error, ngs, ratio), hidden, error, ngs)
    whole = np.column_stack([z, np.zeros(len(z))])
    whole[ratio - 1 :: ratio, 1] = np.where(np.isnan(frames), means - difference, frames)
    return found, whole


def _fill_gaps(z: Array, dt: float, settings: Adaptive, last: WindowModel) -> Array:
    """Return z with its missing samples replaced by their expectation for the last model."""
    samples = MissingSamples(np.isnan(z), dt)
    if not samples.any:
        return z
    if last.spectrum is None or last.error is None:
        return quick_spectrum_of_samples(z, dt, settings.peak_count, settings.lowest, None)[1]
    f, level = periodogram_frequencies(len(z), dt), np.nanmean(z)
    S = last.spectrum.psd(f) + sum(e.psd(f) for e in error_process(last.error, dt))
    return samples.fill(z - level, S) + level


def _spectrum_of(
    x: Array, dt: float, most: int, settings: Adaptive, last: Spectrum | None, has_gaps: bool
) -> tuple[Spectrum, Array]:
    """Return the spectrum of samples with at most so many lines, and the samples without gaps, if it has some."""
    if has_gaps:
        return quick_spectrum_of_samples(x, dt, most, settings.lowest, last)
    return quick_spectrum(x, dt, most, settings.lowest, last), x


def error_process(error: Spectrum, dt: float) -> tuple[Ar2, ...]:
    """Return what the LGS alone see as a process of the fast steps, if there is any."""
    return (error.turbulence.at(dt),) if isinstance(error.turbulence, Ar2) else ()


def model_filter(
    spectrum: Spectrum, error: Spectrum | None = None, ngs: float = 0.0, ratio: int | None = None
) -> ModeFilter | None:
    """Return the filter of a model, None where nothing moves. Raises ValueError and ArithmeticError where there is none.

    error, ngs, ratio : of both sensors, as in `WindowModel`
    """
    noise = max(spectrum.noise, MIN_NOISE)
    if error is None or ratio is None:
        model = disturbance_model(spectrum.continuum, spectrum.resonances) if spectrum.processes else None
        return None if model is None else steady_mode(model, noise)
    turbulence = () if spectrum.turbulence is None else (spectrum.turbulence,)
    model = beam_model(Beams(turbulence), spectrum.resonances)
    return estimated_cycle(model, ratio, noise, ngs, error_process(error, spectrum.dt)).filter()


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
    background, turbulence, *rest = (_process(row, dt) for row in (np.append(table[0, 1:], np.nan), *table[1:]))
    assert not isinstance(background, Ar3)
    return Spectrum(float(table[0, 0]), dt, turbulence, tuple(p for p in rest if isinstance(p, Ar2)), background)


def _process(row: Array, dt: float) -> Ar2 | Ar3 | None:
    omega, damping, rms, corner = row.tolist()
    if np.isnan(omega):
        return None
    return Ar2(omega, damping, rms, dt) if np.isnan(corner) else Ar3(omega, damping, corner, rms, dt)
