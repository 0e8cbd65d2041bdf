"""Linear predictors of the vibration, trained once like the offline GPR: what a GPR has to beat.

With windows as rows of X, targets f and both centred, the weights are w = X' (X X' + lambda I)^-1 f. A squared-exponential
kernel whose length scale l is far above the norm of the windows is linear, k = s2 (1 - |x - x'|^2 / 2 l^2), and the GPR
then is this with lambda = (sigma_n l / sigma_SE)^2 and a free constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import solve

from wfsobs.observers.base import VIBRATION, Look, Observer, Tunable
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.gpr.inputs import Windows, scales_of, training_signals, tunable
from wfsobs.observers.gpr.kernels import sliding_products, square_from_band
from wfsobs.observers.gpr.offline import OFFLINE, OfflineGpr, training_targets
from wfsobs.observers.step import HeldEstimate, whole_frames
from wfsobs.prior import OfflineBands, Prior
from wfsobs.record import Training
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Measurements, RecordError, Sampling, pseudo_open_loop
from wfsobs.signal.linalg import eliminate, solve_rows
from wfsobs.typing import Array

TAPS = 30
"""Samples of z that the plain predictor sees."""

PLAIN = 1e-6
"""Its penalty, over the mean square of z: enough for a solution to exist."""


def fit(signals: Array, targets: Array, depth: int, m: int, penalty: float) -> tuple[Array, float]:
    """Fit weights (depth, channels), the newest sample first, and a constant to the first m windows of signals (n, channels).

    targets (n,), one per step. Raises RecordError where the record is too short.
    """
    if signals.shape[0] < depth + m:
        raise RecordError(f"the training data has {signals.shape[0]} steps, depth + training size need {depth + m}")
    f = targets[depth - 1 : depth - 1 + m]
    windows = sliding_window_view(signals[: depth - 1 + m], depth, axis=0)  # (m, channels, depth), the oldest sample first
    middle = windows.mean(axis=0)
    if m <= 2 * depth * signals.shape[1]:  # which of the two is cheaper
        S = np.empty((m + 1, m + 1), order="F")  # the inner products with the targets as one more row
        S[:m, :m] = _centre(_inner_products(signals, depth, m))
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


def _inner_products(signals: Array, depth: int, m: int) -> Array:
    """X X' of the first m windows, (m, m), at a cost that depth does not enter."""
    band = sliding_products(signals, signals, depth, depth - 1, depth - 1, m, m, triangle=True)
    lower = np.tril(square_from_band(band, 0, m))
    return lower + np.tril(lower, -1).T


def _centre(gram: Array) -> Array:
    """Return the inner products of windows minus their mean."""
    mean = gram.mean(axis=0)
    return gram - mean - mean[:, None] + mean.mean()


def predict(signals: Array, weights: Array, constant: float) -> Array:
    """Return the linear prediction at every step of signals (n, channels), (n,); NaN before the first full window."""
    n, depth = signals.shape[0], weights.shape[0]
    out = np.full(n, np.nan)
    if n >= depth:
        channels = zip(signals.T, weights.T, strict=True)
        out[depth - 1 :] = sum(np.convolve(s, w, "valid") for s, w in channels) + constant  # by FFT would mix in later samples
    return out


class LinearPredictor(HeldEstimate):
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

    windows: Windows
    needs_command: bool
    fits: Sequence[tuple[Array, float]]

    state_names: tuple[str, ...] = ("windows", "_mean")

    def __init__(self, windows: Windows, fits: Sequence[tuple[Array, float]], horizon: float):
        super().__init__(len(fits), horizon)
        self.windows, self.needs_command, self.fits = windows, windows.needs_command, fits
        channels = fits[0][0].shape[1]
        self._weights = np.concatenate([weights[::-1].T for weights, _ in fits])  # as the window: (n_modes * channels, depth)
        self._starts = np.arange(0, len(self._weights), channels)
        self._constants = np.array([constant for _, constant in fits])
        self.mark_start()

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Run over a record, all steps at once."""
        columns = []
        for mode, fitted in enumerate(self.fits):
            watch.step(mode / len(self.fits))
            columns.append(predict(self.windows.channels(measurements, mode), *fitted))
        return Estimates({VIBRATION: np.column_stack(columns)})

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self.windows.push(z, u)
        self._estimate()

    def _estimate(self) -> None:
        if self.windows.is_full:
            parts = np.einsum("ij,ij->i", self._weights, self.windows.window)
            np.add.reduceat(parts, self._starts, out=self._mean)
            self._mean += self._constants

    def take_over(self, old: Any) -> None:
        """Go on with the samples of another design."""
        self.windows.take_over(old.windows)
        self._estimate()


def _targets(prior: Prior, mode: int, dt: float, delay: int, horizon: int) -> tuple[Training, Array]:
    """Return the training data, and the vibration of one mode `horizon` frames ahead."""
    training, bands = prior.training, prior.bands
    assert training is not None and bands is not None
    return training, training_targets(training, bands, dt, delay, np.eye(horizon + 1)[-1])[:, mode]


def fit_ridge(prior: Prior, g: OfflineGpr, mode: int, dt: float, delay: int, horizon: int = 0) -> tuple[Array, float]:
    """Fit the linear limit of the offline GPR of one mode to the vibration `horizon` frames ahead, as `fit`."""
    training, targets = _targets(prior, mode, dt, delay, horizon)
    signals = training_signals(g, training, mode, dt, delay)
    return fit(signals, targets, g.depth, g.training_size, (g.noise_std * g.length_scale / g.signal_std) ** 2)


def ridge(prior: Prior, settings: OfflineGpr, sampling: Sampling, horizon: float) -> LinearPredictor:
    """Return the linear limit of the offline GPR: its windows, its training size, its penalty."""
    g, ahead, modes = settings, whole_frames(horizon, "ridge"), range(sampling.n_modes)
    fits = [fit_ridge(prior, g, mode, sampling.dt, sampling.delay, ahead) for mode in modes]
    return LinearPredictor(Windows(g, sampling, g.depth, scales_of(g, prior.training, sampling)), fits, ahead)


def fit_30(prior: Prior, mode: int, dt: float, delay: int, horizon: int = 0) -> tuple[Array, float]:
    """Fit the last 30 measurements z of one mode to the vibration `horizon` frames ahead, as `fit`."""
    training, targets = _targets(prior, mode, dt, delay, horizon)
    z = pseudo_open_loop(training.y_lgs, training.u, delay)[:, [mode]]
    m = len(z) - TAPS - horizon  # the last targets have no reference
    return fit(z, targets, TAPS, m, PLAIN * m * float(np.mean(z**2)))


def ridge_30(prior: Prior, _settings: None, sampling: Sampling, horizon: float) -> LinearPredictor:
    """Return plain least squares on the last 30 measurements z, over all of the training record."""
    ahead = whole_frames(horizon, "ridge-30")
    fits = [fit_30(prior, mode, sampling.dt, sampling.delay, ahead) for mode in range(sampling.n_modes)]
    return LinearPredictor(Windows(None, sampling, TAPS), fits, ahead)


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
