"""Missing samples, bridged causally in one place, for observers and controllers that do not take them as missing.

A lost measurement z[k] is replaced by what the Kalman filter of the own prior predicts for it, a lost NGS frame by what the NGS
filter predicts. An observer without a model holds the last value. A lost command is held, as a mirror holds its position. The
Kalman filters and the Gaussian processes in time take a measurement that is missing as missing (`wfsobs.signal.gains`). Only
samples before a gap fill it, so estimates stay causal. What has been filled in counts in no score of predicting measurements, and
no standard deviation is stated there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from wfsobs.observers.stepping import FilterBank, GainCycle, StateArrays, steady_gains
from wfsobs.prior import Prior
from wfsobs.record import Signals, delay_signal, frame_mean, hold_last
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.typing import Array

S = TypeVar("S", bound=Signals)

LINE_WIDTH = 0.025
"""Width at half maximum that lines of a prior have at least [Hz], for an observer that has no setting of its own for it."""


Predictor = tuple[DisturbanceModel, float]
"""A model of a measurement of one mode, and the rms of its white noise [um]."""


def fill_missing(signals: S, prior: Prior, line_width: float = LINE_WIDTH) -> S:
    """Return the signals without NaN, except in y_ngs at steps without a frame; line_width : minimum of lines [Hz]."""
    u = hold_last(signals.u)
    y_lgs, open_loop_y, y_ngs = signals.y_lgs, signals.open_loop_y, signals.y_ngs
    if np.isnan(y_lgs).any():
        mirror = delay_signal(u, signals.delay)
        y_lgs = np.where(np.isnan(y_lgs), predict_missing(y_lgs - mirror, _of_lgs(prior, line_width)) + mirror, y_lgs)
    if open_loop_y is not None and np.isnan(open_loop_y).any():
        open_loop_y = predict_missing(open_loop_y, _of_lgs(prior, line_width))
    if y_ngs is not None and signals.ratio is not None and np.isnan(y_ngs[signals.ratio :: signals.ratio]).any():
        n = signals.ratio
        mirror = frame_mean(delay_signal(u, signals.delay - 1), n)[n::n]
        y_ngs = y_ngs.copy()
        frames = y_ngs[n::n]
        whole = predict_missing(frames - mirror, _of_ngs(prior, n * signals.dt)) + mirror
        y_ngs[n::n] = np.where(np.isnan(frames), whole, frames)
    return replace(signals, y_lgs=y_lgs, u=u, y_ngs=y_ngs, open_loop_y=open_loop_y)


def _of_lgs(prior: Prior, line_width: float) -> list[Predictor]:
    """Return the LGS model of every mode; empty where the prior has no model."""
    if prior.model:
        return [(m.disturbance(), m.lgs_noise) for m in prior.model]
    return [(m.disturbance(line_width), m.noise) for m in prior.lines]


def _of_ngs(prior: Prior, dt: float) -> list[Predictor]:
    """Return the model of every mode at the rate of NGS frames, `dt` [s] each; empty where the prior has no model."""
    return [(m.at(dt).disturbance(), m.ngs_noise) for m in prior.model]


def predict_missing(z: Array, predictors: Sequence[Predictor]) -> Array:
    """Replace every NaN of z (n, n_modes) by the prediction of the steady-state Kalman filter of that mode's model.

    Without models, or where a model has no such filter, the last measurement is held.
    """
    if not predictors:
        return hold_last(z)
    bridge = Bridge(z.shape[1], predictors)
    return np.array([bridge.complete(row) for row in z])


class Bridge(StateArrays):
    """`predict_missing`, one frame at a time.

    gains      : of the filters that predict, by mode; other modes hold their last value
    is_missing : which modes of the last measurement were not there
    """

    state_names: tuple[str, ...] = ("_last", "_bank", "is_missing")

    def __init__(self, n_modes: int, predictors: Sequence[Predictor] = ()):
        found = [(mode, gains) for mode, one in enumerate(predictors) if (gains := _gains(one)) is not None]
        self.gains: dict[int, GainCycle] = dict(found)
        self._modes = np.array([mode for mode, _ in found], dtype=int)
        self._bank = FilterBank([gains.estimator() for _, gains in found]) if found else None
        self._rows = expected_rows([gains for _, gains in found])
        self._last, self.is_missing = np.zeros(n_modes), np.zeros(n_modes, dtype=bool)
        self._all_modes = len(found) == n_modes
        self.mark_start()

    def complete(self, z: Array, is_whole: bool = False) -> Array:
        """Return z (n_modes,) [um] with its NaN replaced; z itself where it is known to have none."""
        self.is_missing[...] = not is_whole and np.isnan(z)
        if not is_whole:
            z = np.where(self.is_missing, self._expectation(), z)
        if self._bank is None:
            self._last[...] = z
        elif self._all_modes:
            self._bank.v[:, 0] = z
            self._bank.advance()
        else:
            self._last[...] = z
            self._bank.step(z[self._modes, None])
        return z

    def _expectation(self) -> Array:
        out = self._last.copy()
        if self._bank is not None:
            out[self._modes] = np.sum(self._rows * self._bank.x, axis=1)
        return out

    def take_over(self, old: Bridge) -> None:
        """Go on from the state of another one, as far as it is of the same kind."""
        self._last[...], self.is_missing[...] = old._last, old.is_missing
        if self._bank is not None and old._bank is not None and self._bank.x.shape == old._bank.x.shape:
            self._bank.load(old._bank.save())


def bridges(prior: Prior, n_modes: int, dt: float, ratio: int | None, line_width: float = LINE_WIDTH) -> tuple[Bridge, Bridge]:
    """Return the bridges of LGS measurements and of NGS frames that `fill_missing` uses for a prior."""
    return Bridge(n_modes, _of_lgs(prior, line_width)), Bridge(n_modes, _of_ngs(prior, ratio * dt) if ratio else ())


def expected_rows(gains: Sequence[GainCycle]) -> Array:
    """Rows (n_modes, n) that give from x_hat[k-1] what the LGS measurement of step k is expected to be [um]."""
    rows = [one.steps[0].C[0] @ one.steps[-1].A for one in gains]
    n = max(map(len, rows), default=0)
    return np.array([np.pad(row, (0, n - len(row))) for row in rows]).reshape(len(rows), n)


def _gains(predictor: Predictor) -> GainCycle | None:
    try:
        return steady_gains(*predictor)[0]
    except ValueError:
        return None
