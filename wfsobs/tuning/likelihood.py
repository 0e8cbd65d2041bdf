"""Log marginal likelihood of a GPR's training targets: what Gaussian processes are usually tuned by, here as information.

    log p(f) = -1/2 f' C^-1 f - 1/2 log det C - m/2 log 2 pi,    C = K + sigma_n^2 I

With M of `observers.kernels`, C = (M + sigma_n^2 I) + s2 delta delta', a rank-one border: with a = f' N f, b = f' N delta,
c = delta' N delta, N = (M + sigma_n^2 I)^-1,

    f' C^-1 f = a - b^2 / (1 / s2 + c),    log det C = log det (M + sigma_n^2 I) + log(1 + s2 c).
"""

from __future__ import annotations

import numpy as np

from wfsobs.observers.gpr.inputs import scale_of, window_signals
from wfsobs.observers.gpr.kernels import SquaredExponential, band, check_condition, square_from_band
from wfsobs.observers.gpr.offline import training_targets
from wfsobs.observers.gpr.online import kernel_of, online_targets
from wfsobs.observers.missing import fill_missing
from wfsobs.prior import Bands
from wfsobs.priors_from.scenario import bands_of, prior_of
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError, pseudo_open_loop
from wfsobs.scenario import Scenario
from wfsobs.signal.linalg import eliminate
from wfsobs.typing import Array

GPRS = ("gpr-offline", "gpr-online")


def log_marginal_likelihood(
    signals: Array, targets: Array, depth: int, first: int, m: int, kernel: SquaredExponential, watch: Watch = QUIET
) -> float:
    """Of the targets (n,) [um] of the m windows of signals (n, channels) that end at first ... first + m - 1.

    Raises ConditionError where the precision is not enough, Cancelled.
    """
    V, points = band(signals, depth, kernel, first, m, m - 1)
    S = np.zeros((m + 2, m + 2), order="F")  # the covariance with the targets and delta as two more rows
    S[:m, :m] = square_from_band(V, 0, m)
    S[m:, :m] = targets[first : first + m], points.delta
    check_condition(S[:m, :m], kernel)
    eliminate(S, m, watch.check)
    a, b, c = -S[m, m], -S[m + 1, m], -S[m + 1, m + 1]
    quadratic = a - b**2 / (1.0 / kernel.variance + c)
    log_determinant = 2.0 * np.log(np.diagonal(S)[:m]).sum() + np.log1p(kernel.variance * c)
    return float(-0.5 * (quadratic + log_determinant + m * np.log(2.0 * np.pi)))


def likelihood(observer: str, record: Record, scenario: Scenario, watch: Watch = QUIET) -> tuple[float, ...] | None:
    """One number per mode, of a GPR on a record: the offline one's training set, or the last one of the online GPR.

    None for what is no GPR, and where the record or the numbers do not suffice.
    """
    if observer not in GPRS:
        return None
    try:
        whole = fill_missing(record, prior_of(scenario, record, (Bands,)))
        return tuple(_of_mode(observer, whole, scenario, mode, watch) for mode in range(record.n_modes))
    except ValueError:
        return None


def _of_mode(observer: str, record: Record, scenario: Scenario, mode: int, watch: Watch) -> float:
    g = scenario.gpr_offline if observer == "gpr-offline" else scenario.gpr_online
    bands, scale = bands_of(scenario), scale_of(g, record.training, record.delay, mode)
    if observer == "gpr-offline":
        training = record.training
        assert training is not None
        targets, first = training_targets(training, bands, record.dt, record.delay), g.depth - 1
        y, u, z = training.y_lgs, training.u, pseudo_open_loop(training.y_lgs, training.u, record.delay)
    else:
        targets, first = online_targets(record, bands), record.n_steps - 1 - g.training_size
        y, u, z = record.y_lgs, record.u, record.z
    if first < g.depth - 1 or first + g.training_size > targets.shape[0]:
        raise RecordError("the record is too short for the training set")
    signals = window_signals(g, y, u, z, mode, record.dt, scale)
    return log_marginal_likelihood(signals, targets[:, mode], g.depth, first, g.training_size, kernel_of(g), watch)
