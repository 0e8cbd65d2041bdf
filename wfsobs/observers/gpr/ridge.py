"""Ridge regression of the vibration on windows: what a GPR has to beat, trained as the offline one.

With windows as rows of X, targets f and both centred, the weights are w = X' (X X' + lambda I)^-1 f. A squared-exponential
kernel whose length scale l is far above the norm of the windows is linear, k = s2 (1 - |x - x'|^2 / 2 l^2), and the GPR then is
this with lambda = (sigma_n l / sigma_SE)^2 and a free constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import solve

from wfsobs.observers.base import VIBRATION, Look, Observer, Tunable
from wfsobs.observers.gpr.offline import OFFLINE, OfflineGpr, WindowEstimate, check_length, training_pairs
from wfsobs.observers.gpr.windows import Windows, sliding_products, square_from_band, tunable
from wfsobs.observers.step import whole_frames
from wfsobs.prior import OfflineBands, Prior
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Estimates, Measurements, Sampling, Training
from wfsobs.signal.linalg import eliminate, solve_rows
from wfsobs.typing import Array

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
