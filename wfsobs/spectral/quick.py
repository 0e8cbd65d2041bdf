"""Fast fit of the spectrum of one mode, for repeated use on windows of a few seconds: milliseconds.

A short form of `identify`, without its tests and errors: noise and turbulence of the window before, adapted to this one; the
highest maxima of the whitened periodogram as resonances, all at once; a few Newton steps of Whittle's likelihood for all
parameters; and the same once more for the remainder. A false weak peak costs the filter less than a missed one, so the threshold
is lower than in `search`. Where coloured noise would raise the likelihood, the window is fitted with a background as well.

For windows that grow, the resonances of the window before are a first guess too (`follow_spectrum`): they are tracked, not made
anew. Turbulence is then of third order, since long windows show peaks that what it has too much beyond its corner would hide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import log, pi, sqrt

import numpy as np
from scipy.special import logit

from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.spectral.model import BACKGROUND_REACHES, BACKGROUND_WORTH, DAMPING, FAST, SLOW, Spectrum, densities, with_first_guess
from wfsobs.spectral.search import LOWEST
from wfsobs.spectral.whittle import FINE, NEAR, Cells, MissingSamples, first_guess, periodogram, periodogram_frequencies
from wfsobs.typing import Array


def numbers_of(p: Ar2 | Ar3) -> Array:
    """Return the numbers of a process, as `densities` takes them; of one of third order the log of the third corner besides."""
    numbers = np.array([log(p.omega), logit(min(p.damping, 0.99)), log(max(p.rms, 1e-12))])
    if isinstance(p, Ar3):
        alone = Ar2(p.omega, min(p.damping, 0.99), 1.0, p.dt)
        numbers = np.append(numbers, log(p.corner))
        numbers[2] = 0.5 * log(max(_slow_density(p) / _slow_density(alone), 1e-24))
    return numbers


def behind_pole(p: Ar2, corner: float) -> Ar3:
    """Return the process of third order with the poles of p and one more, and the density of p at low frequencies."""
    one = Ar3(p.omega, p.damping, max(corner, p.omega), 1.0, p.dt)
    return replace(one, rms=sqrt(_slow_density(p) / _slow_density(one)))


def _slow_density(p: Ar2 | Ar3) -> float:
    return float(p.psd(np.zeros(1))[0])


def one_pole(number: float, dt: float, f: Array) -> tuple[Array, Array]:
    """Return the power that passes a pole, 1 at low frequencies, and the derivative of its logarithm by `number`.

    number : log of the corner [rad/s];  f : frequencies [Hz]
    """
    decay = float(np.exp(number)) * dt
    a, turned = np.exp(-decay), 4.0 * np.sin(np.pi * f * dt) ** 2
    distance = (1.0 - a) ** 2 + a * turned
    by_a = -2.0 / (1.0 - a) - (turned - 2.0 * (1.0 - a)) / distance
    return (1.0 - a) ** 2 / distance, -decay * a * by_a


FEWEST = 15.0
"""Minimum periods of a peak in a window: with fewer, turbulence hides its maximum."""
PAD = 2
"""Frequencies per bin in the search for maxima."""
HEIGHT, AT, DEEPER = 6.0, 10.0, 0.35
"""Minimum I / S over noise of a maximum at AT [Hz] that counts as a peak.

It grows as log f, since the number of false maxima does, and by DEEPER log(S / noise), since a false peak takes more where
there is more turbulence.
"""
APART = 2.0
"""Minimum distance of two peaks, in bins."""
START = 0.5
"""Half width of a new peak, in bins."""
NARROWEST, WIDEST = 0.3, 0.3
"""Minimum half width of a peak in bins, the resolution of a window; its maximum damping."""
WORTH = 4.0
"""Minimum gain of log-likelihood of a peak that is kept."""
CLIPPED = 4.0
"""I / S above which a bin belongs to a peak, not to the background."""
STEPS, ENOUGH = 6, 0.2
"""Maximum number of Newton steps in a row; gain of log-likelihood below which they end."""
REACH = 1.0
"""Maximum change of a logarithmic parameter in one step; a frequency moves by half a bin."""


class WindowFit:
    """A fit: periodogram I at f, a finer one, and the parameters of the spectrum.

    x: log noise, then three per process (`densities`): turbulence first and then the background, where there is any. Turbulence
    of third order is that of second order behind one more pole, whose corner stands before the resonances. narrowest : as
    NARROWEST; cells : as FINE and NEAR; blur : what the window adds to the half width of a peak, in bins: x has it as it is
    shown, `spectrum` without.
    """

    extra: Ar2 | Ar3 | None
    narrowest: float
    sizes: tuple[int, int]
    dt: float
    fine_f: Array
    fine: Array
    f: Array
    df: float
    blur: float
    third: bool
    has_background: bool
    x: Array

    def __init__(
        self,
        z: Array,
        dt: float,
        start: Spectrum,
        extra: Ar2 | Ar3 | None = None,
        narrowest: float = NARROWEST,
        cells: tuple[int, int] = (FINE, NEAR),
        blur: float = 0.0,
    ):
        n = len(z)
        self.extra, self.narrowest, self.sizes = extra, narrowest, cells
        self.dt, self.fine_f, self.fine = dt, periodogram_frequencies(n, dt, PAD), periodogram(z, dt, PAD)
        self.f, self.I = self.fine_f[PAD - 1 :: PAD], self.fine[PAD - 1 :: PAD]
        self.df = self.f[0]
        self.blur = 2.0 * pi * blur * self.df
        smooth = [numbers_of(p) for p in (start.turbulence, start.background) if p is not None]
        self.third, self.has_background = isinstance(start.turbulence, Ar3), start.background is not None
        self.first: int = 1 + 3 * len(smooth) + self.third
        corner = smooth[0][3:] if self.third else []
        resonances = [numbers_of(self._show(p)) for p in start.resonances]
        self.x = np.concatenate([[log(start.noise)], *(numbers[:3] for numbers in smooth), corner, *resonances])
        self._last: tuple[Array, Array, tuple[Array, Array]] = (self.f[:0], self.x[:0], (self.f[:0], self.f[:0]))
        self._average()

    @property
    def resonances(self) -> Array:
        """Parameters of the resonances, a row each."""
        return self.x[self.first :].reshape(-1, 3)

    @property
    def spectrum(self) -> Spectrum:
        """The fit as processes."""
        found = [
            Ar2(float(np.exp(w)), float(1.0 / (1.0 + np.exp(-d))), float(np.exp(rms)), self.dt)
            for w, d, rms in self._of_second_order(self.x)
        ]
        turbulence: Ar2 | Ar3 | None = found.pop(0) if self.first > 1 else None
        background = found.pop(0) if self.has_background else None
        if self.third and isinstance(turbulence, Ar2):
            turbulence = behind_pole(turbulence, float(np.exp(self.x[self.first - 1])))
        return Spectrum(float(np.exp(self.x[0])), self.dt, turbulence, tuple(map(self._sharpen, found)), background)

    def _show(self, p: Ar2) -> Ar2:
        """Return a resonance as wide as this window shows it."""
        return replace(p, damping=min(p.damping + self.blur / p.omega, WIDEST)) if self.blur else p

    def _sharpen(self, p: Ar2) -> Ar2:
        """Return a resonance that this window shows so wide."""
        return replace(p, damping=max(p.damping - self.blur / p.omega, 0.5 * p.damping)) if self.blur else p

    def _of_second_order(self, x: Array) -> Array:
        """Return the numbers of all processes as those of second order, a row each."""
        return np.concatenate([x[1 : self.first - self.third], x[self.first :]]).reshape(-1, 3)

    def density(self, x: Array, f: Array) -> tuple[Array, Array]:
        """Return S (len(f),) and the derivatives of its logarithm by x, (len(x), len(f))."""
        if f is self._last[0] and np.array_equal(x, self._last[1]):  # `improve` ends where `prune` and others begin
            return self._last[2]
        noise = np.full_like(f, 2.0 * self.dt * np.exp(2.0 * x[0]))
        S, slopes = densities(self._of_second_order(x), self.dt, f)
        by_corner = np.zeros((0, len(f)))
        if self.third:
            falling, slope = one_pole(x[self.first - 1], self.dt, f)
            S[0] *= falling
            by_corner = (S[0] * slope)[None]
        total = noise + S.sum(axis=0)
        if self.extra is not None:
            total += self.extra_density if f is self.cells.frequency else self.extra.psd(f)
        slopes *= (S / total)[:, None]
        if self.has_background:
            slopes[1, 1] = 0.0  # the background keeps its damping
        by_numbers, n_smooth = slopes.reshape(-1, len(f)), self.first - self.third - 1
        found = total, np.vstack([2.0 * noise / total, by_numbers[:n_smooth], by_corner / total, by_numbers[n_smooth:]])
        self._last = f, x, found
        return found

    def adapt(self) -> None:
        """Adapt noise, turbulence and background to this window, whatever its peaks."""
        whole = self.cells.mean
        for _ in range(2 + self.has_background):
            self.cells.mean = np.minimum(whole, CLIPPED * self.density(self.x, self.cells.frequency)[0])
            self.improve()
            if self.has_background and self.x[4] < self.x[1]:  # the two have changed places
                self.x[1:7] = *self.x[4:7], self.x[1], logit(DAMPING), self.x[3]
        self.cells.mean = whole

    def misfit(self) -> float:
        """Compute the negative log-likelihood, and for every resonance what it has to gain."""
        S, _ = self.density(self.x, self.f)
        return float(np.sum(np.log(S) + self.I / S)) + WORTH * len(self.resonances)

    def worth_of_background(self) -> float:
        """Compute what the background gains of log-likelihood, all else as it is."""
        return float(self._gains(slice(6, 7))[0])

    def worst_octave(self) -> float:
        """Compute by how many standard deviations the periodogram differs from the fit in the octave where it does most."""
        f, count = self.cells.frequency, self.cells.count
        excess = count * (self.cells.mean / self.density(self.x, f)[0] - 1.0)
        octave = np.floor(np.log2(f / f[0])).astype(int)
        bins = np.bincount(octave, count)
        return float(np.max(np.abs(np.bincount(octave, excess)[bins > 0]) / np.sqrt(bins[bins > 0])))

    def maxima(self, lowest: float, most: int) -> list[tuple[float, float]]:
        """Return frequency and density of up to `most` unexplained maxima of the whitened periodogram, the highest first."""
        if most <= 0:
            return []
        f = self.fine_f
        at = self.f if self.sizes == (FINE, NEAR) else self.cells.frequency
        S = np.interp(f, at, self.density(self.x, at)[0])
        ratio = self.fine / S
        inner, lowest = ratio[1:-1], max(lowest, FEWEST * self.df)
        noise = 2.0 * self.dt * np.exp(2.0 * self.x[0])
        high = (inner > HEIGHT + log(lowest / AT)) & (f[1:-1] >= lowest)  # few: the least height of all, since S > noise
        top = 1 + np.flatnonzero((inner >= ratio[:-2]) & (inner > ratio[2:]) & high)
        top = top[ratio[top] > HEIGHT + np.log(f[top] / AT) + DEEPER * np.log(S[top] / noise)]
        taken = list(np.exp(self.resonances[:, 0]) / (2.0 * pi))
        found: list[tuple[float, float]] = []
        for i in top[np.argsort(-ratio[top])]:
            if len(found) < most and all(abs(f[i] - other) > APART * self.df for other in taken):
                taken.append(f[i])
                found.append((float(f[i]), float(self.fine[i])))
        return found

    def add(self, peaks: Sequence[tuple[float, float]]) -> bool:
        """Add resonances of width START at these frequencies and densities; return whether there are any."""
        for frequency, density in peaks:
            half = START * self.df
            new = Ar2(2.0 * pi * frequency, min(half / frequency, WIDEST), float(np.sqrt(0.5 * pi * half * density)), self.dt)
            self.x = np.concatenate([self.x, numbers_of(new)])
        if peaks:
            self._average()
        return len(peaks) > 0

    def _average(self) -> None:
        """Average the periodogram in cells that are narrow near the resonances."""
        centres = np.exp(self.resonances[:, 0]) / (2.0 * pi)
        self.cells: Cells = Cells(self.f, self.I, np.ones(len(self.f)), centres, sizes=self.sizes)
        if self.extra is not None:
            self.extra_density: Array = self.extra.psd(self.cells.frequency)

    def improve(self) -> None:
        """Take Newton steps with the expected second derivatives, damped (Levenberg, Marquardt) where they lead uphill."""
        f, count, mean = self.cells.frequency, self.cells.count, self.cells.mean
        root = np.sqrt(count)
        reach = np.full(len(self.x), REACH)
        reach[self.first :: 3] = np.minimum(0.5 * self.df / np.exp(self.resonances[:, 0]) * (2.0 * pi), REACH)
        x = self._clip_to_bounds(self.x)
        S, slopes = self.density(x, f)
        value, held = count @ (np.log(S) + mean / S), 0.3
        for _ in range(STEPS):
            weighted = slopes * root
            gradient, F = weighted @ (root * (1.0 - mean / S)), weighted @ weighted.T
            step = np.linalg.solve(F + np.diag(held * np.diag(F) + 1e-2), -gradient)
            trial = self._clip_to_bounds(x + np.clip(step, -reach, reach))
            S_there, slopes_there = self.density(trial, f)
            there = count @ (np.log(S_there) + mean / S_there)
            if there >= value:
                held *= 10.0
                continue
            gain, x, S, slopes, value, held = value - there, trial, S_there, slopes_there, there, 0.3 * held
            if gain < ENOUGH:
                break
        self.x, self._last = x, (f, x, (S, slopes))

    def _clip_to_bounds(self, x: Array) -> Array:
        """Return x with every parameter clipped to its bounds."""
        x = x.copy()
        if self.first > 1:
            x[1] = np.clip(x[1], log(pi * self.df), log(0.5 / self.dt))
            x[2] = np.clip(x[2], logit(0.1), logit(0.99))
        if self.third:
            x[1] = np.clip(x[1], log(SLOW / self.dt), log(FAST / self.dt))
            x[self.first - 1] = np.clip(x[self.first - 1], x[1], log(2.0 * FAST / self.dt))
        x[self.first :: 3] = np.clip(x[self.first :: 3], log(4.0 * pi * self.df), log(0.95 * pi / self.dt))
        least = np.minimum(2.0 * pi * self.narrowest * self.df / np.exp(x[self.first :: 3]), WIDEST)
        x[self.first + 1 :: 3] = np.clip(x[self.first + 1 :: 3], logit(least), logit(WIDEST))
        return x

    def prune(self) -> None:
        """Remove resonances that gain too little likelihood."""
        gain = self._gains(slice(self.first + 2, None, 3))
        self.x = np.concatenate([self.x[: self.first], self.resonances[gain > WORTH].ravel()])

    def _gains(self, strengths: slice) -> Array:
        """Compute what processes gain of log-likelihood, all else as it is; strengths : where the logs of their rms are in x."""
        count, mean = self.cells.count, self.cells.mean
        S, slopes = self.density(self.x, self.cells.frequency)
        without = S * np.maximum(1.0 - 0.5 * slopes[strengths], 1e-6)  # half of the slope is the share of each in S
        return (np.log(without) + mean / without - np.log(S) - mean / S) @ count


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
        if known.worth_of_background() < BACKGROUND_WORTH:
            known = fitted(replace(start, background=None))
    elif complete and most > 0 and start.turbulence is not None and known.worst_octave() > SUSPECT:
        others = [fitted(with_first_guess(start, reach)) for reach in BACKGROUND_REACHES]
        known = min([known, *others], key=lambda fit: fit.misfit() + BACKGROUND_WORTH * fit.has_background)
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
