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
from wfsobs.observers.kalman.step import MakeFilter
from wfsobs.observers.step import MakeEstimator
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


def lqg(make: MakeFilter, group: str, prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    """Return the law that commands against what a filter predicts; group : its settings, "" for none. Raises ValueError."""
    one = make(getattr(settings, group, None), _with_caution(prior, settings), mode, plant.ratio)
    row = command_rows(one.cycle[0][0], one.rows(TARGETS).sum(axis=0), plant.mirror)
    return Law(one.gains.recursion(row), gains=one.gains, row=row[0], filter=one)


def lqg_adaptive(make: MakeEstimator, prior: Prior, plant: Plant, settings: Any, sampling: Sampling) -> PredictionLaws:
    """Return the laws of an adaptive filter, at first of integrators. Raises RecordError for a window of too few samples."""
    first = integrator_law(plant.mirror, settings.control.fallback_gain, settings.control.leak)
    integrators = Integrators([first] * sampling.n_modes, plant.mirror)
    return PredictionLaws(make(prior, settings.adaptive, sampling, 0.0), integrators, plant.mirror)
