"""Missing samples, bridged causally in one place, so that no observer needs to know of them.

A lost measurement z[k] is replaced by what the Kalman filter of the observer's own prior predicts for it. For that filter this
is the exact answer: its correction vanishes, and it predicts through the gap. A lost NGS frame is replaced by what the NGS
filter predicts. An observer that is told no model holds the last value. A lost command is held, as a mirror holds its position.
Only samples before a gap fill it, so estimates stay causal, and what has been filled in counts in no score.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from wfsobs.prior import Prior
from wfsobs.record import Signals, delay_signal, frame_mean, hold_last
from wfsobs.signal.riccati import steady_state
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.typing import Array

S = TypeVar("S", bound=Signals)

LINE_WIDTH = 0.025
"""Width at half maximum that lines of a prior have at least [Hz], for an observer that has no setting of its own for it."""


class Predictor(NamedTuple):
    """A model of a measurement of one mode, and the rms of its white noise [um]."""

    model: DisturbanceModel
    noise: float


def fill_missing(signals: S, prior: Prior, line_width: float = LINE_WIDTH) -> S:
    """Return the signals without NaN, except in y_ngs at steps without a frame; line_width : minimum of lines [Hz]."""
    u = hold_last(signals.u)
    y_lgs, open_loop_y, y_ngs = signals.y_lgs, signals.open_loop_y, signals.y_ngs
    if np.isnan(y_lgs).any():
        mirror = delay_signal(u, signals.delay)
        y_lgs = predict_missing(y_lgs - mirror, _of_lgs(prior, line_width)) + mirror
    if open_loop_y is not None and np.isnan(open_loop_y).any():
        open_loop_y = predict_missing(open_loop_y, _of_lgs(prior, line_width))
    if y_ngs is not None and signals.ratio is not None and np.isnan(y_ngs[signals.ratio :: signals.ratio]).any():
        n = signals.ratio
        mirror = frame_mean(delay_signal(u, signals.delay - 1), n)[n::n]
        y_ngs = y_ngs.copy()
        frames = [Predictor(m.at(n * signals.dt).disturbance(), m.ngs_noise) for m in prior.model]
        y_ngs[n::n] = predict_missing(y_ngs[n::n] - mirror, frames) + mirror
    return replace(signals, y_lgs=y_lgs, u=u, y_ngs=y_ngs, open_loop_y=open_loop_y)


def _of_lgs(prior: Prior, line_width: float) -> list[Predictor]:
    """Return the LGS model of every mode; empty where the prior has no model."""
    if prior.model:
        return [Predictor(m.disturbance(), m.lgs_noise) for m in prior.model]
    return [Predictor(m.disturbance(line_width), m.noise) for m in prior.lines]


def predict_missing(z: Array, predictors: Sequence[Predictor]) -> Array:
    """Replace every NaN of z (n, n_modes) by the prediction of the steady-state Kalman filter of that mode's model.

    Without models, or where a model has no such filter, the last measurement is held.
    """
    out = hold_last(z).copy()
    for mode, (model, noise) in enumerate(predictors):
        try:
            K = model.A @ steady_state(model.A, model.C, model.Q, np.array(noise**2)).L[:, 0]
        except ValueError:
            continue
        x = np.zeros(len(model.A))
        for k, gone in enumerate(np.isnan(z[:, mode])):
            expected = model.C @ x
            if gone:
                out[k, mode] = expected
            x = model.A @ x + K * (out[k, mode] - expected)
    return out
