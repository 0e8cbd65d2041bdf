"""LQG control: command against the disturbance what a Kalman filter predicts of it.

The mirror follows a command at once and without cost, so the best command is minus the prediction of what the disturbance
will be while it acts (certainty equivalence): u[k] = -(turb_hat[k+1] + vib_hat[k+1]) for the paper's delay of two
frames, and for n + f frames the mean over the time that the command is held,

    u[k] = -((1 - f) phi_hat[k+n-1] + f phi_hat[k+n]).

The adaptive ones predict by a filter that is identified anew while the loop runs, from the pseudo-open-loop so far; until its
first window is full an integrator closes the loop.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from wfsobs.control.integrator import integrator_law
from wfsobs.control.mirror import Law, Mirror, Plant
from wfsobs.control.step import Integrators, PredictionLaws
from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.adaptive import AdaptiveEstimator, kf_adaptive, multirate_adaptive
from wfsobs.observers.kalman.mode_filter import ModeFilter
from wfsobs.observers.kalman.multirate import every_peak_model, multirate_mode, optimal_model
from wfsobs.observers.kalman.single import every_peak_filter, one_peak_filter
from wfsobs.prior import Noise, Prior
from wfsobs.record import Sampling
from wfsobs.typing import Array


def command_rows(A: Array, phi: Array, mirror: Mirror) -> Array:
    """Row (1, n) that makes the command of the estimated state x_hat[k].

    A (n, n): transition; phi (n,): row that gives phi_dist[k], which no other part of the state drives later on
    """
    row = -phi
    out = np.zeros_like(row)
    for tap in mirror.taps[1:]:
        out += tap * row
        row = row @ A
    return out[None, :]


def _with_caution(prior: Prior, settings: Any) -> Prior:
    """Return a prior with the noise that the settings have a filter take measurements to have."""
    factor = settings.control.caution
    if factor == 1.0:
        return prior
    return replace(
        prior,
        model=tuple(replace(m, lgs_noise=factor * m.lgs_noise, ngs_noise=factor * m.ngs_noise) for m in prior.model),
        lines=tuple(replace(lines, noise=factor * lines.noise) for lines in prior.lines),
        noise=tuple(Noise(factor * lgs, factor * ngs) for lgs, ngs in prior.noise),
    )


def lqg_kf_lgs(prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    """With the model of the LGS Kalman filter: turbulence and one vibration peak."""
    return _law(one_peak_filter(_with_caution(prior, settings), mode), plant.mirror)


def lqg_kf_multi(prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    """With every peak of the vibration in the model."""
    return _law(every_peak_filter(_with_caution(prior, settings), mode, settings.multipeak), plant.mirror)


def lqg_multirate(prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    """With the paper's multi-rate filter. Raises UnstableCycle."""
    return _law(multirate_mode(settings.multirate, _with_caution(prior, settings), mode, plant.ratio), plant.mirror)


def lqg_multirate_optimal(prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    """With the optimal multi-rate filter."""
    prior = _with_caution(prior, settings)
    return _law(optimal_model(settings.multirate, prior, mode, plant.ratio).filter_of(prior, mode), plant.mirror)


def lqg_multirate_multi(prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    """With the optimal multi-rate filter and every peak of the vibration in its model."""
    prior = _with_caution(prior, settings)
    cycle = every_peak_model(settings.multipeak, prior, mode, plant.ratio)
    return _law(cycle.filter_of(prior, mode), plant.mirror)


def _law(mode_filter: ModeFilter, mirror: Mirror) -> Law:
    """Return the law that commands against what a filter predicts. Raises RiccatiError."""
    row = command_rows(mode_filter.cycle[0][0], mode_filter.rows(TARGETS).sum(axis=0), mirror)
    return Law(mode_filter.gains.recursion(row), gains=mode_filter.gains, row=row[0], filter=mode_filter)


def lqg_kf_adaptive(prior: Prior, plant: Plant, settings: Any, sampling: Sampling) -> PredictionLaws:
    """With the adaptive filter of the LGS. Raises RecordError for a window of too few samples."""
    return _adaptive(kf_adaptive(prior, settings.adaptive, sampling, 0.0), plant, settings)


def lqg_multirate_adaptive(prior: Prior, plant: Plant, settings: Any, sampling: Sampling) -> PredictionLaws:
    """With the adaptive filter of both sensors. Raises RecordError for a window of too few samples."""
    return _adaptive(multirate_adaptive(prior, settings.adaptive, sampling, 0.0), plant, settings)


def _adaptive(estimator: AdaptiveEstimator, plant: Plant, settings: Any) -> PredictionLaws:
    first = integrator_law(plant.mirror, settings.control.fallback_gain, settings.control.leak)
    return PredictionLaws(estimator, Integrators([first] * estimator.sampling.n_modes, plant.mirror), plant.mirror)
