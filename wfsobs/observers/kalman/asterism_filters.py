"""The independent filters of an asterism, of every LGS measurement and of the NGS frames, with running means of the same."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from wfsobs.observers.kalman.mode_filter import ModeFilter
from wfsobs.observers.kalman.multi import MultiPeak
from wfsobs.observers.kalman.single import steady_mode
from wfsobs.prior import Asterism, Prior
from wfsobs.signal.joint_states import StateFilter
from wfsobs.signal.statespace import disturbance_model
from wfsobs.typing import Array


class Beginning(NamedTuple):
    """A filter, and its state where the first measurement is 1: (n,)."""

    filter: StateFilter
    first: Array


def frame_filters(prior: Prior, settings: MultiPeak, asterism: Asterism) -> list[ModeFilter]:
    """Return a filter of the NGS frames of each mode, with its lines, as if frames were samples."""
    found = []
    for one, noise in zip(prior.lines, asterism.ngs_noise, strict=True):
        step = asterism.ratio * one.dt
        peaks = [peak.at(step) for peak in one.vibration(settings.line_width)]
        turbulence = [replace(process, dt=step) for process in one.turbulence]
        found.append(steady_mode(disturbance_model(turbulence, peaks), float(noise)))
    return found


def with_means(one: ModeFilter, means: StateFilter) -> Beginning:
    """Return a filter and means of the same measurement, of which the means begin as if it had always been what it is first."""
    step = one.gains.steps[0]
    reduced = (np.eye(len(step.A)) - step.L @ step.C) @ step.A
    whole = StateFilter(block_diag(reduced, means.F), np.concatenate([step.L[:, 0], means.G]))
    at_rest = np.linalg.solve(np.eye(len(means.F)) - means.F, means.G)
    return Beginning(whole, np.concatenate([np.zeros(len(reduced)), at_rest]))
