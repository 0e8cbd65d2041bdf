"""Missing samples, bridged causally in one place, so that no observer needs to know of them.

A lost measurement z[k] is replaced by what the Kalman filter of the scenario's model predicts for it. For that filter this
is the exact answer: its correction vanishes, and it predicts through the gap. A lost NGS frame is replaced by what the NGS
filter predicts. A lost command is held, as a mirror holds its position. Only samples before a gap fill it, so estimates stay
causal, and what has been filled in counts in no score.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wfsobs.observers.kalman.single import kalman_model, measurement_noise
from wfsobs.record import Record, delayed, frame_mean, held
from wfsobs.scenario import Scenario
from wfsobs.signal.riccati import steady_state
from wfsobs.typing import Array

LGS, NGS = 0, 1
"""Which of the two of `measurement_noise`."""


def bridged(record: Record, scenario: Scenario) -> Record:
    """The record without NaN, but in y_ngs at steps without a frame."""
    u = held(record.u)
    y_lgs, open_loop_y, y_ngs = record.y_lgs, record.open_loop_y, record.y_ngs
    if np.isnan(y_lgs).any():
        mirror = delayed(u, record.delay)
        y_lgs = predicted(y_lgs - mirror, scenario, record.dt, LGS) + mirror
    if open_loop_y is not None and np.isnan(open_loop_y).any():
        open_loop_y = predicted(open_loop_y, scenario, record.dt, LGS)
    if y_ngs is not None and record.ratio is not None and np.isnan(y_ngs[record.ratio :: record.ratio]).any():
        n = record.ratio
        mirror = frame_mean(delayed(u, record.delay - 1), n)[n::n]
        y_ngs = y_ngs.copy()
        y_ngs[n::n] = predicted(y_ngs[n::n] - mirror, scenario, n * record.dt, NGS) + mirror
    return replace(record, y_lgs=y_lgs, u=u, y_ngs=y_ngs, open_loop_y=open_loop_y)


def predicted(z: Array, scenario: Scenario, dt: float, star: int) -> Array:
    """z (n, n_modes) with every NaN replaced by the prediction of the steady-state Kalman filter of the scenario's model;
    star : LGS or NGS. Where the model has no such filter the last measurement is held."""
    out = z.copy()
    for mode in range(z.shape[1]):
        model, noise = kalman_model(scenario, mode, dt), measurement_noise(scenario, mode)[star]
        try:
            K = model.A @ steady_state(model.A, model.C, model.Q, np.array(noise**2)).L[:, 0]
        except ValueError:
            out[:, mode] = held(z[:, [mode]])[:, 0]
            continue
        x = np.zeros(len(model.A))
        for k, gone in enumerate(np.isnan(z[:, mode])):
            expected = model.C @ x
            if gone:
                out[k, mode] = expected
            x = model.A @ x + K * (out[k, mode] - expected)
    return out
