"""Vibration by regression on windows: Gaussian processes and ridge regression.

The online GPR is trained anew at every step on the last m windows (paper, Algorithm 3). At step k the newest training pair is
(x[k-1], target[k-1]). The target of window j is the vibration at step j: the causal Butterworth bank on z, of which value j + 1
belongs to step j and is known at step j + 1.

The offline one (paper, Algorithms 1 and 2) is trained once, on a record of its own, and so is ridge regression. The target of a
window is the zero-phase Butterworth reference of the training record's open-loop twin at the window's last step; without a
twin, that of its z.

With w = a - b c and c = (delta.a) / (1 / s2 + delta.b) (`windows` has a, b, delta), a prediction is

    mean = kappa.w + delta_t c,
    variance = M_tt - |L^-1 kappa|^2 + (delta_t - kappa.b)^2 / (1 / s2 + delta.b),    L L' = M + sigma_n^2 I.

The variance, that of the vibration without the noise of a target, costs m^2 operations where the mean costs m: it is computed
once in so many steps and held.

Ridge regression is what a GPR has to beat. With windows as rows of X, targets f and both centred, the weights are w = X' (X X' +
lambda I)^-1 f. A squared-exponential kernel whose length scale l is far above the norm of the windows is linear, k = s2 (1 - |x -
x'|^2 / 2 l^2), and the GPR then is this with lambda = (sigma_n l / sigma_SE)^2 and a free constant.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided, sliding_window_view
from scipy.linalg import solve

from wfsobs.observers.base import VIBRATION, Look, Observer, Tunable
from wfsobs.observers.baselines import online_filters, online_reference, open_loop_reference
from wfsobs.observers.gpr.sliding_regression import LateRegression, SlidingRegression, finish, run_lengths, slide
from wfsobs.observers.gpr.windows import (
    Gpr,
    Points,
    SquaredExponential,
    Windows,
    band,
    check_condition,
    over_modes,
    sliding_products,
    square_from_band,
    squared_norms,
    tunable,
    turns,
)
from wfsobs.observers.step import HeldEstimate, StepError, run_frames, whole_frames
from wfsobs.observers.stepping import FilterBank, Saved
from wfsobs.prior import Bands, OfflineBands, OnlineBands, Part, Prior
from wfsobs.progress import QUIET, Watch
from wfsobs.record import DELAY, Estimates, Measurements, RecordError, Sampling, Signals, Training, pseudo_open_loop
from wfsobs.settings import Real, Section, Whole
from wfsobs.signal.linalg import eliminate, solve_lower, solve_rows
from wfsobs.typing import Array


class OnlineGpr(Gpr):
    """Online GPR: retrained at every step on the last windows."""

    training_size: Whole = Whole(
        511, bounds=(2, 2048), label="Training size m", doc="Number of training windows (paper, Table 4)."
    )
    depth: Whole = Whole(170, bounds=(1, 2000), label="Depth d", doc="Samples in a window (paper, Table 4).")
    signal_std: Real = Real(
        30.0,
        bounds=(1e-3, 1e4),
        softbounds=(0.1, 100.0),
        label="Output scale σ_SE",
        doc="sigma_SE of the squared-exponential kernel [um] (paper, eq. 13 and Table 4).",
    )
    noise_std: Real = Real(
        0.1,
        bounds=(1e-4, 10.0),
        softbounds=(0.01, 1.0),
        label="Noise σ_awgn",
        doc="sigma_awgn on the diagonal of the covariance [um] (paper, Table 4).",
    )


BAND_ENTRIES, BAND_ROWS = 4_000_000, 8192
"""Covariances (32 MB) and windows at a time: enough to share the overlap of the runs, and soon done."""


def kernel_of(settings: Gpr) -> SquaredExponential:
    """Return the kernel with the numbers of the settings."""
    return SquaredExponential(settings.signal_std, settings.length_scale, settings.noise_std)


def online_targets(record: Signals, bands: Bands) -> Array:
    """Return the vibration at every step, from the causal bank one step later, (n, n_modes) [um]; 0 at the last step."""
    f = online_reference(bands, record.z, record.dt)
    return np.vstack([f[1:], np.zeros((1, record.n_modes))])


def predict_sliding(
    signals: Array,
    targets: Array,
    depth: int,
    m: int,
    kernel: SquaredExponential,
    deliver: Callable[[int, int, Array], None] | None = None,
    check: Callable[[], None] = QUIET.check,
) -> tuple[Array, Array]:
    """Predict at every step from the m windows before it.

    signals (n, channels), targets (n,): target of the window ending at each step; step k uses targets k - m ... k - 1.
    deliver : told (start, stop, mean) of each block of steps as it is done
    check   : called between pieces of work; what it raises ends the work
    Returns (mean, variance), each (n,), NaN before step depth + m - 1; variance is that of a noisy target.
    """
    n = signals.shape[0]
    mean, variance = np.full(n, np.nan), np.full(n, np.nan)
    lengths = run_lengths(m)
    run = lengths[0] if lengths else 256
    leaf_window = lengths[-1] - 1 if lengths else m
    # As many runs at a time as the band has room for: their windows overlap.
    chunk = run * max(1, (min(BAND_ENTRIES // (m + 1), BAND_ROWS) - m) // run)
    for start in range(depth + m - 1, n, chunk):
        stop = min(start + chunk, n)
        runs = -(-(stop - start) // run)
        V, points = band(signals, depth, kernel, start - m, m + runs * run, m)
        for r in range(runs):
            check()
            at = start + r * run
            to = min(at + run, n)
            leaves = np.empty((leaf_window + 3, leaf_window + 3, run))
            # The matrix over [m + run points | f | delta] of these steps, and the points' targets.
            row, S, f = r * run, np.zeros((m + run + 2, m + run + 2), order="F"), np.zeros(m + run)
            S[:-2, :-2] = square_from_band(V, row, m + run)
            S[-1, :-2], S[-1, -1] = points.delta[row : row + m + run], -1.0 / kernel.variance
            known = targets[at - m : at + run]
            f[: known.size] = known
            check_condition(S[:m, :m], kernel)
            slide(S, f, m, lengths, leaves, check=check)
            values, spread = finish(leaves, leaf_window)
            mean[at:to], variance[at:to] = values[: to - at], spread[: to - at]
            if deliver:
                deliver(at, to, mean[at:to])
    return mean, variance


class OnlineEstimator(HeldEstimate):
    """Online GPR of all modes one frame at a time, for the vibration now or a number of frames ahead.

    The target of a window is the vibration h frames later as the causal bank on z gives it, one frame late: at step k that of
    window k - 1 - h is known. What it learns from a frame it learns in `settle`, after the estimate.

    Parameters
    ----------
    prior : Prior
        Bands of the bank that gives the targets, and training data for standardised inputs.
    settings : OnlineGpr
        Of windows, training set and covariance.
    sampling : Sampling
        Of the loop.
    weights : Array
        Of the vibration now, one frame ahead and so on in what it learns; fewer than m.
    """

    windows: Windows
    weights: Array
    needs_command: bool

    state_names: tuple[str, ...] = ("windows", "bank", "_mean", "_band_signals", "regression")

    def __init__(self, prior: Prior, settings: OnlineGpr, sampling: Sampling, weights: Array):
        n, late, bands = sampling.n_modes, len(weights) - 1, prior.bands
        assert bands is not None
        super().__init__(n, float(late))
        self.windows, self.weights, self._bands = Windows(settings, sampling, 1, prior.training), weights, bands
        self.needs_command = self.windows.needs_command
        self._band_signals = np.zeros((len(weights), n))  # oldest first
        self._size = settings.depth, settings.training_size, 2 if self.needs_command else 1, kernel_of(settings)
        self.bank: FilterBank = online_filters(bands, sampling)
        self._pending = False
        self.regression: LateRegression | SlidingRegression = (
            LateRegression(*self._size, late, n) if late else SlidingRegression(*self._size, n)
        )

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Run over a record, for the vibration now all modes at the same time, in blocks; that to come frame by frame."""
        if len(self.weights) > 1:
            return run_frames(self, (VIBRATION,), measurements, watch)
        (depth, m, _, kernel), n_steps = self._size, measurements.n_steps
        if n_steps < depth + m:
            raise RecordError(f"the record has {n_steps} steps; depth + training size need {depth + m}")
        targets = online_targets(measurements, self._bands)
        values, done = np.full((n_steps, measurements.n_modes), np.nan), np.zeros(measurements.n_modes)

        def one(mode: int, watch: Watch) -> Array:
            def deliver(start: int, stop: int, mean: Array) -> None:
                values[start:stop, mode] = mean
                done[mode] = stop / n_steps
                watch.step(float(done.mean()))
                watch.partial(VIBRATION, values)

            signals = self.windows.channels(measurements, mode)
            return np.column_stack(predict_sliding(signals, targets[:, mode], depth, m, kernel, deliver, watch.check))

        found = over_modes(measurements.n_modes, one, watch)
        latent = np.sqrt(np.maximum(found[:, 1::2] - kernel.noise_std**2, 0.0))  # of the vibration, not of a noisy target
        return Estimates({VIBRATION: found[:, ::2]}, {VIBRATION: latent})

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self.settle()
        self._band_signals[:-1] = self._band_signals[1:].copy()
        self._band_signals[-1] = self.bank.step(z[:, None])[:, 0]
        targets = self.weights @ self._band_signals
        samples = self.windows.push(z, u).reshape(len(z), -1)
        self._mean[...] = self.regression.predict(samples, targets)
        self._pending = True

    def settle(self) -> None:
        """Learn from the last frame. Raises ConditionError where the precision is not enough."""
        if self._pending:
            self._pending = False
            self.regression.update()

    def reset(self) -> None:
        """Set the state back to the start."""
        for part in (self.windows, self.bank, self.regression):
            part.reset()
        self._mean[...], self._band_signals[...], self._pending = np.nan, 0.0, False

    def save(self) -> Saved:
        """Return a copy of the state."""
        self.settle()
        return super().save()

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        super().load(state)
        self._pending = False

    def take_over(self, old: Any) -> None:
        """Go on from a design with the same windows, training set, kernel and horizon. Raises StepError."""
        if old._size != self._size or not np.array_equal(old.weights, self.weights) or old.bank.x.shape != self.bank.x.shape:
            raise StepError("the designs have other windows, training sets, kernels or horizons: one of them has to learn anew")
        self.load(old.save())


def gpr_online(prior: Prior, settings: OnlineGpr, sampling: Sampling, horizon: float) -> OnlineEstimator:
    """Return the online GPR, which learns the vibration `horizon` frames ahead."""
    return OnlineEstimator(prior, settings, sampling, np.eye(whole_frames(horizon, "gpr-online") + 1)[-1])


def standardised_parts(settings: Gpr) -> tuple[Part, ...]:
    """Standardised inputs are divided by the deviations of a training record."""
    return (Training,) if settings.inputs_filter == "standardised" else ()


def online_seconds(settings: OnlineGpr, n_steps: int, n_modes: int, _dt: float) -> float:
    """One mode [s]: 10 us + 400 us / m + 0.065 ns m^2 for every step with a full training set."""
    m = settings.training_size
    return turns(n_modes) * max(n_steps - settings.depth - m + 1, 0) * (10e-6 + 400e-6 / m + 65e-12 * m**2)


GPR_ONLINE = Observer(
    "gpr-online",
    "Online GPR",
    (VIBRATION,),
    help="Gaussian process regression retrained at every step on the last windows",
    prior=(OnlineBands,),
    settings=Section("gpr_online", "Online GPR", OnlineGpr),
    asks=standardised_parts,
    # Its targets are what the causal band-passes make of turbulence, too.
    tunable=Tunable(
        ("gpr_online.noise_std", "gpr_online.depth", "butterworth.bandwidth_online"),
        ("gpr_online.length_scale", *tunable("gpr_online"), "butterworth.order"),
    ),
    weight=200.0,
    seconds=online_seconds,
    look=Look("Online GPR", "#046D72", "#5B8A77", (10, 2, 2, 2)),
    step=gpr_online,
)


ROWS = 256
"""Steps predicted at a time."""

HELD = 16
"""Steps over which a standard deviation is held, a divisor of ROWS; windows change little in them."""


@dataclass(frozen=True)
class TrainedGpr:
    """A trained GPR: the signals (d + m - 1, channels) [l] of its m windows, the windows as points, their weights (m,), and c.

    factor, b, pivot : for the variance, L (m, m), b (m,) and 1 / s2 + delta.b
    """

    signals: Array
    depth: int
    points: Points
    weights: Array
    constant: float
    kernel: SquaredExponential
    factor: Array
    b: Array
    pivot: float

    def predict(self, signals: Array, watch: Watch = QUIET, sd: Array | None = None) -> Array:
        """Mean at every step of signals (n, channels), (n,); NaN before the first full window.

        sd : (n,), receives the standard deviations where it is given
        """
        n, m, d = signals.shape[0], self.weights.size, self.depth
        out = np.full(n, np.nan)
        signals = signals / self.kernel.length_scale
        tests = self.kernel.points(squared_norms(signals, d))
        since, held = d - 1, []  # windows whose standard deviation is still to come
        for start in range(d - 1, n, ROWS):
            watch.step(start / n)
            rows = min(ROWS, n - start)
            # products[r, c] of test window start + r and training window c + r - rows + 1
            products = sliding_products(signals, self.signals, d, start, d - rows, rows, m + rows - 1)
            row, item = products.strides
            G = as_strided(products[:, rows - 1 :], (rows, m), (row - item, item))
            end = start + rows
            here = tests.select(lambda p, start=start, end=end: p[start:end])
            if sd is not None:
                held.append(G[::HELD].copy())
                if len(held) == HELD or end == n:  # many at a time, for the whole factor is read each time
                    windows = tests.select(lambda p, since=since, end=end: p[since:end:HELD])
                    sd[since:end] = np.repeat(self._sd(np.concatenate(held), windows), HELD)[: end - since]
                    since, held = end, []
            known = self.kernel.split_times(G, here, self.points, self.weights)
            out[start:end] = known + here.delta * self.constant
        return out

    def _sd(self, G: Array, tests: Points) -> Array:
        """Return the standard deviations (n,) of windows with these inner products G (n, m) [l^2]; uses up G."""
        self.kernel.split(G, tests.select(lambda p: p[:, None]), self.points)
        border = tests.delta - G @ self.b
        whitened = solve_lower(self.factor, G.T)
        variance = self.kernel.own(tests) - np.sum(whitened**2, axis=0) + border**2 / self.pivot
        return np.sqrt(np.maximum(variance, 0.0))

    def predict_one(self, window: Array) -> float:
        """Mean for one window, (channels, depth), the oldest sample first."""
        window = window / self.kernel.length_scale
        G = sum(np.correlate(known, x, "valid") for known, x in zip(self.signals.T, window, strict=True))
        here = self.kernel.points(np.array([np.sum(np.square(window))]))
        known = self.kernel.split_times(np.asarray(G)[None], here, self.points, self.weights)
        return float(known[0] + here.delta[0] * self.constant)


def eliminated_covariance(
    signals: Array, targets: Array, depth: int, first: int, m: int, kernel: SquaredExponential, watch: Watch = QUIET
) -> tuple[Array, Points]:
    """Return the covariance of the m windows that end at first ... first + m - 1, and the windows as points.

    The targets and delta are two more rows; the first m columns are eliminated. Raises ConditionError where the precision is not
    enough, Cancelled.
    """
    V, points = band(signals, depth, kernel, first, m, m - 1)
    watch.check()
    S = np.zeros((m + 2, m + 2), order="F")
    S[:m, :m] = square_from_band(V, 0, m)
    S[m:, :m] = targets[first : first + m], points.delta
    check_condition(S[:m, :m], kernel)
    eliminate(S, m, watch.check)
    return S, points


def check_length(signals: Array, depth: int, m: int, ahead: int) -> None:
    """Raise RecordError for signals (n, channels) that are too short for m windows and targets so many steps ahead."""
    if len(signals) < (needed := depth + m + ahead):
        more = f" + {ahead}" if ahead else ""
        raise RecordError(f"the training data has {len(signals)} steps, depth + training size{more} need {needed}")


def train(
    signals: Array, targets: Array, depth: int, m: int, kernel: SquaredExponential, watch: Watch = QUIET, ahead: int = 0
) -> TrainedGpr:
    """Fit the first m windows of signals (n, channels) to targets (n,), one per step; ahead : steps from it to what they are.

    Raises RecordError where the record is too short, ConditionError where the precision is not enough.
    """
    check_length(signals, depth, m, ahead)
    first = depth - 1
    S, points = eliminated_covariance(signals, targets, depth, first, m, kernel, watch)
    a, b = solve_rows(S, m)
    pivot = float(1.0 / kernel.variance + points.delta @ b)
    constant = float(points.delta @ a) / pivot
    known = signals[: first + m] / kernel.length_scale
    return TrainedGpr(known, depth, points, a - b * constant, constant, kernel, S[:m, :m], b, pivot)


class OfflineGpr(Gpr):
    """Offline GPR: trained once, on a record of its own."""


OFFLINE = Section("gpr_offline", "Offline GPR", OfflineGpr)


def training_targets(
    training: Training, bands: Bands, dt: float, delay: int = DELAY, weights: Sequence[float] | Array = (1.0,)
) -> Array:
    """Return the vibration reference of every step of the training record, (n, n_modes) [um].

    weights : of the vibration at the step, one step ahead and so on. NaN at the last step, and where it lies beyond the record
    """
    twin = training.open_loop_y
    at = open_loop_reference(bands, pseudo_open_loop(training.y_lgs, training.u, delay) if twin is None else twin, dt)
    longer = np.vstack([at, np.full((len(weights) - 1, at.shape[1]), np.nan)])
    return np.sum([w * longer[k : k + len(at)] for k, w in enumerate(weights) if w], axis=0)


def training_pairs(prior: Prior, windows: Windows, sampling: Sampling, weights: Array) -> Iterator[tuple[Array, Array]]:
    """Yield the channels (n, channels) of windows of the training record and their targets (n,), mode by mode.

    weights : as in `training_targets`. Raises RecordError.
    """
    training, bands = prior.training, prior.bands
    if training is None:
        raise RecordError("the record has no training data")
    assert bands is not None
    targets = training_targets(training, bands, sampling.dt, sampling.delay, weights)
    for mode in range(sampling.n_modes):
        yield windows.channels(training, mode), targets[:, mode]


def gpr_offline(prior: Prior, settings: OfflineGpr, sampling: Sampling, horizon: float) -> OfflineEstimator:
    """Return the GPR of all modes, trained for `horizon` frames ahead."""
    ahead = whole_frames(horizon, "gpr-offline")
    return trained_estimator(prior, settings, sampling, np.eye(ahead + 1)[-1], ahead)


def trained_estimator(prior: Prior, g: OfflineGpr, sampling: Sampling, weights: Array, horizon: float | None) -> OfflineEstimator:
    """Return the GPR of all modes for this horizon; weights : as in `training_targets`."""
    windows, m, kernel = Windows(g, sampling, g.depth, prior.training), g.training_size, kernel_of(g)
    pairs = training_pairs(prior, windows, sampling, weights)
    return OfflineEstimator(windows, [train(*pair, g.depth, m, kernel, ahead=len(weights) - 1) for pair in pairs], horizon)


class WindowEstimate(HeldEstimate):
    """An estimate from windows, for one horizon."""

    windows: Windows
    needs_command: bool

    state_names: tuple[str, ...] = ("windows", "_mean")

    def __init__(self, windows: Windows, n_modes: int, horizon: float | None):
        super().__init__(n_modes, horizon)
        self.windows, self.needs_command = windows, windows.needs_command
        self.mark_start()

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self.windows.push(z, u)
        if self.windows.is_full:
            self._estimate(self.windows.window)

    @abstractmethod
    def _estimate(self, window: Array) -> None:
        """Estimate from a window of all modes, (n_modes * channels, depth)."""


class OfflineEstimator(WindowEstimate):
    """Trained GPR of all modes, for one horizon."""

    models: tuple[TrainedGpr, ...]

    def __init__(self, windows: Windows, models: Sequence[TrainedGpr], horizon: float | None):
        super().__init__(windows, len(models), horizon)
        self.models = tuple(models)

    def run(self, measurements: Measurements, watch: Watch, *, with_sd: bool = True) -> Estimates:
        """Predict over a record, all modes at the same time. Raises RecordError for one that is shorter than a window."""
        n_steps = measurements.n_steps
        if n_steps < self.windows.depth:
            raise RecordError(f"the record has {n_steps} steps; depth needs {self.windows.depth}")

        def one(mode: int, watch: Watch) -> Array:
            sd = np.full(n_steps, np.nan)
            signals = self.windows.channels(measurements, mode)
            return np.column_stack([self.models[mode].predict(signals, watch, sd if with_sd else None), sd])

        found = over_modes(measurements.n_modes, one, watch)
        return Estimates({VIBRATION: found[:, ::2]}, {VIBRATION: found[:, 1::2]})

    def _estimate(self, window: Array) -> None:
        parts = np.split(window, len(self.models))
        self._mean[...] = [model.predict_one(x) for model, x in zip(self.models, parts, strict=True)]

    def take_over(self, old: Any) -> None:
        """Go on with the samples of another design."""
        self.windows.take_over(old.windows)
        self._mean[...] = old._mean


def offline_seconds(settings: OfflineGpr, n_steps: int, n_modes: int, _dt: float) -> float:
    """One mode [s]: training 4 ns m^2 + 10 ps m^3, prediction 1.2 us + 4.2 ns m per step."""
    m = settings.training_size
    return turns(n_modes) * (4e-9 * m**2 + 10e-12 * m**3 + max(n_steps - settings.depth + 1, 0) * (1.2e-6 + 4.2e-9 * m))


GPR_OFFLINE = Observer(
    "gpr-offline",
    "Offline GPR",
    (VIBRATION,),
    help="Gaussian process regression trained on another record",
    prior=(Training, OfflineBands),
    settings=OFFLINE,
    needs=("training",),
    # The mean depends on sigma_n / sigma_SE and l only: sigma_SE stays.
    tunable=Tunable(
        ("gpr_offline.length_scale", "gpr_offline.noise_std", "gpr_offline.depth"),
        (*tunable("gpr_offline"), "butterworth.bandwidth_offline", "butterworth.order"),
    ),
    weight=20.0,
    seconds=offline_seconds,
    look=Look("Offline GPR", "#183B2C", "#37C9B2", (12, 2, 2, 2, 2, 2)),
    step=gpr_offline,
)


TAPS = 30
"""Samples of z that the plain predictor sees."""

PLAIN = 1e-6
"""Its penalty, over the mean square of z: enough for a solution to exist."""


def fit(signals: Array, targets: Array, depth: int, m: int, penalty: float, ahead: int = 0) -> tuple[Array, float]:
    """Fit weights (depth, channels), the newest sample first, and a constant to the first m windows of signals (n, channels).

    targets (n,), one per step; ahead : as in `train`. Raises RecordError where the record is too short.
    """
    check_length(signals, depth, m, ahead)
    f = targets[depth - 1 : depth - 1 + m]
    windows = sliding_window_view(signals[: depth - 1 + m], depth, axis=0)  # (m, channels, depth), the oldest sample first
    middle = windows.mean(axis=0)
    if m <= 2 * depth * signals.shape[1]:  # which of the two is cheaper
        S = np.empty((m + 1, m + 1), order="F")  # the inner products with the targets as one more row
        products = sliding_products(signals, signals, depth, depth - 1, depth - 1, m, m, triangle=True)
        lower = np.tril(square_from_band(products, 0, m))
        gram = lower + np.tril(lower, -1).T  # X X', at a cost that depth does not enter
        mean = gram.mean(axis=0)
        S[:m, :m] = gram - mean - mean[:, None] + mean.mean()  # of the windows less their mean
        S.flat[: m * (m + 1) : m + 2] += penalty
        S[m, :m] = f - f.mean()
        eliminate(S, m, QUIET.check)
        (a,) = solve_rows(S, m)
        a = a - a.mean()  # on windows less their mean
        w = np.array([np.correlate(channel, a, "valid") for channel in signals[: depth - 1 + m].T])
    else:
        X = (windows - middle).reshape(m, -1)
        w = solve(X.T @ X + penalty * np.eye(X.shape[1]), X.T @ (f - f.mean()), assume_a="pos").reshape(middle.shape)
    return w.T[::-1], float(f.mean() - np.sum(middle * w))


def predict(signals: Array, weights: Array, constant: float) -> Array:
    """Return the linear prediction at every step of signals (n, channels), (n,); NaN before the first full window."""
    n, depth = signals.shape[0], weights.shape[0]
    out = np.full(n, np.nan)
    if n >= depth:
        channels = zip(signals.T, weights.T, strict=True)
        out[depth - 1 :] = sum(np.convolve(s, w, "valid") for s, w in channels) + constant  # by FFT would mix in later samples
    return out


class LinearPredictor(WindowEstimate):
    """A linear predictor of all modes. One of the vibration h frames ahead is trained for that h, so it has no other horizon.

    Parameters
    ----------
    windows : Windows
        What it looks at.
    fits : sequence of tuple
        Weights (depth, channels), the newest sample first, and constant, one per mode.
    horizon : float
        Frames ahead that it was trained for.
    """

    fits: Sequence[tuple[Array, float]]

    def __init__(self, windows: Windows, fits: Sequence[tuple[Array, float]], horizon: float):
        super().__init__(windows, len(fits), horizon)
        self.fits, channels = fits, fits[0][0].shape[1]
        self._weights = np.concatenate([weights[::-1].T for weights, _ in fits])  # as the window: (n_modes * channels, depth)
        self._starts = np.arange(0, len(self._weights), channels)
        self._constants = np.array([constant for _, constant in fits])

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Run over a record, all steps at once."""
        columns = []
        for mode, fitted in enumerate(self.fits):
            watch.step(mode / len(self.fits))
            columns.append(predict(self.windows.channels(measurements, mode), *fitted))
        return Estimates({VIBRATION: np.column_stack(columns)})

    def _estimate(self, window: Array) -> None:
        np.add.reduceat(np.einsum("ij,ij->i", self._weights, window), self._starts, out=self._mean)
        self._mean += self._constants

    def take_over(self, old: Any) -> None:
        """Go on with the samples of another design."""
        self.windows.take_over(old.windows)
        if self.windows.is_full:
            self._estimate(self.windows.window)


def ridge(prior: Prior, settings: OfflineGpr, sampling: Sampling, horizon: float) -> LinearPredictor:
    """Return the linear limit of the offline GPR: its windows, its training size, its penalty."""
    g, ahead = settings, whole_frames(horizon, "ridge")
    windows, penalty = Windows(g, sampling, g.depth, prior.training), (g.noise_std * g.length_scale / g.signal_std) ** 2
    pairs = training_pairs(prior, windows, sampling, np.eye(ahead + 1)[-1])
    return LinearPredictor(windows, [fit(*pair, g.depth, g.training_size, penalty, ahead) for pair in pairs], ahead)


def ridge_30(prior: Prior, _settings: None, sampling: Sampling, horizon: float) -> LinearPredictor:
    """Return plain least squares on the last 30 measurements z, over all of the training record."""
    ahead, windows, fits = whole_frames(horizon, "ridge-30"), Windows(None, sampling, TAPS), []
    for z, targets in training_pairs(prior, windows, sampling, np.eye(ahead + 1)[-1]):
        m = len(z) - TAPS - ahead  # the last targets have no reference
        fits.append(fit(z, targets, TAPS, m, PLAIN * m * float(np.mean(z**2)), ahead))
    return LinearPredictor(windows, fits, ahead)


RIDGE = Observer(
    "ridge",
    "Ridge",
    (VIBRATION,),
    help="linear limit of the offline GPR: what its kernel becomes for a long length scale",
    prior=(Training, OfflineBands),
    settings=OFFLINE,
    needs=("training",),
    linear=True,
    weight=10.0,
    # The penalty (sigma_n l / sigma_SE)^2 is one number.
    tunable=Tunable(
        ("gpr_offline.noise_std", "gpr_offline.depth"),
        ("gpr_offline.length_scale", *tunable("gpr_offline"), "butterworth.bandwidth_offline", "butterworth.order"),
    ),
    look=Look("Ridge", "#757E9A", "#9A97BE", (4, 2)),
    step=ridge,
)

RIDGE_30 = Observer(
    "ridge-30",
    "30-tap predictor",
    (VIBRATION,),
    help="least squares on the last 30 measurements: the plain baseline",
    prior=(Training, OfflineBands),
    needs=("training",),
    linear=True,
    tunable=Tunable(("butterworth.bandwidth_offline",), ("butterworth.order",)),
    look=Look("30-tap predictor", "#3E4E6C", "#C8A299", (2, 3)),
    step=ridge_30,
)
