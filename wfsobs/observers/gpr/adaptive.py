"""Adaptive Gaussian process regression: inputs, kernel and targets learnt from the record itself, again and again.

The GPR of the paper has given bands, sees raw windows, and its targets online are causal band-passes, which lag and hold
turbulence. This one has no prior. It learns from the last seconds of z; between two times of learning it
is a fixed filter of the whitened measurements. It learns after the estimate of a step, for those that follow: first from half of
`adaptive.window`, and its window then grows to twice `adaptive.window`.

The spectrum of the window (`wfsobs.spectral.quick`) says which lines stand above the continuum, S_z = S_c + S_v. From it come

- the inputs: z whitened by the continuum, the innovations of a Kalman filter that knows of turbulence and noise alone. They are
  high-passed with the corner and the slope that the turbulence has, and lines stand out of them;
- the kernel: weights of a window with the spectrum S_v S_c / S_z: the bands of the lines, as wide as they rise above the
  continuum;
- the targets: the vibration that the smoother of that spectrum finds, from the past and the future of a step as far as they are
  in the window. The expectation given the window of x of a quantity and of its expectation given all of z are the same, so that a
  regression on them tends to the best there is, without the lag of causal band-passes and without their turbulence.

The kernel is linear, and its weights are a process in the lag: the target of the window x, its newest sample first, is
f = w'x + noise, with w ~ N(0, s^2 C) and C (depth, depth) the covariance of a stationary process: kernel s^2 x'C x' on windows,
weights that oscillate in the bands of C alone. With C = L L' (L of as many columns as C has digits in those bands) and X the
windows as rows, the posterior mean of w is

    w = L (L'X'X L + lambda I)^-1 L'X'f,    lambda = sigma_n^2 / s^2,

which is k(x)' (K + sigma_n^2 I)^-1 f of the regression on windows, at a cost in which their number does not enter. lambda and
sigma_n are the likeliest (marginal likelihood, sigma_n in closed form).

The smoother is of a fixed interval: with x_pred and e the predictions and innovations of the steady-state Kalman filter, F = A
(I - L C) and S the variance of e,

    lambda[k] = C' e[k] / S + F' lambda[k+1],    x_s[k] = x_pred[k] + P lambda[k]

is the smoothed state (Bryson and Frazier 1963), P - P Lambda P its covariance, Lambda that of lambda. The window begins with the
state zero of covariance P.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided, sliding_window_view
from scipy.linalg import toeplitz
from scipy.linalg.lapack import dpstrf

from wfsobs.observers.base import VIBRATION, Look, Observer, Tunable
from wfsobs.observers.kalman.adaptive import identification_settings
from wfsobs.observers.kalman.filters import MIN_NOISE
from wfsobs.observers.kalman.window_model import ADAPTIVE, Adaptive, pack_spectrum, unpack_spectrum, window_lengths
from wfsobs.observers.step import HeldEstimate, StepError, run_frames, whole_frames
from wfsobs.observers.stepping import FilterBank, SampleHistory, Saved
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Estimates, Measurements, RecordError, Sampling
from wfsobs.signal.gains import lyapunov, steady_state
from wfsobs.signal.periodic import FilterStep, PeriodicFilter
from wfsobs.signal.statespace import DisturbanceModel, disturbance_model
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.quick import SHORTEST, quick_spectrum
from wfsobs.spectral.search import missed_variance
from wfsobs.spectral.whittle import periodogram, periodogram_frequencies
from wfsobs.typing import Array


class Smoother(NamedTuple):
    """The smoother of one target.

    forward  : z -> prediction of z and of the target, from the measurements before
    backward : innovations in reverse -> what the measurements now and later add to the target
    variance : of its error far from the ends [um^2]
    """

    forward: PeriodicFilter
    backward: PeriodicFilter
    variance: float

    def run(self, z: Array) -> Array:
        """Return the target at every step of z (n,), given all of z, (n,)."""
        expected, target = self.forward.run(z[:, None]).T
        return target + self.backward.run((z - expected)[::-1, None])[::-1, 0]


def smoother(model: DisturbanceModel, target: str, noise: float) -> Smoother:
    """Return the smoother of a target, noise : rms of the white noise of z [um]. Raises RiccatiError."""
    s, A, C, row = steady_state(model.A, model.C, model.Q, np.array(noise**2)), model.A, model.C[None], model.outputs[target]
    F, S = A - s.K @ C, float((C @ s.P @ C.T)[0, 0]) + noise**2
    into, h = C.T / S, row @ s.P
    variance = row @ s.P @ row - h @ lyapunov(F.T, into @ C) @ h
    return Smoother(
        PeriodicFilter([(F, s.K, np.vstack([C, row]), np.zeros((2, 1)))]),
        PeriodicFilter([(F.T, into, (h @ F.T)[None], h[None] @ into)]),
        max(float(variance), 0.0),
    )


WORTH = 8.0
"""Minimum gain of log-likelihood of a line that is learnt: twice what the fit asks, since a false one is turbulence."""
BINS = 16384
"""Steps of the DFT that turns the spectrum of weights into their covariance; more than twice the depth."""
DIGITS = 3e-3
"""Of C, over its largest number: what is smaller is in no band. With a thousandth of it errors change by 1e-4 of themselves."""
RATIOS = np.logspace(-6.0, 4.0, 81)
"""lambda over that mean among which the likeliest is chosen; the estimate changes little from one to the next."""
SETTLED = 2
"""Depths of a window until filters that start at rest have settled: the first training window ends there."""


class Learnt(NamedTuple):
    """What has been learnt from one window.

    fit     : its spectrum, None before the first
    mean    : of the window [um]
    weights : of the whitened samples, the newest first, (depth,); zero where no line stands above the continuum
    sd      : standard deviation of the estimate's error [um]: by the model, and what lines may be missed; NaN before the first
    """

    fit: Spectrum | None
    mean: float
    weights: Array
    sd: float

    @property
    def whitener(self) -> FilterStep:
        """The filter of the inputs."""
        return whitener_of(self.fit)


def nothing_learnt(depth: int) -> Learnt:
    """Return what is known before the first window: there is no estimate."""
    return Learnt(None, 0.0, np.full(depth, np.nan), np.nan)


def learn(z: Array, dt: float, depth: int, most: int, lowest: float, last: Learnt, horizon: int = 0) -> Learnt:
    """Learn from a window z (n,) [um]; where it has no spectrum, what was learnt last stays.

    depth : samples in a window of the regression; most, lowest : maximum number and minimum frequency [Hz] of lines; horizon :
    steps from a window's end to its target
    """
    mean = float(z.mean())
    z = z - mean
    try:
        with np.errstate(divide="raise", over="raise", invalid="raise"):
            fit = quick_spectrum(z, dt, most, lowest, last.fit)
            lines = standing(fit, z)
            missed = missed_variance(lines, z, lowest)
            if not lines.resonances:
                return Learnt(fit, mean, np.zeros(depth), float(np.sqrt(missed)))
            target = smoother(disturbance_model(lines.continuum, lines.resonances), VIBRATION, max(lines.noise, MIN_NOISE))
            x = PeriodicFilter([whitener_of(fit)]).run(z[:, None])[:, 0]
            first = SETTLED * depth
            found = fit_bands(x, target.run(z)[first + horizon :], first, weight_covariance(lines, depth))
            sd = np.sqrt(target.variance + found.noise**2 + found.spread**2 + missed)
            return Learnt(fit, mean, found.weights, float(sd))
    except (ValueError, ArithmeticError):
        return last


def standing(fit: Spectrum, z: Array) -> Spectrum:
    """Return the spectrum with the lines alone that are worth WORTH in log-likelihood of z (n,), mean zero."""
    f, found = periodogram_frequencies(len(z), fit.dt), periodogram(z, fit.dt)
    S = fit.psd(f)
    without = [np.maximum(S - line.psd(f), 1e-6 * S) for line in fit.resonances]
    worth = [float(np.sum(np.log(rest / S) + found / rest - found / S)) for rest in without]
    kept = tuple(line for line, gain in zip(fit.resonances, worth, strict=True) if gain > WORTH)
    return replace(fit, resonances=kept)


@lru_cache(maxsize=64)
def whitener_of(fit: Spectrum | None) -> FilterStep:
    """Return the filter z -> innovations of the continuum, over their rms, and their states; (F, G, H, J)."""
    if fit is None or fit.turbulence is None:
        noise = 1.0 if fit is None else max(fit.noise, MIN_NOISE)
        return np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), np.array([[1.0 / noise]])
    model, noise = disturbance_model(fit.continuum, []), max(fit.noise, MIN_NOISE)
    s, C = steady_state(model.A, model.C, model.Q, np.array(noise**2)), model.C[None]
    scale = np.sqrt(float((C @ s.P @ C.T)[0, 0]) + noise**2)
    return model.A - s.K @ C, s.K, -C / scale, np.array([[1.0 / scale]])


def weight_covariance(lines: Spectrum, depth: int) -> Array:
    """Return the covariance of the weights at lags 0 ... depth - 1, (depth,), of the spectrum S_v S_c / S_z."""
    f = np.fft.rfftfreq(BINS, lines.dt)
    whole, continuum = lines.psd(f), replace(lines, resonances=()).psd(f)
    return np.fft.irfft((whole - continuum) * continuum / whole)[:depth]


class BandRegression(NamedTuple):
    """A regression.

    weights : posterior mean, the newest sample first, (depth,)
    noise   : sigma_n, rms of what windows cannot know of their targets [unit of targets]
    spread  : rms of the standard deviation of w'x over the training windows [same]
    ratio   : lambda
    """

    weights: Array
    noise: float
    spread: float
    ratio: float


def factor_of(covariance: Array, digits: float = DIGITS) -> Array:
    """Return L (depth, rank) of the stationary covariance (depth,), L L' = C but for `digits`."""
    C = toeplitz(covariance / covariance[0])
    factor, pivots, rank, _ = dpstrf(C, tol=digits, lower=1)
    out = np.zeros((len(C), rank))
    out[pivots - 1] = np.tril(factor[:, :rank])
    return out


def window_products(x: Array, targets: Array, first: int, depth: int) -> tuple[Array, Array]:
    """Return X'X (depth, depth) and X'f (depth,) of the windows that end at first ... first + len(targets) - 1.

    x : samples (n,); first >= depth. Inner products slide: the next on a diagonal has one sample less and one more.
    """
    end = first + len(targets)
    lags = x[first - depth + 1 : end]
    ends = [x[last - 1 : last - depth - 1 if last > depth else None : -1] for last in (first, end)]
    come, gone = (sliding_window_view(np.concatenate([part[:-1], np.zeros(depth)]), depth) * part[:, None] for part in ends)
    diagonals = np.cumsum(np.vstack([np.correlate(lags, x[first:end], "valid")[::-1], (come - gone)[:-1]]), axis=0)
    upper = np.zeros((depth, 2 * depth))
    as_strided(upper, diagonals.shape, (sum(upper.strides), upper.strides[1]))[...] = diagonals  # [i, j] at [i, i + j]
    upper = upper[:, :depth]
    return upper + np.triu(upper, 1).T, np.correlate(lags, targets, "valid")[::-1]


def fit_bands(x: Array, targets: Array, first: int, covariance: Array) -> BandRegression:
    """Fit the targets (m,) of the windows of x (n,) that end at step `first` and later; covariance : of weights, (depth,)."""
    L, m = factor_of(covariance), len(targets)
    gram, along = window_products(x, targets, first, len(L))
    values, vectors = np.linalg.eigh(L.T @ gram @ L)
    values, b = np.maximum(values, 0.0), vectors.T @ (L.T @ along)
    ratios = RATIOS * values.mean()
    rest = targets @ targets - np.sum(b**2 / (values + ratios[:, None]), axis=1)
    likelihood = -0.5 * (m * np.log(rest) + np.sum(np.log1p(values / ratios[:, None]), axis=1))
    best = int(np.argmax(likelihood))
    noise2, inverse = rest[best] / m, 1.0 / (values + ratios[best])
    return BandRegression(
        L @ (vectors @ (b * inverse)),
        float(np.sqrt(noise2)),
        float(np.sqrt(noise2 * np.sum(values * inverse) / m)),
        float(ratios[best]),
    )


ORDER = 4
"""Maximum number of states of a whitener: two of the turbulence, and of a background where there is one."""
SLOWER = 1.5
"""Time from learning to learning, over `adaptive.interval`: less often costs errors, more often processor time alone."""


class Schedule(NamedTuple):
    """When it learns from what, all in steps.

    first, interval : until the first time of learning, and from one to the next
    longest         : maximum length of the identification window
    depth           : of a window of the regression
    """

    first: int
    interval: int
    longest: int
    depth: int


def schedule_of(settings: Adaptive, dt: float) -> Schedule:
    """Return the schedule of settings. Raises RecordError for a window of too few samples."""
    found = window_lengths(settings, dt)
    found.check(settings, dt)
    first = max(found.window // 2, SHORTEST)
    return Schedule(first, round(SLOWER * found.interval), 2 * found.window, min(settings.depth, first // 4))


class AdaptiveGprEstimator(HeldEstimate):
    """The regression of all modes, for the vibration now or `horizon` frames ahead. It learns in `settle`.

    Raises StepError where the horizon leaves too few targets.
    """

    settings: Adaptive
    sampling: Sampling
    count: int

    state_names: tuple[str, ...] = ("_samples", "_recent", "_filters", "_mean", "_sd", "count")

    def __init__(self, settings: Adaptive, sampling: Sampling, horizon: int = 0):
        super().__init__(sampling.n_modes, float(horizon))
        self.settings, self.sampling, self._ahead = settings, sampling, horizon
        self.schedule: Schedule = schedule_of(settings, sampling.dt)
        if horizon >= self.schedule.first // 4:
            raise StepError(f"gpr-adaptive: {horizon} frames ahead: takes less than an eighth of adaptive.window")
        n = sampling.n_modes
        none = np.zeros((ORDER, ORDER)), np.zeros((ORDER, 1)), np.zeros((1, ORDER)), np.zeros((1, 1))
        self._filters = FilterBank([PeriodicFilter([none])] * n)  # the whiteners
        self._samples, self._recent = SampleHistory(n, self.schedule.longest), SampleHistory(n, self.schedule.depth)  # whitened
        self._weights, self._means, self._sds = np.zeros((n, self.schedule.depth)), np.zeros(n), np.zeros(n)
        self.count, self._pending = 0, False
        self.learnt = [nothing_learnt(self.schedule.depth)] * n
        self._use()
        self.mark_start()

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Run over a record, frame by frame. Raises RecordError for one in which it cannot learn once."""
        needed = self.schedule.first + measurements.delay
        if measurements.n_steps <= needed:
            raise RecordError(
                f"the record has {measurements.n_steps} steps; half of adaptive.window and one more are {needed + 1}"
            )
        return run_frames(self, (VIBRATION,), measurements, watch)

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame; those of the mirror's first delay are left out: what it did before is not known."""
        self.settle()
        self.count += 1
        if self.count <= self.sampling.delay:
            return
        self._samples.push(z)
        since = self.count - self.sampling.delay - self.schedule.first
        if since > 0:
            self._estimate(z)
        self._pending = since >= 0 and since % self.schedule.interval == 0

    def _estimate(self, z: Array) -> None:
        """Whiten the samples z (n_modes,), and put their windows through the weights."""
        self._recent.push(self._filters.step((z - self._means)[:, None])[:, 0])
        np.einsum("ij,ij->i", self._weights, self._recent.last(self.schedule.depth), out=self._mean)
        self._sd[...] = self._sds

    def settle(self) -> None:
        """Learn, where the last frame ended an interval; estimates of the next frames are of it."""
        if not self._pending:
            return
        self._pending = False
        size = min(self.count - self.sampling.delay, self.schedule.longest)
        s, windows = self.settings, self._samples.last(size)
        self.learnt = [
            learn(z, self.sampling.dt, self.schedule.depth, s.peak_count, s.lowest, last, self._ahead)
            for last, z in zip(self.learnt, windows, strict=True)
        ]
        self._use()
        past = [self._whiten_past(mode, z - one.mean) for mode, (one, z) in enumerate(zip(self.learnt, windows, strict=True))]
        self._recent.load({"newest": np.array(past)})

    def _use(self) -> None:
        """Take over what was learnt."""
        for mode, one in enumerate(self.learnt):
            F, G, H, J = one.whitener
            order, filter_map = len(F), self._filters.maps[0][mode]
            filter_map[...] = 0.0
            filter_map[:order, :order], filter_map[:order, ORDER:] = F, G
            filter_map[ORDER:, :order], filter_map[ORDER:, ORDER:] = H, J
            self._weights[mode], self._means[mode], self._sds[mode] = one.weights[::-1], one.mean, one.sd

    def _whiten_past(self, mode: int, z: Array) -> Array:
        """Take the whitener of a mode through its window z (n,) from rest; return its last outputs, (depth,)."""
        F, G, H, J = self.learnt[mode].whitener
        whitener = PeriodicFilter([(F, G, np.vstack([H, F]), np.vstack([J, G]))])
        out = whitener.run(z[:, None], since=len(z) - self.schedule.depth)
        self._filters.x[mode] = 0.0
        self._filters.x[mode, : len(F)] = out[-1, 1:]
        return out[:, 0]

    def save(self) -> Saved:
        """Return a copy of the state: the window, what was learnt, and the states of the whiteners."""
        self.settle()
        rows = self.settings.peak_count + 2
        return super().save() | {
            "spectra": np.array([pack_spectrum(one.fit, rows) for one in self.learnt]),
            "weights": np.array([one.weights for one in self.learnt]),
            "means": np.array([[one.mean, one.sd] for one in self.learnt]),
        }

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        super().load(state)
        self._pending = False
        packed = zip(state["spectra"], state["means"].tolist(), state["weights"], strict=True)
        self.learnt: list[Learnt] = [
            Learnt(unpack_spectrum(table, self.sampling.dt), mean, weights.copy(), sd) for table, (mean, sd), weights in packed
        ]
        self._use()

    def take_over(self, old: Any) -> None:
        """Go on from another design with the same windows, number of peaks and horizon. Raises StepError."""
        if (old.schedule, old.settings.peak_count, old.horizon) != (self.schedule, self.settings.peak_count, self.horizon):
            raise StepError("the designs have other windows, another number of peaks or horizon")
        self.load(old.save())


def gpr_adaptive(_prior: Prior, settings: Adaptive, sampling: Sampling, horizon: float) -> AdaptiveGprEstimator:
    """Return the regression of the vibration `horizon` frames ahead. Raises RecordError for a window of too few samples."""
    return AdaptiveGprEstimator(settings, sampling, whole_frames(horizon, "gpr-adaptive"))


def seconds(settings: Adaptive, n_steps: int, n_modes: int, dt: float) -> float:
    """2 ms + 3.2 us per sample for every time of learning, one mode after the other [s]; nothing for a window that it refuses."""
    if settings.window < SHORTEST * dt:
        return 0.0
    schedule = schedule_of(settings, dt)
    ends = range(schedule.first, n_steps, schedule.interval)
    return n_modes * sum(2e-3 + 3.2e-6 * min(end, schedule.longest) for end in ends)


def _settings_used(prior: Prior, settings: Adaptive) -> tuple[float, ...]:
    return *identification_settings(prior, settings), settings.depth


GPR_ADAPTIVE = Observer(
    "gpr-adaptive",
    "Adaptive GPR",
    (VIBRATION,),
    help="Gaussian process regression that learns inputs, kernel and targets from the last 8 s; not in the paper",
    settings=ADAPTIVE,
    tunable=Tunable(("adaptive.window", "adaptive.depth"), ("adaptive.interval",)),
    weight=50.0,
    seconds=seconds,
    look=Look("Adaptive GPR", "#01734F", "#7AFED9", (20, 2, 2, 2), width=1.8),
    step=gpr_adaptive,
    counts=_settings_used,
)
