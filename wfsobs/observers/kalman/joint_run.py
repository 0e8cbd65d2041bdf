"""A filter of all modes over a record: all at once where nothing is missing, else frame by frame."""

from __future__ import annotations

import numpy as np

from wfsobs.observers.base import TARGETS, TURBULENCE, VIBRATION
from wfsobs.observers.estimates import NEXT_Z, TOTAL, Estimates
from wfsobs.observers.kalman.asterism_filters import Beginning
from wfsobs.observers.kalman.asterism_model import AsterismModel
from wfsobs.observers.kalman.joint_step import JointEstimator
from wfsobs.progress import Watch
from wfsobs.record import Measurements
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.typing import Array

EVERY = 1000
"""Frames between two looks at whether to stop."""


def run_joint(estimator: JointEstimator, each: Array, measurements: Measurements, watch: Watch) -> Estimates:
    """Return the estimates of a filter before its first frame.

    Parameters
    ----------
    estimator : JointEstimator
        The filter.
    each : Array
        What it takes of the LGS, (n_steps, n_lgs, n_modes) [um].
    measurements : Measurements
        Of the NGS.
    watch : Watch
        Is told of the progress.
    """
    n = estimator.model.ratio
    frames = measurements.z_ngs[n::n]
    if np.isnan(each).any() or np.isnan(frames).any():
        return _frame_by_frame(estimator, each, frames, watch)
    return _at_once(estimator.model, each, frames, watch)


def _frame_by_frame(estimator: JointEstimator, each: Array, frames: Array, watch: Watch) -> Estimates:
    n = estimator.model.ratio
    shape = (len(each), each.shape[2])
    values = {name: np.empty(shape) for name in (*TARGETS, TOTAL)}
    sd = {name: np.empty(shape) for name in (*values, NEXT_Z)}
    for k in range(len(each)):
        if k % EVERY == 0:
            watch.step(k / len(each))
        estimator.advance_each(each[k], frames[k // n - 1] if k > 0 and k % n == 0 else None)
        for name, found in values.items():
            found[k], sd[name][k] = estimator.predict(0.0, name)
        sd[NEXT_Z][k] = estimator.next_z_sd()
    return Estimates({name: values[name] for name in TARGETS}, sd)


def _at_once(model: AsterismModel, each: Array, frames: Array, watch: Watch) -> Estimates:
    n, (steps, _, m) = model.ratio, each.shape
    plans = {name: model.plan(0.0, name) for name in (*TARGETS, TOTAL)}
    weights = np.concatenate([plans[name][0] for name in TARGETS], axis=1)
    out, seen, at = np.zeros((steps, 2 * m)), np.einsum("ab,kbi->kai", model.basis, each), 0
    phase = np.where(np.arange(steps) < n, n, np.arange(steps) % n)
    of_phase = [np.flatnonzero(phase == p) for p in range(n + 1)]
    for star in range(model.n_stars):
        for mode, one in enumerate(model.fast):
            watch.step((star * m + mode) / (model.n_stars * m))
            x, own = _states(one, seen[:, star, mode]), slice(at, at + len(one.first))
            for rows, steps_of in zip(weights[:, :, own], of_phase, strict=True):
                out[steps_of] += x[steps_of] @ rows.T
            at = own.stop
    for mode, late in enumerate(model.slow):
        x, own = _states(late, frames[:, mode]), slice(at, at + len(late.first))
        for rows, steps_of in zip(weights[:-1, :, own], of_phase, strict=False):
            out[steps_of] += x[steps_of // n - 1] @ rows.T
        at = own.stop
    sd = {name: spread[phase] for name, (_, spread) in plans.items()}
    turbulence, vibration = np.split(out, 2, axis=1)
    return Estimates(
        {TURBULENCE: turbulence, VIBRATION: vibration}, sd | {NEXT_Z: model.next_z_sd((True,) * model.n_stars)[phase]}
    )


def _states(one: Beginning, y: Array) -> Array:
    """Return the states after every measurement of y (n,), (n, n_states)."""
    F, G = one.filter.F, one.filter.G[:, None]
    if not len(y):
        return np.empty((0, len(F)))
    return PeriodicFilter([(F, G, F, G)]).run(y[:, None, None], one.first[:, None] * y[0])[:, :, 0]
