"""Offline GPR of the vibration: trained once, on a record of its own (paper, Algorithms 1 and 2).

The target of a window is the zero-phase Butterworth reference of the training record's open-loop twin at the window's last
step; without a twin, that of its z. `ridge` learns the same.

With w = a - b c and c = (delta.a) / (1 / s2 + delta.b) (`windows` has a, b, delta), a prediction is

    mean = kappa.w + delta_t c,
    variance = M_tt - |L^-1 kappa|^2 + (delta_t - kappa.b)^2 / (1 / s2 + delta.b),    L L' = M + sigma_n^2 I.

The variance, that of the vibration without the noise of a target, costs m^2 operations where the mean costs m: it is computed
once in so many steps and held.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided

from wfsobs.observers.base import VIBRATION, Look, Observer, Tunable
from wfsobs.observers.baselines import open_loop_reference
from wfsobs.observers.gpr.windows import (
    Gpr,
    Points,
    SquaredExponential,
    Windows,
    band,
    check_condition,
    kernel_of,
    over_modes,
    sliding_products,
    square_from_band,
    squared_norms,
    tunable,
    turns,
)
from wfsobs.observers.step import HeldEstimate, whole_frames
from wfsobs.prior import Bands, OfflineBands, Prior
from wfsobs.progress import QUIET, Watch
from wfsobs.record import DELAY, Estimates, Measurements, RecordError, Sampling, Training, pseudo_open_loop
from wfsobs.settings import Section
from wfsobs.signal.linalg import eliminate, solve_lower, solve_rows
from wfsobs.typing import Array

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
