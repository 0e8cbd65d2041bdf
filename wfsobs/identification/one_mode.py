"""The growing model of one mode: a spectrum, and the undamped lines that have been subtracted."""

from __future__ import annotations

from math import pi

import numpy as np

from wfsobs.identification.misfit import margin
from wfsobs.identification.order import choose_order, with_background, without_vibration
from wfsobs.identification.resonances import (
    NEIGHBOURS,
    add_resonance,
    is_peak,
    misfit_of,
    reach_of,
    split_resonance,
    strongest_bin,
    window_about,
)
from wfsobs.signal.ar2 import Ar2
from wfsobs.spectral.lines import Sinusoid, nearest_line
from wfsobs.spectral.missing import MissingSamples
from wfsobs.spectral.model import RMS, Spectrum
from wfsobs.spectral.periodogram import Cells, inflation, periodogram, periodogram_frequencies
from wfsobs.spectral.search import LOWEST, PAD, Candidate
from wfsobs.spectral.whittle import first_guess, fit_spectrum, standard_deviations
from wfsobs.typing import Array

WIDEST_LINE = 9
"""Maximum width of a candidate, in bins, that may be an undamped line."""
SURE = 2.0
"""Minimum rms of a resonance, in standard deviations."""
WORTH = 6.0
"""Minimum gain of log-likelihood by three parameters: noise gains as much with a probability of 0.7 % (chi squared of 12)."""

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
    rng : numpy.random.Generator, optional
        For the draws of missing samples.

    Attributes
    ----------
    spectrum, lines
        The model.
    left : Array
        z without mean and lines, filled by the model's expectation, (n,).
    I : Array
        Expected periodogram of the complete `left`.
    share : Array
        Measured share of every bin, see `missing`.
    rejections : list
        Candidates that no peak explains.
    removals : list
        Frequencies of resonances that were removed for their uncertainty [Hz].
    """

    def __init__(self, z: Array, dt: float, lowest: float = LOWEST, rng: np.random.Generator | None = None):
        self.lowest = lowest
        self.measurement, self.dt, self.n = z - np.nanmean(z), dt, len(z)
        self.missing = MissingSamples(np.isnan(z), dt, rng or np.random.default_rng(0))
        self.f = periodogram_frequencies(self.n, dt)
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
            self.unknown = self.missing.draw_errors(S)
            self.share = self.missing.measured_share(S, self.unknown)
            self.missing_power = (1.0 - self.share) * S
            self.z = self.missing.fill(self.measurement - lines, S) + lines
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
            centre, half = p.omega / (2 * pi), max(4.0 * p.damping * p.omega / (2 * pi), 20.0 * self.f[0])
            keep[np.abs(self.f - centre) < half] = 1.0
        return Cells(self.f, self.I, keep, [p.omega / (2 * pi) for p in self.spectrum.resonances], self.share)

    def refit(self, reshape: bool = False, third: bool = False) -> None:
        """Fit all parameters of the spectrum at once.

        A resonance that has become as wide as turbulence is dropped.

        reshape : whether the order of the turbulence and the background are chosen anew; third : third order in any case
        """
        cells = self.cells()
        self.spectrum = without_vibration(fit_spectrum(self.spectrum, cells), cells, self.lowest)
        if reshape:
            cells = self.cells()
            self.spectrum = with_background(choose_order(self.spectrum, cells, third), cells)
        for p in [p for p in self.spectrum.resonances if not is_peak(p, self.f[0])]:
            self.spectrum = self.spectrum.without(p)
            self.rejections.append(Candidate(p.omega / (2 * pi), WIDEST_LINE, 0.0))  # or it would come back
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
        if not beside and not any(abs(p.omega / (2 * pi) - candidate.frequency) < reach for p in spectrum.resonances):
            shape = add_resonance(spectrum, self.f, self.I, candidate)
            at = shape.resonances[-1].omega / (2 * pi)  # its own skirt may have been the candidate
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
        for p in self.spectrum.resonances:
            self._split(p)

    def _polish_lines(self) -> None:
        for i, line in enumerate(self.lines):
            alone = self.left + line.signal(self.n, self.dt)
            again = nearest_line(alone, self.dt, line.frequency, 0.25 * self.f[0])
            self.left = alone - again.signal(self.n, self.dt)
            self.lines[i] = again
        self._subtract_lines()

    def _split(self, p: Ar2) -> None:
        """Replace one resonance that is several bins wide by two, where they are worth it: neighbours look like one.

        Not where one was removed before: it would come back, and be removed again.
        """
        frequency = p.omega / (2 * pi)
        if any(abs(one - frequency) <= 2.0 * p.damping * frequency for one in self.removals):
            return
        shape = split_resonance(self.spectrum, self.f, self.I, p)
        if shape is not None:
            self.spectrum = shape
            self.refit()

    def prune(self) -> bool:
        """Remove the least certain resonance that the likelihood can do without; return whether.

        Those are tried whose rms is below SURE of its standard deviations. That of a narrow one is uncertain since its width is,
        however high it stands: it is kept. One whose power a neighbour has as well is not worth its parameters.
        """
        std, first = self.errors(), len(self.spectrum.processes) - len(self.spectrum.resonances)
        unsure = [
            (float(std[start + RMS]), p)
            for start, p in zip(self.spectrum.starts[first:-1], self.spectrum.resonances, strict=True)
            if std[start + RMS] * SURE >= 1.0
        ]
        whole, before = self.spectrum, misfit_of(self.spectrum, self.f, self.I)
        for _, p in sorted(unsure, key=lambda pair: pair[0], reverse=True):
            rest = whole.without(p)
            if misfit_of(fit_spectrum(rest, self.cells(everything=True)), self.f, self.I) - before > WORTH:
                continue
            frequency = p.omega / (2 * pi)
            self.spectrum = rest
            self.removals.append(frequency)
            self.rejections.append(Candidate(frequency, max(round(2.0 * p.damping * frequency / self.f[0]), WIDEST_LINE), 0.0))
            self.refit()
            return True
        return False

    def errors(self) -> Array:
        """Return the standard deviations of the spectrum's parameters, see `standard_deviations`."""
        return standard_deviations(self.spectrum, self.cells(everything=True), inflation(self.n))
