"""Steady-state Kalman filters on LGS or NGS measurements (paper, section 2.2).

    x_pred[k+1] = A x_hat[k],    x_hat[k] = x_pred[k] + L (z[k] - C x_pred[k])

with the filter gain L = P C' (C P C' + R)^-1; the paper's eq. 9 is the predictor form with K = A L, which uses
y up to k - 1. Here phi_hat[k] uses y[k] too, like the GPR. The mirror's part is known and taken off before.

`kf-multi` is the same filter with one AR(2) per line of the vibration, which the paper expects to help (its conclusion), and, as
an option, turbulence of third order.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.observers.base import TARGETS, TURBULENCE, Look, Observer, Tunable
from wfsobs.observers.kalman.mode_filter import ModeFilter, lgs_mean
from wfsobs.observers.kalman.step import FrameErrors, FrameEstimator, kalman_filters
from wfsobs.observers.stepping import Gain, GainCycle
from wfsobs.prior import LgsModel, LgsStars, Lines, Model, NgsModel, Prior
from wfsobs.record import Sampling
from wfsobs.settings import Group, Real, Section, Whole
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.gains import ONE, SensorMean, SteadyState, steady_state
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.settings.priors import Kalman

NGS = ("y_ngs", "ratio")
"""Fields that a record with NGS frames has."""

MODEL = ("kalman.frequency", "kalman.damping", "kalman.turbulence_rms", "kalman.vibration_rms")
"""Settings of the model with one peak."""

TUNABLE_PEAKS = Tunable(("multipeak.line_width", "kalman.lgs_noise"), ("multipeak.turbulence_order", "kalman.turbulence_rms"))
"""Of filters with every line in their model."""

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


def one_peak_filter(_settings: None, prior: Prior, mode: int, _ratio: int | None) -> ModeFilter:
    """Return the Kalman filter of a mode on the LGS measurement, at every fast step, with one peak."""
    one = prior.model[mode]
    return steady_mode(one.disturbance(), one.lgs_noise, lgs_mean(prior, mode))


def steady_mode(
    model: DisturbanceModel, noise: float, mean: SensorMean = ONE, full: DisturbanceModel | None = None
) -> ModeFilter:
    """Return the steady-state filter of a mode.

    model : of the disturbance;  noise : of a measurement [um];  mean : the LGS whose mean it measures
    full  : the model with more states behind those of the disturbance, by default none
    """
    full = full or model
    gains, steady = steady_gains(full, noise)
    step = full.A, np.atleast_2d(full.C), full.Q, np.array([[noise**2]])
    return ModeFilter(model, gains, (steady.posterior,), (step,), mean)


def kf_ngs(prior: Prior, settings: Kalman, sampling: Sampling, _horizon: float) -> FrameEstimator:
    """Return the Kalman filters of all modes on NGS frames, with the coefficients for T_NGS.

    A frame at k = n i measures slow step i - 1 (fast steps k - n ... k - 1); the estimate is that of slow
    step i, the fast steps k ... k + n - 1. It is held over them, or propagated by the fast model.
    """
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
    help="steady-state Kalman filter on the LGS, one vibration peak in its model",
    prior=(LgsModel, LgsStars),
    linear=True,
    takes_missing=True,
    # The gain depends on the ratios of turbulence, vibration and noise. Turbulence tuned for vibration would be no turbulence.
    tunable=Tunable((*MODEL[:2], "kalman.vibration_rms"), ("kalman.turbulence_rms", "kalman.lgs_noise")),
    look=Look("LGS KF", "#FF6600", "#FF8533"),
    step=partial(kalman_filters, one_peak_filter),
)

KF_NGS = Observer(
    "kf-ngs",
    "NGS KF",
    (TURBULENCE,),
    help="steady-state Kalman filter on the NGS, its frames held or spread between them",
    prior=(NgsModel,),
    settings="kalman",
    needs=NGS,
    linear=True,
    takes_missing=True,
    sensors=("ngs",),
    tunable=Tunable(("kalman.turbulence_rms", "kalman.vibration_rms"), (*MODEL[:2], "kalman.ngs_noise")),
    look=Look("NGS KF", "#003DE6", "#7AA2FF", (8, 2)),
    step=kf_ngs,
    counts=way_between,
)


class MultiPeak(Group):
    """The Kalman filters with every peak of the scenario in their models."""

    turbulence_order: Whole = Whole(
        2,
        bounds=(2, 3),
        label="Order of the turbulence model",
        doc="2: the AR(2) of the paper; 3: one more pole, fitted to the scenario's true spectrum.",
    )
    line_width: Real = Real(
        0.025,
        bounds=(1e-4, 10.0),
        softbounds=(0.005, 1.0),
        label="Minimum line width",
        doc="Minimum line width (FWHM) in the model [Hz]; the filter averages over its inverse.",
    )


def every_peak_filter(settings: MultiPeak, prior: Prior, mode: int, _ratio: int | None = None) -> ModeFilter:
    """Return the Kalman filter of a mode on the LGS measurement, at every fast step, with every peak."""
    one = prior.lines[mode]
    return steady_mode(one.disturbance(settings.line_width), one.noise, lgs_mean(prior, mode))


def vibration_used(prior: Prior, settings: MultiPeak) -> list[list[Ar2]]:
    """Return the vibration of every mode as it is modelled: a minimum below the width of every line is none."""
    return [one.vibration(settings.line_width) for one in prior.lines]


PEAKS = Section("multipeak", "Multi-peak Kalman filter", MultiPeak)

KF_MULTI = Observer(
    "kf-multi",
    "Multi-peak KF",
    TARGETS,
    help="Kalman filter on the LGS with every vibration peak in its model; not in the paper",
    prior=(Lines, LgsStars),
    settings=PEAKS,
    linear=True,
    takes_missing=True,
    tunable=TUNABLE_PEAKS,
    look=Look("Multi-peak", "#AE7D40", "#BA6A26", (14, 3)),
    step=partial(kalman_filters, every_peak_filter),
    counts=vibration_used,
)
