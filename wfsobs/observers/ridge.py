"""Linear predictors of the vibration, trained once like the offline GPR: what a GPR has to beat.

With windows as rows of X, targets f and both centred, the weights are w = X' (X X' + lambda I)^-1 f. A squared-exponential
kernel whose length scale l is far above the norm of the windows is linear, k = s2 (1 - |x - x'|^2 / 2 l^2), and the GPR
then is this with lambda = (sigma_n l / sigma_SE)^2 and a free constant.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import solve

from wfsobs.arrays import Array
from wfsobs.observers.base import VIBRATION
from wfsobs.observers.gpr_offline import training_targets
from wfsobs.observers.inputs import scale_of, window_signals
from wfsobs.record import Record, RecordError, pseudo_open_loop
from wfsobs.scenario import Scenario
from wfsobs.watch import Watch

TAPS = 30
"""Samples of z that the plain predictor sees."""

PLAIN = 1e-6
"""Its penalty, over the mean square of z: enough for a solution to exist."""


def fit(signals: Array, targets: Array, depth: int, m: int, penalty: float) -> tuple[Array, float]:
    """Weights (depth, channels), the newest sample first, and constant, of the first m windows of signals (n, channels)
    with targets (n,), one per step. Raises RecordError where the record is too short."""
    if signals.shape[0] < depth + m:
        raise RecordError(f"the training record has {signals.shape[0]} steps, depth + training size need {depth + m}")
    X = sliding_window_view(signals, depth, axis=0)[:m].reshape(m, -1)  # channel by channel, the oldest sample first
    f = targets[depth - 1 : depth - 1 + m]
    middle = X.mean(axis=0)
    X, centred = X - middle, f - f.mean()
    if m < X.shape[1]:
        w = X.T @ solve(X @ X.T + penalty * np.eye(m), centred, assume_a="pos")
    else:
        w = solve(X.T @ X + penalty * np.eye(X.shape[1]), X.T @ centred, assume_a="pos")
    return w.reshape(signals.shape[1], depth).T[::-1], float(f.mean() - middle @ w)


def predict(signals: Array, weights: Array, constant: float) -> Array:
    """The linear prediction at every step of signals (n, channels), (n,); NaN before the first full window."""
    n, depth = signals.shape[0], weights.shape[0]
    out = np.full(n, np.nan)
    if n >= depth:
        channels = zip(signals.T, weights.T, strict=True)
        out[depth - 1 :] = sum(np.convolve(s, w, "valid") for s, w in channels) + constant  # by FFT would mix in later samples
    return out


def ridge(record: Record, scenario: Scenario, watch: Watch) -> dict[str, Array]:
    """The linear limit of the offline GPR: its windows, its training size, its penalty."""
    g, training = scenario.gpr_offline, record.training
    assert training is not None
    targets = training_targets(training, scenario, record.dt, record.delay)
    training_z = pseudo_open_loop(training.y_lgs, training.u, record.delay)
    penalty = (g.noise_std * g.length_scale / g.signal_std) ** 2
    columns = []
    for mode in range(record.n_modes):
        watch.step(mode / record.n_modes)
        scale = scale_of(g, training, record.delay, mode)
        known = window_signals(g, training.y_lgs, training.u, training_z, mode, record.dt, scale)
        fitted = fit(known, targets[:, mode], g.depth, g.training_size, penalty)
        columns.append(predict(window_signals(g, record.y_lgs, record.u, record.z, mode, record.dt, scale), *fitted))
    return {VIBRATION: np.column_stack(columns)}


def ridge_30(record: Record, scenario: Scenario, watch: Watch) -> dict[str, Array]:
    """Plain least squares on the last 30 measurements z, over all of the training record."""
    training = record.training
    assert training is not None
    targets = training_targets(training, scenario, record.dt, record.delay)
    training_z = pseudo_open_loop(training.y_lgs, training.u, record.delay)
    m = training_z.shape[0] - TAPS  # the last target has no reference
    columns = []
    for mode in range(record.n_modes):
        watch.step(mode / record.n_modes)
        z = training_z[:, [mode]]
        penalty = PLAIN * m * float(np.mean(z**2))
        columns.append(predict(record.z[:, [mode]], *fit(z, targets[:, mode], TAPS, m, penalty)))
    return {VIBRATION: np.column_stack(columns)}
