"""Steady-state Kalman filters on LGS or NGS measurements (paper, section 2.2).

    x_pred[k+1] = A x_hat[k],    x_hat[k] = x_pred[k] + L (z[k] - C x_pred[k])

with the filter gain L = P C' (C P C' + R)^-1; the paper's eq. 9 is the predictor form with K = A L, which uses
y up to k - 1. Here phi_hat[k] uses y[k] too, like the GPR. The mirror's part is known and taken off before.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.observers.base import TARGETS, TURBULENCE, Look, Observer, Tunable
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.kalman.frame_step import FrameEstimator
from wfsobs.observers.kalman.mode_filter import ModeFilter, lgs_mean
from wfsobs.observers.kalman.spread import FrameErrors, by_target
from wfsobs.observers.kalman.step import KalmanEstimator
from wfsobs.observers.kalman.with_gaps import run_frames
from wfsobs.prior import LgsModel, LgsStars, Model, NgsModel, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.signal.riccati import SteadyState, steady_state
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.stepping import Gain, GainCycle
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.settings.priors import Kalman

NGS = ("y_ngs", "ratio")
"""Fields that a record with NGS frames has."""

MODEL = ("kalman.frequency", "kalman.damping", "kalman.turbulence_rms", "kalman.vibration_rms")
"""Settings of the model with one peak."""

MIN_NOISE = 1e-6
"""Floor of a modelled measurement noise [um]: a filter for perfect measurements has no Riccati solution."""


def steady_gains(model: DisturbanceModel, noise: float) -> tuple[GainCycle, SteadyState]:
    """Return the gains of the steady-state filter of z (1 input), and its covariances; noise [um]."""
    steady = steady_state(model.A, model.C, model.Q, np.array(noise**2))
    return GainCycle([Gain(model.A, np.atleast_2d(model.C), steady.L)]), steady


def steady_filter(model: DisturbanceModel, noise: float, outputs: Array | None = None) -> tuple[PeriodicFilter, SteadyState]:
    """Return the steady-state filter of z (1 input), and its covariances; noise [um].

    outputs : rows of the state x_hat[k] to return, (p, n); every target by default
    """
    gains, steady = steady_gains(model, noise)
    return gains.filter(model.output_rows(TARGETS) if outputs is None else outputs), steady


def kf_lgs(measurements: Measurements, prior: Prior, _settings: None, watch: Watch) -> Estimates:
    """Run the Kalman filter on the LGS measurement, at every fast step."""
    return run_steady(measurements, _lgs_filters(prior), watch)


def _lgs_filters(prior: Prior) -> list[ModeFilter]:
    found = enumerate(prior.model)
    return [steady_mode(one.disturbance(), one.lgs_noise)._replace(mean=lgs_mean(prior, mode)) for mode, one in found]


def run_steady(measurements: Measurements, modes: Sequence[ModeFilter], watch: Watch) -> Estimates:
    """Run the filters of all modes on z."""
    z, columns, sd = measurements.z, [], []
    if np.isnan(z).any() or measurements.lgs_stars is not None:
        return run_frames(KalmanEstimator(modes), measurements, watch)
    for mode, one in enumerate(modes):
        watch.step(mode / measurements.n_modes)
        rows = one.rows(TARGETS)
        columns.append(one.gains.filter(rows).run(z[:, None, mode, None])[:, :, 0])
        sd.append(one.steady_sd())
    return by_target(columns, sd)


def step_kf_lgs(prior: Prior, _settings: None, _sampling: Sampling, _horizon: float) -> KalmanEstimator:
    """Return the filters of all modes, one frame at a time."""
    return KalmanEstimator(_lgs_filters(prior))


def steady_mode(model: DisturbanceModel, noise: float) -> ModeFilter:
    """Return the steady-state filter of a mode; noise [um]."""
    return seen_mode(model, model, noise)


def seen_mode(model: DisturbanceModel, full: DisturbanceModel, noise: float) -> ModeFilter:
    """Return the steady-state filter of a mode with more states behind those of its disturbance; noise [um]."""
    gains, steady = steady_gains(full, noise)
    step = full.A, np.atleast_2d(full.C), full.Q, np.array([[noise**2]])
    return ModeFilter(model, gains, (steady.posterior,), (step,))


def kf_ngs(measurements: Measurements, prior: Prior, settings: Kalman, watch: Watch) -> Estimates:
    """Run the Kalman filter on NGS frames, with the coefficients for T_NGS.

    A frame at k = n i measures slow step i - 1 (fast steps k - n ... k - 1); the estimate is that of slow
    step i, the fast steps k ... k + n - 1. It is held over them, or propagated by the fast model.
    """
    n = measurements.ratio
    assert n is not None
    frames, estimator = measurements.z_ngs[n::n], step_kf_ngs(prior, settings, measurements.sampling, 0.0)
    if np.isnan(frames).any():
        return run_frames(estimator, measurements, watch)
    columns, sd = [], []
    for mode, (model, one) in enumerate(zip(prior.model, estimator.modes, strict=True)):
        watch.step(mode / measurements.n_modes)
        pairs, spreads = one.model.pairs, np.empty((n, len(TARGETS)))
        slow = one.gains.filter(pairs).run(frames[:, None, mode, None])[:, :, 0]  # of each process, slow steps i and i - 1
        fast = np.full((measurements.n_steps, len(TARGETS)), np.nan)
        for target, process in enumerate((model.turbulence, model.vibration)):
            spread = between_frames(process, n, settings.ngs_between_frames)
            pair = slice(2 * target, 2 * target + 2)
            values = slow[:, pair] @ spread.T
            fast[n:, target] = values.ravel()[: measurements.n_steps - n]
            now, errors = estimator.truths[mode].outputs[TARGETS[target]], estimator.errors[mode]
            spreads[:, target] = [errors.sd(now, weights @ pairs[pair], j) for j, weights in enumerate(spread)]
        columns.append(fast)
        sd.append(spreads)
    return by_target(columns, sd, first=n)


def step_kf_ngs(prior: Prior, settings: Kalman, sampling: Sampling, _horizon: float) -> FrameEstimator:
    """Return the filters of all modes, one frame at a time."""
    assert sampling.ratio is not None
    n, how = sampling.ratio, settings.ngs_between_frames
    modes = [steady_mode(one.at(n * sampling.dt).disturbance(), one.ngs_noise) for one in prior.model]

    spread = partial(_spread, prior.model, modes, n, how)
    truths = [model.disturbance() for model in prior.model]
    errors = [
        FrameErrors(truth, mode.gains.steps[0], n, model.ngs_noise)
        for truth, mode, model in zip(truths, modes, prior.model, strict=True)
    ]
    return FrameEstimator(modes, truths, errors, spread, holds=how == "hold")


def _spread(models: Sequence[Model], modes: Sequence[ModeFilter], n: int, how: str, mode: int, target: str, since: int) -> Array:
    """Return the row of the slow filter's state that gives a target, some fast steps since the frame."""
    model, at = models[mode], TARGETS.index(target)
    weights = between_frames((model.turbulence, model.vibration)[at], n, how, max(since + 1, n))[since]
    return weights @ modes[mode].model.pairs[2 * at : 2 * at + 2]


def between_frames(process: Ar2, n: int, how: str, steps: int | None = None) -> Array:
    """Weights (steps, 2) of the slow estimates i and i - 1, both given frame i, in those of the fast steps from n i on.

    hold: (1, 0). propagate: the conditional mean of phi[n i + j] given the two slow means under the fast
    model, Cov(phi, s) Cov(s)^-1. steps : the n of slow step i unless given.
    """
    steps = n if steps is None else steps
    if how == "hold" or process.rms == 0:
        return np.column_stack([np.ones(steps), np.zeros(steps)])
    r = process.autocovariance(n + steps)
    lag = np.abs(np.subtract.outer(np.arange(n + steps), np.arange(2 * n)))
    covariance = r[lag]  # of fast steps n (i - 1) ... n i + steps - 1 with n (i - 1) ... n (i + 1) - 1
    means = np.kron(np.eye(2), np.full((1, n), 1.0 / n))[::-1]  # rows: slow step i, slow step i - 1
    cross, between = covariance[n:] @ means.T, means @ covariance[: 2 * n] @ means.T
    return np.linalg.lstsq(between, cross.T, rcond=1e-14)[0].T


def way_between(_prior: Prior, settings: Kalman) -> str:
    """Return what of the settings the filter of the NGS has beside its prior."""
    return settings.ngs_between_frames


KF_LGS = Observer(
    "kf-lgs",
    "LGS KF",
    TARGETS,
    kf_lgs,
    help="steady-state Kalman filter on the LGS, one vibration peak in its model",
    prior=(LgsModel, LgsStars),
    linear=True,
    takes_missing=True,
    # The gain depends on the ratios of turbulence, vibration and noise. Turbulence tuned for vibration would be no turbulence.
    tunable=Tunable((*MODEL[:2], "kalman.vibration_rms"), ("kalman.turbulence_rms", "kalman.lgs_noise")),
    look=Look("LGS KF", "#FF6600", "#FF8533"),
    step=step_kf_lgs,
)

KF_NGS = Observer(
    "kf-ngs",
    "NGS KF",
    (TURBULENCE,),
    kf_ngs,
    help="steady-state Kalman filter on the NGS, its frames held or spread between them",
    prior=(NgsModel,),
    settings="kalman",
    needs=NGS,
    linear=True,
    takes_missing=True,
    sensors=("ngs",),
    tunable=Tunable(("kalman.turbulence_rms", "kalman.vibration_rms"), (*MODEL[:2], "kalman.ngs_noise")),
    look=Look("NGS KF", "#003DE6", "#7AA2FF", (8, 2)),
    step=step_kf_ngs,
    counts=way_between,
)
