"""The growing model of one mode: a spectrum, and the undamped lines that have been subtracted.

Margin for the shape of a smooth spectrum: it may be as much too low as it is too high nearby.

Frozen flow has lobes, a few hertz apart and by tens of percent above and below any smooth curve, which are no peaks. Peaks only
rise: where a fitted spectrum is too high, its shape is wrong, and it is as likely to be too low by as much within an octave.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import pi

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainccinv

from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.spectral.model import BACKGROUND_REACHES, BACKGROUND_WORTH, RMS, Spectrum, with_first_guess
from wfsobs.spectral.search import LOWEST, PAD, Candidate, Sinusoid, nearest_line
from wfsobs.spectral.whittle import (
    Cells,
    MissingSamples,
    first_guess,
    fit_spectrum,
    inflation,
    periodogram,
    periodogram_frequencies,
    spectrum_information,
)
from wfsobs.typing import Array

ORDER_WORTH = 6.0
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
        lower, higher = _smooth([replace(spectrum, turbulence=Ar2(t.omega, t.damping, t.rms, t.dt))], cells), spectrum
    else:
        starts = [replace(spectrum, turbulence=Ar3(t.omega, t.damping, k * t.omega, t.rms, t.dt)) for k in STARTS]
        lower, higher = spectrum, _smooth(starts, cells)
    return higher if third or cells.misfit(lower) - cells.misfit(higher) > ORDER_WORTH else lower


def with_background(spectrum: Spectrum, cells: Cells) -> Spectrum:
    """Return a fitted spectrum with a background if that is worth it, else without."""
    if spectrum.background:
        without, wide = _smooth([replace(spectrum, background=None)], cells), spectrum
    else:
        without, wide = spectrum, _smooth([with_first_guess(spectrum, reach) for reach in BACKGROUND_REACHES], cells)
    gain = cells.misfit(without) - cells.misfit(wide)
    return wide if gain > BACKGROUND_WORTH and _beyond_turbulence(wide) else without


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
    best = _smooth([replace(rest, turbulence=one) for one in starts], cells)
    slow = best.turbulence is not None and is_continuum(best, best.turbulence, lowest)
    return best if slow and cells.misfit(rest) - cells.misfit(best) > BACKGROUND_WORTH else rest


def without_sway(spectrum: Spectrum) -> Spectrum:
    """Return a spectrum of the chosen order whose turbulence, if as narrow as modes of structures, is a resonance.

    That of second order fits frozen flow with a damping as low.
    """
    t = spectrum.turbulence
    if not isinstance(t, Ar2) or t.damping > BROAD:
        return spectrum
    return replace(spectrum, turbulence=None, resonances=(*spectrum.resonances, t))


def _beyond_turbulence(spectrum: Spectrum) -> bool:
    """Return whether a background differs from the turbulence's own shape."""
    assert spectrum.background is not None
    return spectrum.turbulence is None or spectrum.background.omega > APART * spectrum.turbulence.omega


def _smooth(starts: Sequence[Spectrum], cells: Cells) -> Spectrum:
    """Fit the smooth part from every start, without changing resonances, and return the likeliest."""
    inside = (s.with_vector(s.vector) for s in starts)  # within the bounds of its numbers
    return min((fit_spectrum(s, cells, range(s.starts[len(s.continuum)])) for s in inside), key=cells.misfit)


NEIGHBOURS = 4.0
"""Bins, beside half its width, within which a candidate is not a new peak: two peaks that near are one."""
WIDEST = 0.5
"""Maximum damping of a resonance."""
SPLIT = 8.0
"""Minimum gain of log-likelihood by two resonances in place of one, which is tried for every wide one."""

LINES_SPLIT = 16.0
"""The same by two lines, whose amplitudes and phases are fitted: one resonance passes 8 in one of 200 records, 16 in none."""
NEARER = 2.5
"""Bins within which two lines are one."""


def reach_of(candidate: Candidate, bin_width: float) -> float:
    """Return the distance [Hz] within which a peak is the candidate."""
    return (NEIGHBOURS + candidate.width / 2.0) * bin_width


def window_about(candidate: Candidate, f: Array) -> Array:
    """Return the bins over which explanations of a candidate are compared, bool (len(f),)."""
    half = max(3.0 * reach_of(candidate, f[0]), 0.03 * candidate.frequency)
    return np.abs(f - candidate.frequency) < half


def misfit_of(spectrum: Spectrum, f: Array, I: Array) -> float:  # noqa: E741
    """Return - log L of a periodogram (len(f),) [um^2/Hz], without a constant."""
    S = spectrum.psd(f)
    return float(np.sum(np.log(S) + I / S))


def strongest_bin(candidate: Candidate, f: Array, ratio: Array) -> float:
    """Return the frequency [Hz] within a candidate at which the ratio of periodogram and spectrum is largest."""
    if candidate.width == 1:
        return candidate.frequency
    near = np.abs(f - candidate.frequency) <= candidate.width / 2.0 * f[0]
    return float(f[near][np.argmax(ratio[near])])


def is_peak(p: Ar2, bin_width: float) -> bool:
    """Return whether a resonance is narrower than turbulence, not slower than the record, and below half the rate."""
    return p.damping < WIDEST and 2.0 * bin_width < p.frequency < 0.5 / p.dt - bin_width


def add_resonance(spectrum: Spectrum, f: Array, I: Array, candidate: Candidate) -> Spectrum:  # noqa: E741
    """Return the spectrum with a resonance of the candidate's width, it alone fitted to the bins about it."""
    f0, half = candidate.frequency, 0.5 * candidate.width * f[0]
    near = np.abs(f - f0) <= max(half, f[0])
    excess = np.maximum(I[near] - spectrum.psd(f[near]), 0.0)
    power, f0 = float(excess.sum() * f[0]), float(excess @ f[near] / excess.sum()) if excess.any() else f0
    dampings = (min(max(share * half / f0, 1e-6), 0.5) for share in (0.15, 0.5))
    peaks = (Ar2(2.0 * pi * f0, damping, np.sqrt(max(power, 1e-16)), spectrum.dt) for damping in dampings)
    wider = [replace(spectrum, resonances=(*spectrum.resonances, p)) for p in peaks]
    cells = Cells(f, I, window_about(candidate, f), [p.frequency for p in wider[0].resonances])
    count = wider[0].starts[-1]
    return min((fit_spectrum(s, cells, range(count - 3, count)) for s in wider), key=cells.misfit)


def split_resonance(spectrum: Spectrum, f: Array, I: Array, p: Ar2) -> Spectrum | None:  # noqa: E741
    """Return the spectrum with two resonances in place of one; None where it is narrow or they are not worth it.

    Neighbours look like one resonance of several bins.
    """
    f0 = p.frequency
    half = p.damping * f0
    if half < 2.0 * NEIGHBOURS * f[0]:
        return None
    two = [Ar2(2 * pi * (f0 + sign * 0.7 * half), 0.4 * p.damping, p.rms / np.sqrt(2.0), spectrum.dt) for sign in (-1, 1)]
    start = replace(spectrum, resonances=(*spectrum.without(p).resonances, *two))
    keep = window_about(Candidate(f0, int(4.0 * half / f[0]), 0.0), f)
    cells = Cells(f, I, keep, [q.frequency for q in (*start.resonances, p)])
    count = start.starts[-1]
    shape = fit_spectrum(start, cells, range(count - 6, count))
    is_worth = cells.misfit(spectrum) - cells.misfit(shape) > SPLIT
    return shape if is_worth and all(is_peak(q, f[0]) for q in shape.resonances[-2:]) else None


WIDTH = 27
"""Bins of a mean I / S: the lobes of frozen flow are wider in a minute."""
ABOUT, UNUSUAL = 2.0, 0.05
"""Factor in frequency on either side over which dips are gathered, since the first lobes are as far apart as they are from zero;
and the probability below which what noise dips by is unusual."""
FURTHER, LEVEL = 4.0, 1e-3
"""The same over which dips have to be none of noise: probability at most with which the right spectrum is given a margin at a
frequency."""
MEAN, VARIANCE = 0.2772, 0.3543
"""Of the log-likelihood of a dip of the right spectrum, 0 for means above one; of normal means 0.25 and 0.3125."""


def margin(ratio: Array) -> Array:
    """Return the factor (bins,), 1 or more, by which S may be too low, from I / S (bins,).

    A dip of WIDTH bins is worth d = WIDTH (r - 1 - log r) in log-likelihood, r < 1 their mean. Where the sum of d is unusual over
    an octave on either side, and none of noise over two, all of it is taken for that of log S + a sin: over n means n WIDTH
    a^2 / 8, of the octave. The factor is exp(a).
    """
    n = len(ratio) // WIDTH
    if n < 2:
        return np.ones(len(ratio))
    r = np.clip(ratio[: n * WIDTH].reshape(n, WIDTH).mean(axis=1), 1e-6, 1.0)
    worth = np.concatenate([[0.0], np.cumsum(WIDTH * (r - 1.0 - np.log(r)))])
    near, count, unusual = _sum_dips(worth, ABOUT, UNUSUAL)
    *_, no_noise = _sum_dips(worth, FURTHER, LEVEL)
    a = np.where(unusual & no_noise, np.sqrt(8.0 * near / (WIDTH * count)), 0.0)
    return np.exp(np.interp(np.arange(len(ratio)), WIDTH * (np.arange(n) + 0.5), a))


def _sum_dips(worth: Array, about: float, level: float) -> tuple[Array, NDArray[np.intp], NDArray[np.bool_]]:
    """Sum the log-likelihood of dips within a factor `about` of each mean, from the cumulated `worth`.

    Also return the number of means, and whether noise gives as much with a probability of less than `level`.
    """
    n = len(worth) - 1
    centre = np.arange(n) + 0.5
    low, high = (centre / about).astype(int), np.minimum(np.ceil(centre * about).astype(int), n)
    count, found = high - low, worth[high] - worth[low]
    return found, count, found > VARIANCE / MEAN * gammainccinv(count * MEAN**2 / VARIANCE, level)


WIDEST_LINE = 9
"""Maximum width of a candidate, in bins, that may be an undamped line."""
SURE = 5.0
"""Ratio of rms to its standard deviation from which a resonance is kept without a test."""
WORTH = 6.0
"""Minimum gain of log-likelihood by three parameters: noise gains as much with a probability of 0.7 % (chi squared of 12)."""
KEPT = 8.0
"""Minimum gain of log-likelihood by a resonance once all parameters are fitted, somewhat below that which the search requires
among some thousand bins. Spurious ones beside a strong peak, found before its width was fitted, gain 2 to 6."""

NO_NEARER = 1.1
"""Minimum third corner, over the first two, for its standard deviation."""

SETTLED = 0.01
"""Remaining error of repeated filling and fitting: each round leaves about the share that is missing."""


class OneMode:
    """Model of one mode.

    Parameters
    ----------
    z : Array
        Pseudo-open-loop measurement, (n,) [um]; NaN is a missing sample.
    dt : float
        Time step [s].
    lowest : float
        Minimum frequency of a peak [Hz].

    Attributes
    ----------
    spectrum, lines
        The model.
    left : Array
        z without mean and lines, filled by the model's expectation, (n,).
    I : Array
        Expected periodogram of the complete `left`.
    share : Array
        Measured share of every bin, see `measured_share`.
    rejections : list
        Candidates that no peak explains.
    removals : list
        Frequencies of resonances that were removed for their uncertainty [Hz].
    """

    measurement: Array
    dt: float
    n: int
    missing_power: Array
    strong: Array
    left: Array

    def __init__(self, z: Array, dt: float, lowest: float = LOWEST):
        self.lowest = lowest
        self.measurement, self.dt, self.n = z - np.nanmean(z), dt, len(z)
        self.missing: MissingSamples = MissingSamples(np.isnan(z), dt, np.random.default_rng(0))
        self.f: Array = periodogram_frequencies(self.n, dt)
        self.share, self.unknown, self.missing_power = np.ones(len(self.f)), np.zeros((0, self.n)), np.zeros(len(self.f))
        self.z = self.missing.interpolate(self.measurement)
        self.lines: list[Sinusoid] = []
        self._subtract_lines()
        self.spectrum = first_guess(self.f, self.I, dt)
        self.strong = np.zeros(len(self.f), bool)
        self.rejections: list[Candidate] = []
        self.removals: list[float] = []
        self._fill()

    def _fill(self) -> None:
        """Fill z by the expectation of the present model."""
        if self.missing.any:
            S, lines = self.spectrum.psd(self.f), self._signal()
            self.unknown: Array = self.missing.draw_errors(S)
            self.share: Array = self.missing.measured_share(S, self.unknown)
            self.missing_power = (1.0 - self.share) * S
            self.z: Array = self.missing.fill(self.measurement - lines, S) + lines
            self._subtract_lines()

    def _signal(self) -> Array:
        return sum((line.signal(self.n, self.dt) for line in self.lines), np.zeros(self.n))

    def _subtract_lines(self) -> None:
        self.left = self.z - self._signal()
        self.I = periodogram(self.left, self.dt) + self.missing_power

    @property
    def complete(self) -> Array:
        """`left` with a random draw of the unknown part in its gaps, (n,): as likely as the complete record."""
        return self.left + self.unknown[0] if self.missing.any else self.left

    @property
    def peaks(self) -> int:
        """Number of peaks."""
        return len(self.lines) + len(self.spectrum.resonances)

    def whiten(self) -> Array:
        """Return I / S at PAD frequencies per bin, 1 at refused candidates; S as high as it may be (`misfit`)."""
        f = periodogram_frequencies(self.n, self.dt, PAD)
        S = self.spectrum.psd(self.f)
        S = np.exp(np.interp(f, self.f, np.log(S * self.share * margin(self.I / S))))
        ratio = periodogram(self.left, self.dt, PAD) / S
        for candidate in self.rejections:
            ratio[np.abs(f - candidate.frequency) <= (0.5 * candidate.width + 0.5) * self.f[0]] = 1.0
        return ratio

    def cells(self, everything: bool = False) -> Cells:
        """Return the bins for a fit: all but those far above a test's limit without a resonance near."""
        keep = np.ones(len(self.f)) if everything else np.where(self.strong, 0.0, 1.0)
        for p in self.spectrum.resonances:
            centre, half = p.frequency, max(4.0 * p.damping * p.frequency, 20.0 * self.f[0])
            keep[np.abs(self.f - centre) < half] = 1.0
        return Cells(self.f, self.I, keep, [p.frequency for p in self.spectrum.resonances], self.share)

    def refit(self, reshape: bool = False, third: bool = False) -> None:
        """Fit all parameters of the spectrum at once.

        A resonance that has become as wide as turbulence is dropped.

        reshape : whether the order of the turbulence and the background are chosen anew; third : third order in any case
        """
        cells = self.cells()
        self.spectrum = without_vibration(fit_spectrum(self.spectrum, cells), cells, self.lowest)
        if reshape:
            cells = self.cells()
            self.spectrum = with_background(without_sway(choose_order(self.spectrum, cells, third)), cells)
        for p in [p for p in self.spectrum.resonances if not is_peak(p, self.f[0])]:
            self.spectrum = self.spectrum.without(p)
            self.rejections.append(Candidate(p.frequency, WIDEST_LINE, 0.0))  # or it would come back
        self._fill()

    def explain(self, candidate: Candidate) -> bool:
        """Add the line or the resonance that explains the candidate best; return whether it is worth its parameters.

        Where there are lines beside it, they may become one resonance.
        """
        window = window_about(candidate, self.f)
        before = misfit_of(self.spectrum, self.f[window], self.I[window])
        lines, spectrum, reach = self.lines, self.spectrum, reach_of(candidate, self.f[0])
        beside = [line for line in lines if abs(line.frequency - candidate.frequency) < reach]
        trials: list[tuple[list[Sinusoid], Spectrum]] = []
        if not beside and not any(abs(p.frequency - candidate.frequency) < reach for p in spectrum.resonances):
            shape = add_resonance(spectrum, self.f, self.I, candidate)
            at = shape.resonances[-1].frequency  # its own skirt may have been the candidate
            beside = [line for line in lines if abs(line.frequency - at) < NEIGHBOURS * self.f[0]]
            if not beside:
                trials.append((lines, shape))
                if candidate.width <= WIDEST_LINE:
                    at = strongest_bin(candidate, self.f, self.I / spectrum.psd(self.f))
                    trials.append(([*lines, nearest_line(self.left, self.dt, at, 0.75 * self.f[0])], spectrum))
        if beside:
            self.lines = rest = [line for line in lines if line not in beside]
            self._subtract_lines()
            centre = float(np.mean([line.frequency for line in beside]))
            wide = Candidate(centre, max(candidate.width, 3), candidate.strength)
            trials.append((rest, add_resonance(spectrum, self.f, self.I, wide)))
        outcomes = []
        for some, shape in trials:
            self.lines = some
            self._subtract_lines()
            if len(shape.resonances) > len(spectrum.resonances) and not is_peak(shape.resonances[-1], self.f[0]):
                continue
            peaks_more = len(some) - len(lines) + len(shape.resonances) - len(spectrum.resonances)
            gain = before - misfit_of(shape, self.f[window], self.I[window]) - WORTH * peaks_more
            outcomes.append((gain, some, shape))
        gain, some, shape = max(outcomes, key=lambda o: o[0], default=(0.0, lines, spectrum))
        if gain <= 0:
            some, shape = lines, spectrum
            self.rejections.append(candidate)
        self.lines, self.spectrum = some, shape
        self._subtract_lines()
        return gain > 0

    def polish(self, third: bool = False) -> None:
        """Fit every line once more with the others subtracted, then all parameters on all bins.

        third : turbulence of third order in any case, as another mode has it
        """
        for again in range(self.missing.rounds(SETTLED)):
            self._polish_lines()
            self.refit(not again, third)
        if sum(self._split_into_lines(p) for p in self.spectrum.resonances):
            self.refit()
        for p in self.spectrum.resonances:
            self._split(p)

    def _polish_lines(self, first: int = 0) -> None:
        for i, line in enumerate(self.lines[first:], first):
            alone = self.left + line.signal(self.n, self.dt)
            again = nearest_line(alone, self.dt, line.frequency, 0.25 * self.f[0])
            self.left = alone - again.signal(self.n, self.dt)
            self.lines[i] = again
        self._subtract_lines()

    def _split_into_lines(self, p: Ar2) -> bool:
        """Replace a resonance by two undamped lines where they are worth it, and return whether.

        Lines some bins apart look like one resonance, but taken off they leave nothing, where a resonance leaves its skirt.
        """
        half, lines, rest = p.damping * p.frequency / self.f[0], self.lines, self.spectrum.without(p)
        if half > 2.0 * NEIGHBOURS:
            return False
        keep = window_about(Candidate(p.frequency, int(4.0 * half), 0.0), self.f)
        weight = (np.abs(self.f - p.frequency) < (2.0 * NEIGHBOURS + half) * self.f[0]) / rest.psd(self.f)
        misfits = [misfit_of(self.spectrum, self.f[keep], self.I[keep])]
        for _ in range(2):
            free = np.all([np.abs(self.f - line.frequency) > NEARER * self.f[0] for line in self.lines], axis=0)
            at = self.f[np.argmax(weight * free * self.I)]
            self.lines = [*self.lines, nearest_line(self.left, self.dt, at, 0.75 * self.f[0])]
            self._subtract_lines()
            misfits.append(misfit_of(rest, self.f[keep], self.I[keep]))
        for _ in range(2):
            self._polish_lines(len(lines))
        is_worth = min(misfits[:2]) - misfit_of(rest, self.f[keep], self.I[keep]) > LINES_SPLIT
        self.lines, self.spectrum = (self.lines, rest) if is_worth else (lines, self.spectrum)
        self._subtract_lines()
        return is_worth

    def _split(self, p: Ar2) -> None:
        """Replace one resonance that is several bins wide by two, where they are worth it: neighbours look like one.

        Not where one was removed before: it would come back, and be removed again.
        """
        frequency = p.frequency
        if any(abs(one - frequency) <= 2.0 * p.damping * frequency for one in self.removals):
            return
        shape = split_resonance(self.spectrum, self.f, self.I, p)
        if shape is not None:
            self.spectrum = shape
            self.refit()

    def prune(self) -> bool:
        """Remove the least certain resonance that the likelihood can do without; return whether.

        Only those are tested whose rms is below SURE standard deviations, and they stay where they gain more than KEPT: the rms
        of a narrow one is uncertain because its width is, however high it stands.
        """
        std, whole, before = self.errors(), self.spectrum, misfit_of(self.spectrum, self.f, self.I)
        errors = [(float(std[i + RMS]), p) for i, p in zip(whole.starts[len(whole.continuum) :], whole.resonances, strict=False)]
        for _, p in sorted((one for one in errors if one[0] * SURE >= 1.0), key=lambda one: one[0], reverse=True):
            rest, frequency = whole.without(p), p.frequency
            if misfit_of(fit_spectrum(rest, self.cells(everything=True)), self.f, self.I) - before > KEPT:
                continue
            self.spectrum: Spectrum = rest
            self.removals.append(frequency)
            self.rejections.append(Candidate(frequency, max(round(2.0 * p.damping * frequency / self.f[0]), WIDEST_LINE), 0.0))
            self.refit()
            return True
        return False

    def errors(self) -> Array:
        """Return the standard deviations of the spectrum's parameters, with that of the damping in place of its logit, (p,)."""
        spectrum = self.spectrum
        if isinstance(t := spectrum.turbulence, Ar3):  # at its bound the corner's own number says nothing
            spectrum = replace(spectrum, turbulence=replace(t, corner=max(t.corner, NO_NEARER * t.omega)))
        std = np.zeros(spectrum.starts[-1])
        information = spectrum_information(spectrum, self.cells(everything=True), spectrum.free_parameters)
        covariance = np.linalg.inv(information + 1e-12 * np.eye(len(information)))
        std[spectrum.free_parameters] = np.sqrt(np.maximum(np.diag(covariance) * inflation(self.n), 0.0))
        for start, p in zip(spectrum.starts, spectrum.processes, strict=False):
            std[start + 1] *= p.damping * (1.0 - p.damping)
        return std


BROAD = 0.1
"""Minimum damping of a resonance of the continuum: modes of structures have 0.005 to 0.05."""
STANDS_OUT = 1.25
"""Minimum density at the maximum of a broad vibration peak, over that of the dip below it."""
POINTS = 200
"""Points at which the density is evaluated."""


def is_continuum(spectrum: Spectrum, p: Ar2 | Ar3, lowest: float) -> bool:
    """Return whether a process of the spectrum belongs to turbulence or background.

    It does if it lies below `lowest`, the minimum frequency of peaks [Hz]; or if it is broad, and the density of the
    whole model has no maximum there that stands out of the dip on its lower side. Likelihood cannot decide: where no model
    of turbulence fits, a resonance raises it by any amount.
    """
    f0 = p.frequency
    if f0 < lowest:
        return True
    if p.damping <= BROAD:
        return False
    if (1.0 - p.damping) * f0 >= 0.5 / p.dt:  # beyond half the rate nothing can be seen
        return True
    f = np.linspace(max(1.0 - 3.0 * p.damping, 0.1) * f0, min((1.0 + p.damping) * f0, 0.5 / p.dt), POINTS)
    S = spectrum.psd(f)
    near = np.flatnonzero(f >= (1.0 - p.damping) * f0)
    top = near[np.argmax(S[near])]
    return bool(S[top] < STANDS_OUT * S[: top + 1].min())
