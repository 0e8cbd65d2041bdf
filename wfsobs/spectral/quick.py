"""The spectrum of one mode from a window of a few seconds, in milliseconds.

What `identify` does with care, tests and errors, for who asks again every half second: the background of the window before,
moved to this one; the highest maxima of the whitened periodogram as resonances, all at once; a few Newton steps of Whittle's
likelihood for all numbers; and once more for what is left. A weak peak that is none costs the filter less than one that it lacks,
so that less is asked of a peak than in `search`.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import log, pi

import numpy as np
from scipy.special import logit

from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.spectral.densities import densities
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.periodogram import Cells, frequencies, periodogram
from wfsobs.spectral.search import LOWEST
from wfsobs.spectral.whittle import first_guess
from wfsobs.typing import Array

SHORTEST = 100
"""Samples of a window at least."""
FEWEST = 15.0
"""Periods that a peak has in a window at least: with fewer, turbulence is in the way of its maximum."""
PAD = 2
"""Frequencies per bin at which maxima are looked for."""
HEIGHT, AT, DEEPER = 6.0, 10.0, 0.35
"""I / S that a maximum at AT [Hz] needs over noise to be taken for a peak. It grows as log f, since false ones get more by
number, and by DEEPER log(S / noise), since the more turbulence there is the more of it a false one takes."""
APART = 2.0
"""Bins between two peaks at least."""
START = 0.5
"""Half width of a new peak, in bins."""
NARROWEST, WIDEST = 0.3, 0.3
"""Half width of a peak in bins at least, which is what a window can tell; its damping at most."""
WORTH = 4.0
"""Log-likelihood that a peak has to be worth to be kept."""
CLIPPED = 4.0
"""I / S from which a bin says no more of the background: it is of a peak."""
STARTS = 2
"""Corners of turbulence that the first guess tries: higher ones end where these do."""
STEPS, ENOUGH = 6, 0.2
"""Of Newton's method, at a time at most; the gain of log-likelihood by one below which there is none more."""
REACH = 1.0
"""How far a number moves in one step, a logarithm; a frequency moves by half a bin."""


def quick_spectrum(z: Array, dt: float, most: int, lowest: float = LOWEST, before: Spectrum | None = None) -> Spectrum:
    """Noise, turbulence and up to `most` peaks from `lowest` [Hz] on, of z (n,) [um], n at least SHORTEST.

    before : the spectrum of a window that may have been much the same
    """
    if np.ptp(z) == 0:
        return Spectrum(float(np.finfo(float).tiny), dt)
    z = z - z.mean()
    fit = _Fit(
        z,
        dt,
        first_guess(frequencies(len(z), dt), periodogram(z, dt), dt, STARTS)
        if before is None or before.turbulence is None
        else before,
    )
    fit.background()
    for again in (False, True):
        more = fit.add(fit.maxima(lowest, most - len(fit.resonances)))
        if again and not more:
            break
        fit.improve()
        fit.prune()
    return fit.spectrum


class _Fit:
    """A periodogram I at f, a finer one, and the numbers of the spectrum: log noise, then three of every process, turbulence
    first where there is any (`densities`)."""

    def __init__(self, z: Array, dt: float, start: Spectrum):
        n = len(z)
        self.dt, self.f, self.I = dt, frequencies(n, dt), periodogram(z, dt)
        self.fine_f, self.fine = frequencies(n, dt, PAD), periodogram(z, dt, PAD)
        self.df = self.f[0]
        processes = [] if start.turbulence is None else [start.turbulence]
        self.first = 1 + 3 * len(processes)
        self.x = np.concatenate([[log(start.noise)], *map(_numbers, processes)])
        self.cells = Cells(self.f, self.I, np.ones(len(self.f)))

    @property
    def resonances(self) -> Array:
        """A row of numbers each."""
        return self.x[self.first :].reshape(-1, 3)

    @property
    def spectrum(self) -> Spectrum:
        """As processes."""
        found = [
            Ar2(float(np.exp(w)), float(1.0 / (1.0 + np.exp(-d))), float(np.exp(rms)), self.dt)
            for w, d, rms in self.x[1:].reshape(-1, 3)
        ]
        turbulence = found.pop(0) if self.first > 1 else None
        return Spectrum(float(np.exp(self.x[0])), self.dt, turbulence, tuple(found))

    def density(self, x: Array, f: Array) -> tuple[Array, Array]:
        """S (len(f),) and the derivatives of its logarithm by x, (len(x), len(f))."""
        noise = np.full_like(f, 2.0 * self.dt * np.exp(2.0 * x[0]))
        S, slopes = densities(x[1:].reshape(-1, 3), self.dt, f)
        total = noise + S.sum(axis=0)
        return total, np.vstack([2.0 * noise, (S[:, None] * slopes).reshape(-1, len(f))]) / total

    def background(self) -> None:
        """Noise and turbulence as they are in this window, whatever its peaks."""
        whole = self.cells.mean
        for _ in range(2):
            self.cells.mean = np.minimum(whole, CLIPPED * self.density(self.x, self.cells.frequency)[0])
            self.improve()
        self.cells.mean = whole

    def maxima(self, lowest: float, most: int) -> list[tuple[float, float]]:
        """Frequency and density of up to `most` maxima of the whitened periodogram that no peak explains, the highest first."""
        f = self.fine_f
        S = np.interp(f, self.f, self.density(self.x, self.f)[0])
        ratio = self.fine / S
        inner = ratio[1:-1]
        noise = 2.0 * self.dt * np.exp(2.0 * self.x[0])
        height = HEIGHT + np.log(f / AT) + DEEPER * np.log(S / noise)
        high = ((ratio > height) & (f >= max(lowest, FEWEST * self.df)))[1:-1]
        top = 1 + np.flatnonzero((inner >= ratio[:-2]) & (inner > ratio[2:]) & high)
        taken = list(np.exp(self.resonances[:, 0]) / (2.0 * pi))
        found: list[tuple[float, float]] = []
        for i in top[np.argsort(-ratio[top])]:
            if len(found) < most and all(abs(f[i] - other) > APART * self.df for other in taken):
                taken.append(f[i])
                found.append((float(f[i]), float(self.fine[i])))
        return found

    def add(self, peaks: Sequence[tuple[float, float]]) -> bool:
        """Resonances of START at these frequencies and densities; whether there are any."""
        for frequency, density in peaks:
            half = START * self.df
            new = Ar2(2.0 * pi * frequency, min(half / frequency, WIDEST), float(np.sqrt(0.5 * pi * half * density)), self.dt)
            self.x = np.concatenate([self.x, _numbers(new)])
        self.cells = Cells(self.f, self.I, np.ones(len(self.f)), np.exp(self.resonances[:, 0]) / (2.0 * pi))
        return len(peaks) > 0

    def improve(self) -> None:
        """Newton steps with the expected second derivatives, held back (Levenberg, Marquardt) where they lead uphill."""
        f, count, mean = self.cells.frequency, self.cells.count, self.cells.mean
        reach = np.full(len(self.x), REACH)
        reach[self.first :: 3] = np.minimum(0.5 * self.df / np.exp(self.resonances[:, 0]) * (2.0 * pi), REACH)
        x = self._allowed(self.x)
        S, slopes = self.density(x, f)
        value, held = count @ (np.log(S) + mean / S), 0.3
        for _ in range(STEPS):
            gradient, F = slopes @ (count * (1.0 - mean / S)), (slopes * count) @ slopes.T
            step = np.linalg.solve(F + np.diag(held * np.diag(F) + 1e-2), -gradient)
            trial = self._allowed(x + np.clip(step, -reach, reach))
            S_there, slopes_there = self.density(trial, f)
            there = count @ (np.log(S_there) + mean / S_there)
            if there >= value:
                held *= 10.0
                continue
            gain, x, S, slopes, value, held = value - there, trial, S_there, slopes_there, there, 0.3 * held
            if gain < ENOUGH:
                break
        self.x = x

    def _allowed(self, x: Array) -> Array:
        """x with every number within its bounds."""
        x = x.copy()
        if self.first > 1:
            x[1] = np.clip(x[1], log(pi * self.df), log(0.5 / self.dt))
            x[2] = np.clip(x[2], logit(0.1), logit(0.99))
        x[self.first :: 3] = np.clip(x[self.first :: 3], log(4.0 * pi * self.df), log(0.95 * pi / self.dt))
        least = np.minimum(2.0 * pi * NARROWEST * self.df / np.exp(x[self.first :: 3]), WIDEST)
        x[self.first + 1 :: 3] = np.clip(x[self.first + 1 :: 3], logit(least), logit(WIDEST))
        return x

    def prune(self) -> None:
        """Without the resonances that are not worth it."""
        count, mean = self.cells.count, self.cells.mean
        S, slopes = self.density(self.x, self.cells.frequency)
        share = 0.5 * slopes[self.first + 2 :: 3]  # of each in S
        without = S * np.maximum(1.0 - share, 1e-6)
        gain = (np.log(without) + mean / without - np.log(S) - mean / S) @ count
        self.x = np.concatenate([self.x[: self.first], self.resonances[gain > WORTH].ravel()])


def _numbers(p: Ar2 | Ar3) -> Array:
    return np.array([log(p.omega), logit(min(p.damping, 0.99)), log(max(p.rms, 1e-12))])
